"""Outlier decisions: put right by the truth, and by the best gate, which plain counting finds too."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from made_causes import CAR, GONE, MOTIONS, Street, labelled
from made_pairs import PREDICTORS, make_pair

from torchcrf_scan.evaluation.calibration import rightness
from torchcrf_scan.evaluation.causes.blame import wrong_points
from torchcrf_scan.evaluation.causes.outliers import OutlierCase, best_gate, with_true_outliers
from torchcrf_scan.evaluation.counterparts import clusters_beneath


def test_an_outlier_lies_in_the_cluster_of_the_nearest_inlier(street: Street) -> None:
    answer = labelled(street.answer, slice(43, 46), cluster=-1)
    beneath = street.pair.source.to_beams(clusters_beneath(street.pair, answer), -1)
    assert beneath[CAR].tolist() == [1] * 8
    assert beneath[5] == 0


def test_right_decisions_mend_all_points_whose_motions_are_right(street: Street) -> None:
    answer = labelled(street.answer, np.r_[3:7, 43:46], cluster=-1)
    answer.association[[3, 5, 43]] = -1
    answer = labelled(answer, GONE, cluster=0)
    answer.association[GONE] = 4
    mended = with_true_outliers(street.pair, answer)
    assert not wrong_points(rightness(street.pair, mended)).any()
    assert wrong_points(rightness(street.pair, answer)).sum() == 12
    assert (mended.motions == answer.motions).all()


def test_right_decisions_do_not_mend_a_motion(street: Street) -> None:
    answer = labelled(street.answer, np.arange(60), cluster=-1)
    answer.association[:] = -1
    mended = with_true_outliers(street.pair, replace(answer, motions=np.zeros((1, 3))))
    assert (mended.cluster[:55] == 0).all()
    assert wrong_points(rightness(street.pair, mended))[street.pair.source.to_beams(np.arange(60), -1)[CAR]].all()


@given(st.integers(0, 10**6), st.sampled_from(PREDICTORS))
def test_right_decisions_agree_with_the_truth_about_every_annotated_point(seed: int, predictor) -> None:
    rng = np.random.default_rng(seed)
    pair = make_pair(40, 40, 2, rng, 0.2)
    truth, answer = pair.annotation, predictor(pair, rng)
    assert truth is not None
    mended = with_true_outliers(pair, answer)
    known = np.zeros(40, bool)
    known[pair.source.beam] = ~truth.ignore[pair.source.beam]
    is_outlier = truth.association < 0
    assert (mended.association[known & is_outlier] == -1).all()
    assert (mended.cluster[known] == -1).tolist() == is_outlier[known].tolist()
    assert (mended.association[~known] == answer.association[~known]).all()


def errors_by_counting(distance: np.ndarray, is_outlier: np.ndarray, gate: float) -> int:
    return sum((float(d) > gate) != bool(outlier) for d, outlier in zip(distance, is_outlier, strict=True))


@given(
    st.lists(st.tuples(st.sampled_from([0.0, 0.1, 0.1001, 0.5, 2.0, np.inf]), st.booleans(), st.booleans()), max_size=12),
    st.integers(0, 12),
)
def test_no_gate_makes_fewer_errors(points: list[tuple[float, bool, bool]], cut: int) -> None:
    columns = [np.array(column, kind) for column, kind in zip(zip(*points, strict=True), (float, bool, bool), strict=False)]
    distance, is_outlier, is_called = columns or [np.zeros(0), np.zeros(0, bool), np.zeros(0, bool)]
    cases = [OutlierCase(distance[part], is_outlier[part], is_called[part]) for part in (slice(0, cut), slice(cut, None))]
    gate = best_gate(cases)
    assert gate.errors == errors_by_counting(distance, is_outlier, gate.metres)
    assert gate.errors == min(
        errors_by_counting(distance, is_outlier, g) for g in (0.0, 0.05, 0.1, 0.1001, 0.3, 0.5, 1.0, 2.0, np.inf)
    )
    assert gate.answered == (is_outlier != is_called).sum()


def test_a_gate_by_hand(street: Street) -> None:
    """Six centimetres of error at the car: a gate beyond them, and within the distance of what is gone, makes no error."""
    answer = replace(street.answer, motions=MOTIONS + np.eye(3, 1, -1) @ [[0.0, 0.06, 0.0]])
    answer.association[CAR] = -1
    gate = best_gate([OutlierCase.of(street.pair, answer)])
    assert gate.metres == pytest.approx(0.06)
    assert (gate.errors, gate.answered) == (0, 8)
