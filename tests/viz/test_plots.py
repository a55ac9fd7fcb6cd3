"""Figures: their panels and titles; nothing breaks on empty or incomplete answers."""

import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
from figures import axes_titled, make_pair, make_prediction, render, words
from matplotlib.figure import Figure

from torchcrf_scan.scan import PairPrediction, Scan
from torchcrf_scan.viz import plots


def test_pair_has_a_row_for_prediction_and_truth(tmp_path):
    pair = make_pair()
    figure = plots.plot_pair(pair, make_prediction(pair))
    assert isinstance(figure, Figure)
    titles = [ax.get_title(loc="left") for ax in figure.axes]
    assert titles == [
        *("both scans", "predicted associations", "predicted clusters", "magnified"),
        *("sensor's motion undone", "true associations", "true clusters", "magnified"),
    ]
    render(figure, tmp_path)


@pytest.mark.parametrize("n", [0, 1])
@pytest.mark.parametrize("annotated", [True, False])
def test_tiny_scans(n, annotated, tmp_path):
    pair = make_pair(n=n, movers=0)
    prediction = make_prediction(pair)
    pair = pair if annotated else replace(pair, annotation=None)
    figure = plots.plot_pair(pair, prediction)
    assert len(figure.axes) == (6 if annotated else 3)  # no mover, no magnified column
    render(figure, tmp_path)


@pytest.mark.parametrize("empty", ["source", "target"])
def test_one_empty_scan(empty, tmp_path):
    pair = replace(make_pair(annotated=False), **{empty: Scan.from_ranges([], [])})
    n = pair.source.n_beams
    none = np.full(n, -1)
    prediction = PairPrediction(none, none, np.full((1, 3), np.nan), np.ones(n), np.ones(n), False)
    figure = plots.plot_pair(pair, prediction)
    assert "unknown" in words(axes_titled(figure, "predicted clusters"))
    render(figure, tmp_path)


def test_without_prediction_and_annotation_only_the_scans():
    assert [ax.get_title(loc="left") for ax in plots.plot_pair(make_pair(annotated=False)).axes] == ["both scans"]


def test_methods_side_by_side_with_the_truth_last(tmp_path):
    pair = make_pair()
    methods = {
        name: make_prediction(pair)
        for name in ("ICP", "$weird_{name", "joint", "a name that is longer than its panel is wide, by far")
    }
    associations, clusters = plots.plot_associations(pair, methods), plots.plot_clusters(pair, methods)
    drawn = [ax.get_title(loc="left") for ax in clusters.axes if ax.axison]
    assert drawn == [*methods, "truth"]
    assert [t for t in (ax.get_title(loc="left") for ax in associations.axes if ax.axison) if t != "magnified"] == drawn
    render(clusters, tmp_path)


def test_long_names_stay_clear_of_the_mistakes():
    pair = make_pair()
    figure = plots.plot_associations(
        pair, {"CRF-Clustering on CRF-Matching": make_prediction(pair), "joint": make_prediction(pair)}
    )
    figure.draw_without_rendering()
    for ax in figure.axes[:2]:
        left, right = (title.get_window_extent() for title in (ax._left_title, ax._right_title))
        assert left.x1 < right.x0


def test_errors_name_what_was_expected(tmp_path):
    pair = make_pair()
    with pytest.raises(ValueError, match=r"prediction.cluster: expected shape \(60,\), got \(3,\)"):
        plots.plot_pair(pair, make_prediction(pair, cluster=np.zeros(3, dtype=np.int64)))
    with pytest.raises(ValueError, match=r"icp.association: expected indices below 60, got 60"):
        plots.plot_clusters(pair, {"icp": make_prediction(pair, association=np.full(60, 60))})
    with pytest.raises(ValueError, match="at least one method"):
        plots.plot_associations(make_pair(annotated=False), {})
    with pytest.raises(ValueError, match=r"ending in \.png"):
        plots.save_figure(Figure(), tmp_path / "figure.pdf")


def test_save_leaves_the_old_file_when_drawing_fails(tmp_path):
    class Broken(Figure):
        def savefig(self, name, **_):
            name.write(b"half")
            raise RuntimeError("disk full")

    path = tmp_path / "figure.png"
    path.write_bytes(b"old")
    with pytest.raises(RuntimeError, match="disk full"):
        plots.save_figure(Broken(), path)
    assert path.read_bytes() == b"old"
    assert list(tmp_path.iterdir()) == [path]


def test_import_is_light_and_figures_never_touch_pyplot():
    code = (
        "import sys; from torchcrf_scan.viz import plots; assert 'matplotlib' not in sys.modules;"
        "from torchcrf_scan.scan import Scan, ScanPair; s = Scan.from_ranges([1.0], [0.0]); plots.plot_pair(ScanPair(s, s));"
        "assert 'matplotlib.pyplot' not in sys.modules"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
