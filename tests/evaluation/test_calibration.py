"""Calibration errors and normalised errors, by hand and against draws."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from made_pairs import make_pair, perfect, perturbed

from torchcrf_scan.evaluation.calibration import (
    consistency,
    expected_calibration_error,
    normalised_error,
    reliability,
    rightness,
)
from torchcrf_scan.evaluation.metrics import score_pair


def test_reliability_by_hand() -> None:
    low, high = reliability([0.1, 0.3, 0.5, 0.9, 1.0], [False, True, True, True, False], bins=2)
    assert (low.low, low.high, low.count, low.accuracy) == (0.0, 0.5, 2, 0.5)
    assert low.confidence == pytest.approx(0.2)
    assert (high.low, high.high, high.count) == (0.5, 1.0, 3)
    assert (high.confidence, high.accuracy) == (pytest.approx(0.8), pytest.approx(2 / 3))


def test_expected_calibration_error_by_hand() -> None:
    error = expected_calibration_error([0.1, 0.3, 0.5, 0.9, 1.0], [False, True, True, True, False], bins=2)
    assert error == pytest.approx((2 * 0.3 + 3 * (0.8 - 2 / 3)) / 5)


def test_empty_bins_and_no_answers() -> None:
    assert math.isnan(reliability([0.9], [True], bins=2)[0].accuracy)
    assert expected_calibration_error([1.0], [True]) == 0
    assert math.isnan(expected_calibration_error([], []))


@pytest.mark.parametrize(
    ("confidence", "is_right", "bins"), [([0.5], [True, False], 5), ([1.5], [True], 5), ([np.nan], [True], 5), ([0.5], [True], 0)]
)
def test_bad_arguments(confidence: list[float], is_right: list[bool], bins: int) -> None:
    with pytest.raises(ValueError, match=r"^(is_right|confidence|bins): expected"):
        reliability(confidence, is_right, bins)


@given(st.integers(0, 1000))
def test_honest_confidences_have_a_small_error(seed: int) -> None:
    rng = np.random.default_rng(seed)
    confidence = rng.random(4000)
    assert expected_calibration_error(confidence, rng.random(4000) < confidence) < 0.05
    assert expected_calibration_error(confidence, rng.random(4000) < confidence**4) > 0.2


def test_normalised_error_by_hand() -> None:
    covariance = np.diag([0.01, 0.04, 0.09])
    estimate = np.array([[math.pi - 0.05, 1.0, 2.0], [0.0, 0.0, 0.0]])
    truth = np.array([[-math.pi + 0.05, 1.2, 2.3], [0.0, np.nan, 0.0]])
    found = normalised_error(estimate, truth, np.stack([covariance] * 2))
    assert found[0] == pytest.approx(0.01 / 0.01 + 1 + 1)
    assert math.isnan(found[1])


def test_normalised_error_of_unlike_sizes() -> None:
    """Where one direction is not observed the covariance has entries of all sizes."""
    rng = np.random.default_rng(0)
    root = np.array([[1e-4, 0, 0], [2e-3, 1e-3, 0], [1.0, 20.0, 30.0]])
    errors = rng.normal(size=(500, 3)) @ root.T
    found = consistency(normalised_error(errors, np.zeros(3), np.broadcast_to(root @ root.T, (500, 3, 3))))
    assert found.low < found.mean < found.high
    assert found.within == pytest.approx(0.95, abs=0.03)
    assert found.median == pytest.approx(1, abs=0.2)


def test_consistency_by_hand() -> None:
    found = consistency([1.0, 2.0, 100.0])
    assert (found.count, found.mean, found.within) == (3, pytest.approx(103 / 3), pytest.approx(2 / 3))
    assert (found.low, found.high) == (pytest.approx(2.70 / 3, abs=1e-3), pytest.approx(19.02 / 3, abs=1e-2))  # chi2(9), tables
    assert found.median == pytest.approx(2 / 2.366, abs=1e-3)
    with pytest.raises(ValueError, match=r"^nees: expected"):
        consistency([])


@given(st.integers(0, 1000))
def test_rightness_is_that_of_the_metrics(seed: int) -> None:
    rng = np.random.default_rng(seed)
    pair = make_pair(40, 35, 2, rng, drop=0.1)
    for prediction in (perfect(pair), perturbed(pair, rng)):
        right, score = rightness(pair, prediction), score_pair(pair, prediction)
        assert right.known.sum() == score.association.points
        assert (right.within & right.known).sum() == score.within_2
        assert (right.cluster & right.known).sum() == score.cluster.right
