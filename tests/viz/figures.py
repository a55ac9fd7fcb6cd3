"""What the tests of figures share: a pair made by hand, and what is written and drawn on a panel."""

from dataclasses import replace

import numpy as np

from torchcrf_scan.scan import Annotation, PairPrediction, Scan, ScanPair
from torchcrf_scan.viz import plots


def make_pair(n=60, movers=1, annotated=True):
    """A ring of returns; the sensor drives 0.2 m ahead, mover k (five returns each) 0.1 m to the left in 0.1 s."""
    bearings = np.linspace(-3.0, 3.0, n)
    scan = Scan.from_ranges(np.full(n, 5.0), bearings)
    cluster = np.zeros(n, dtype=np.int64)
    for k in range(1, movers + 1):
        cluster[(5 * k) % max(n, 1) : (5 * k) % max(n, 1) + 5] = k
    association = np.arange(n)
    association[-2:] = cluster[-2:] = -1
    motions = np.tile([0.0, -0.2, 0.0], (movers + 1, 1))
    motions[1:, 2] += 0.1
    annotation = Annotation(association, cluster, motions, cluster.copy(), np.zeros(n, dtype=bool))
    return ScanPair(scan, scan, 0.1, annotation if annotated else None, name="ring")


def make_prediction(pair, **changes):
    truth = pair.annotation
    one = np.ones(pair.source.n_beams)
    return replace(PairPrediction(truth.association, truth.cluster, truth.motions, one, one, True), **changes)


def axes_titled(figure, title):
    return next(ax for ax in figure.axes if ax.get_title(loc="left") == title)


def words(ax):
    return " | ".join([*(text.get_text() for text in ax.texts), ax.get_title(loc="right")])


def count_of(ax, label):
    return sum(len(line.get_xdata()) for line in ax.lines if line.get_label() == label)


def render(figure, tmp_path):
    plots.save_figure(figure, tmp_path / "deep" / "figure.png", dpi=30)
    assert (tmp_path / "deep" / "figure.png").read_bytes().startswith(b"\x89PNG")
