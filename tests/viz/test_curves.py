"""Curves of confidences against hand-computed ones."""

import numpy as np
import pytest

from torchcrf_scan.data.simulate import simulate_pairs
from torchcrf_scan.data.worlds import SimulatorConfig
from torchcrf_scan.scan import PairPrediction
from torchcrf_scan.viz.curves import plot_confidence, plot_precision_recall, plot_reliability


def test_a_panel_for_each_kind_of_answer() -> None:
    sure, right = np.array([0.1, 0.6, 0.95]), np.array([False, True, True])
    figure = plot_reliability({"association": (sure, right), "cluster": (sure, right)})
    titles = [ax.get_title(loc="left") for ax in figure.axes]
    assert [title.split(":")[0] for title in titles] == ["association", "cluster"]


def test_the_area_below_the_curve_is_the_average_precision() -> None:
    figure = plot_precision_recall(np.array([0.9, 0.8, 0.8, 0.1]), np.array([True, False, True, True]))
    average = (1 + 2 / 3 + 3 / 4) / 3  # equal scores go together
    (line,) = figure.axes[0].lines
    assert line.get_drawstyle() == "steps-post"
    recall, precision = (np.asarray(values) for values in line.get_data())
    assert (recall[0], recall[-1]) == (1, 0)
    assert -(np.diff(recall) * precision[:-1]).sum() == pytest.approx(average)
    assert [text.get_text() for text in figure.axes[0].get_legend().get_texts()] == [f"average precision {average:.2f}"]


def test_nothing_that_moves_has_no_curve() -> None:
    assert not plot_precision_recall(np.zeros(0), np.zeros(0, dtype=bool)).axes[0].lines


def test_confidences_are_drawn_by_point() -> None:
    (pair,) = simulate_pairs(SimulatorConfig(beams=31), 1, 1, 0)
    n = pair.source.n_beams
    sure = np.linspace(0, 1, n)
    nothing = np.zeros(n, dtype=np.int64)
    figure = plot_confidence(pair, PairPrediction(nothing, nothing, np.zeros((1, 3)), sure, sure[::-1], True))
    panels = [ax for ax in figure.axes if ax.get_title(loc="left")]
    assert [ax.get_title(loc="left") for ax in panels] == ["association confidence", "cluster confidence"]
    np.testing.assert_allclose(panels[0].collections[0].get_array(), sure[pair.source.beam])
