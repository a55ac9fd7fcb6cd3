"""What is drawn where, on tiny pairs made by hand."""

from dataclasses import replace

import numpy as np
import pytest
from figures import axes_titled, make_pair, make_prediction, render, words

from torchcrf_scan.scan import Scan
from torchcrf_scan.viz import marks, plots


def test_association_lines_join_source_and_target():
    pair = make_pair(n=6, movers=0)
    target = Scan.from_ranges(np.full(6, 4.0), pair.target.bearings)
    figure = plots.plot_pair(replace(pair, target=target), make_prediction(pair))
    line = next(line for line in axes_titled(figure, "true associations").lines if line.get_label() == "association")
    path = np.asarray(line.get_xydata()).reshape(-1, 3, 2)
    np.testing.assert_allclose(path[:, 0], pair.source.points[:4])
    np.testing.assert_allclose(path[:, 1], target.points[:4])
    assert np.isnan(path[:, 2]).all()


@pytest.mark.parametrize("motions", [np.full((2, 3), np.nan), np.zeros((0, 3)), np.array([[0.0, 0.1, 0.0], [np.nan] * 3])])
def test_unknown_motions_have_no_arrow(motions, tmp_path):
    pair = make_pair()
    pair = replace(pair, annotation=replace(pair.annotation, motions=motions))
    figure = plots.plot_clusters(pair, {})
    assert "m/s" not in words(axes_titled(figure, "truth"))
    render(figure, tmp_path)


def test_thirty_movers_look_different(tmp_path):
    pair = make_pair(n=200, movers=30)
    assert len({marks.mover_look(k) for k in range(1, 31)}) == 30
    figure = plots.plot_pair(pair)
    assert words(axes_titled(figure, "true clusters")).count("m/s") == marks.MAX_SPEED_LABELS
    render(figure, tmp_path)
