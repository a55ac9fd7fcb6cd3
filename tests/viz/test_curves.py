"""Curves of confidences against hand-computed ones."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from torchcrf_scan.data.simulate import simulate_pairs
from torchcrf_scan.data.worlds import SimulatorConfig
from torchcrf_scan.scan import PairPrediction
from torchcrf_scan.viz.curves import plot_confidence, plot_precision_recall, plot_reliability, precision_recall


def test_precision_and_recall_by_hand() -> None:
    precision, recall, average = precision_recall(np.array([0.9, 0.8, 0.8, 0.1]), np.array([True, False, True, True]))
    np.testing.assert_allclose(precision, [1, 2 / 3, 3 / 4])  # equal scores go together
    np.testing.assert_allclose(recall, [1 / 3, 2 / 3, 1])
    assert average == pytest.approx((1 + 2 / 3 + 3 / 4) / 3)


@given(score=hnp.arrays(np.float64, st.integers(1, 20), elements=st.sampled_from([0.0, 0.25, 0.5, 1.0])), seed=st.integers(0, 999))
def test_precision_and_recall_are_those_of_every_threshold(score: np.ndarray, seed: int) -> None:
    positive = np.random.default_rng(seed).random(len(score)) < 0.5
    positive[0] = True
    precision, recall, average = precision_recall(score, positive)
    thresholds = np.unique(score)[::-1]
    assert len(precision) == len(recall) == len(thresholds)
    for p, r, threshold in zip(precision, recall, thresholds, strict=True):
        called = score >= threshold
        assert p == pytest.approx((called & positive).sum() / called.sum())
        assert r == pytest.approx((called & positive).sum() / positive.sum())
    assert 0 <= average <= 1 + 1e-12


def test_nothing_to_find_has_no_recall() -> None:
    precision, recall, average = precision_recall(np.array([0.5, 0.2]), np.array([False, False]))
    np.testing.assert_array_equal(precision, [0, 0])
    assert np.isnan(recall).all()
    assert np.isnan(average)
    assert len(precision_recall(np.zeros(0), np.zeros(0, dtype=bool))[0]) == 0


def test_a_panel_for_each_kind_of_answer() -> None:
    sure, right = np.array([0.1, 0.6, 0.95]), np.array([False, True, True])
    figure = plot_reliability({"association": (sure, right), "cluster": (sure, right)})
    titles = [ax.get_title(loc="left") for ax in figure.axes]
    assert [title.split(":")[0] for title in titles] == ["association", "cluster"]


def test_moving_points_have_their_average_precision_in_the_legend() -> None:
    figure = plot_precision_recall({"joint": (np.array([0.9, 0.1]), np.array([True, False]))})
    (legend,) = [ax.get_legend() for ax in figure.axes]
    assert [text.get_text() for text in legend.get_texts()] == ["joint: average precision 1.00"]


def test_the_area_below_the_curve_is_the_average_precision() -> None:
    score, moving = np.array([0.9, 0.5, 0.5, 0.5, 0.1]), np.array([True, False, True, False, True])
    (line,) = plot_precision_recall({"joint": (score, moving)}).axes[0].lines
    assert line.get_drawstyle() == "steps-pre"  # a step holds the precision of the threshold at its right end
    recall, precision = (np.asarray(values) for values in line.get_data())
    assert recall[0] == 0
    assert (np.diff(recall) * precision[1:]).sum() == pytest.approx(precision_recall(score, moving)[2])
    assert plot_precision_recall({"nothing": (np.zeros(0), np.zeros(0, dtype=bool))}).axes[0].lines


def test_confidences_are_drawn_by_point() -> None:
    (pair,) = simulate_pairs(SimulatorConfig(beams=31), 1, 1, 0)
    n = pair.source.n_beams
    sure = np.linspace(0, 1, n)
    nothing = np.zeros(n, dtype=np.int64)
    figure = plot_confidence(pair, PairPrediction(nothing, nothing, np.zeros((1, 3)), sure, sure[::-1], True))
    panels = [ax for ax in figure.axes if ax.get_title(loc="left")]
    assert [ax.get_title(loc="left") for ax in panels] == ["association confidence", "cluster confidence"]
    np.testing.assert_allclose(panels[0].collections[0].get_array(), sure[pair.source.beam])
