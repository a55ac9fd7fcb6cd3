"""Velocities in the world, from motions between two frames of a moving sensor."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from torchcrf_scan.geometry import se2
from torchcrf_scan.stream.sightings import UNKNOWN, sightings_of

POSE = st.tuples(st.floats(-3, 3), st.floats(-9, 9), st.floats(-9, 9)).map(np.array)
POINTS = np.array([[1.0, 2.0], [1.5, 2.5], [4.0, -1.0], [4.2, -1.1], [9.0, 9.0]])
CLUSTER = np.array([1, 1, 2, 2, 0])
SINCE = 0.2


@given(POSE, POSE, st.floats(-3, 3), st.floats(-3, 3))
def test_velocities_and_points_are_those_of_the_world(now: np.ndarray, before: np.ndarray, vx: float, vy: float) -> None:
    background = se2.compose(se2.inverse(before), now)  # from the new scan's frame into the earlier one's
    back = np.array([0.0, -SINCE * vx, -SINCE * vy])  # where the mover was, in the world
    mover = se2.compose(se2.inverse(before), se2.compose(back, now))
    found = sightings_of(POINTS, CLUSTER, np.stack([background, mover, background]), None, now, SINCE)
    np.testing.assert_allclose(found.velocities, [[vx, vy], [0, 0]], atol=1e-9)
    np.testing.assert_allclose(found.points, se2.apply(now, POINTS))
    np.testing.assert_array_equal(found.sensor, now[1:])
    np.testing.assert_allclose(found.covariances, np.tile(UNKNOWN * np.eye(2), (2, 1, 1)), atol=1e-3)


@given(POSE, POSE)
def test_covariances_are_those_of_many_draws(now: np.ndarray, before: np.ndarray) -> None:
    rng = np.random.default_rng(0)
    background = se2.compose(se2.inverse(before), now)
    motions = np.stack([background, background])
    roots = np.array([np.diag([0.002, 0.01, 0.02]), [[0.01, 0, 0], [0.01, 0.02, 0], [-0.02, 0.01, 0.04]]])
    stated = sightings_of(POINTS, CLUSTER[:] == 1, motions, roots @ roots.mT, now, SINCE).covariances[0]
    drawn = motions + (roots @ rng.normal(0, 1, (4000, 2, 3, 1)))[..., 0]
    of_draws = [sightings_of(POINTS, CLUSTER == 1, of, None, now, SINCE).velocities[0] for of in drawn]
    np.testing.assert_allclose(np.cov(np.array(of_draws).T), stated, atol=0.1 * np.trace(stated))


def test_a_mover_without_points_has_no_velocity_and_no_movers_have_none() -> None:
    found = sightings_of(POINTS, np.zeros(5, dtype=np.int64), np.zeros((2, 3)), np.zeros((2, 3, 3)), np.zeros(3), SINCE)
    assert np.isnan(found.velocities).all()
    found = sightings_of(np.zeros((0, 2)), np.zeros(0, dtype=np.int64), np.zeros((1, 3)), None, np.zeros(3), SINCE)
    assert found.velocities.shape == (0, 2)
    assert found.covariances.shape == (0, 2, 2)
