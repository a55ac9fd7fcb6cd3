"""The filter against textbook values, and consistent on tracks drawn from its own model."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import chi2

from torchcrf_scan.stream import filter as kalman


def test_a_prediction_moves_by_the_velocity_and_becomes_less_certain() -> None:
    state, covariance = kalman.predict(np.array([1.0, 2.0, 3.0, -4.0]), np.eye(4), 0.5, 2.0)
    np.testing.assert_allclose(state, [2.5, 0.0, 3.0, -4.0])
    np.testing.assert_allclose(covariance[0, 0], 1 + 0.25 + 4 * 0.125 / 3)
    np.testing.assert_allclose(covariance[2, 2], 1 + 4 * 0.5)
    np.testing.assert_allclose(covariance[0, 2], 0.5 + 4 * 0.125)
    np.testing.assert_array_equal(covariance[0, [1, 3]], 0)


@given(st.floats(-10, 0), st.floats(0.1, 3))
def test_no_time_and_a_time_before_change_nothing(dt: float, acceleration: float) -> None:
    state, covariance = np.arange(4.0), np.diag([1.0, 2.0, 3.0, 4.0])
    after = kalman.predict(state, covariance, dt, acceleration)
    np.testing.assert_array_equal(after[0], state)
    np.testing.assert_array_equal(after[1], covariance)


@given(st.floats(0.01, 0.5), st.floats(0.01, 0.5), st.floats(0.1, 3))
def test_two_steps_are_as_good_as_one(first: float, second: float, acceleration: float) -> None:
    start = np.arange(4.0), np.diag([1.0, 2.0, 3.0, 4.0])
    twice = kalman.predict(*kalman.predict(*start, first, acceleration), second, acceleration)
    once = kalman.predict(*start, first + second, acceleration)
    np.testing.assert_allclose(twice[0], once[0])
    np.testing.assert_allclose(twice[1], once[1], atol=1e-12)


def test_an_update_weighs_by_certainty() -> None:
    H = np.eye(4)[:1]
    state, covariance = kalman.update(np.zeros(4), 3.0 * np.eye(4), np.array([4.0]), H, np.array([[1.0]]))
    np.testing.assert_allclose(state, [3.0, 0, 0, 0])
    np.testing.assert_allclose(np.diag(covariance), [0.75, 3, 3, 3])


def test_errors_on_its_own_model_have_the_covariance_that_it_states() -> None:
    rng, nees, H, R = np.random.default_rng(0), [], np.eye(4), np.diag([0.01, 0.04, 0.09, 0.02])
    noise = np.linalg.cholesky(kalman.predict(np.zeros(4), np.zeros((4, 4)), 0.1, 1.5)[1])
    for _ in range(40):
        true, estimate = rng.normal(0, 1, 4), (np.zeros(4), np.eye(4))
        for _ in range(20):
            true = kalman.predict(true, np.zeros((4, 4)), 0.1, 1.5)[0] + noise @ rng.normal(0, 1, 4)
            estimate = kalman.predict(*estimate, 0.1, 1.5)
            measured = true + np.sqrt(np.diag(R)) * rng.normal(0, 1, 4)
            estimate = kalman.update(*estimate, measured - estimate[0], H, R)
        nees.append(kalman.chi_square(true - estimate[0], estimate[1]))
    low, high = chi2.ppf([0.005, 0.995], 4 * len(nees)) / len(nees)
    assert low < np.mean(nees) < high


@given(st.lists(st.floats(-5, 5), min_size=2, max_size=2), st.floats(0.1, 3), st.floats(-0.9, 0.9))
def test_distances_are_those_of_the_inverse(r: list[float], scale: float, correlation: float) -> None:
    S = scale * np.array([[1.0, correlation], [correlation, 1.0]])
    expected = np.array(r) @ np.linalg.inv(S) @ np.array(r)
    assert kalman.chi_square(np.array(r), S) == pytest.approx(expected, abs=1e-9)
