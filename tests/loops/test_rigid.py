"""Motions one at a time, against those of arrays of motions."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support import normal

from torchcrf_scan.geometry import se2
from torchcrf_scan.loops import rigid


@given(st.floats(-7, 7), st.integers(0, 10_000))
def test_they_are_those_of_arrays(theta: float, seed: int) -> None:
    one, other = normal(2, 3, seed=seed).numpy()
    one[0] += theta
    points = normal(5, 2, seed=seed).numpy()
    np.testing.assert_allclose(rigid.apply(one, points), se2.apply(one, points), atol=1e-12)
    for found, expected in ((rigid.compose(one, other), se2.compose(one, other)), (rigid.inverse(one), se2.inverse(one))):
        assert abs(se2.wrap(found[0] - expected[0])) < 1e-12
        np.testing.assert_allclose(found[1:], expected[1:], atol=1e-12)
    np.testing.assert_allclose(rigid.apply(rigid.inverse(one), rigid.apply(one, points)), points, atol=1e-12)


@pytest.mark.parametrize(("angle", "wrapped"), [(0.0, 0.0), (math.pi, math.pi), (-math.pi, math.pi), (4.0, 4.0 - math.tau)])
def test_wrap(angle: float, wrapped: float) -> None:
    assert rigid.wrap(angle) == pytest.approx(wrapped)


def test_a_motion_of_given_rotation_takes_a_point_onto_another() -> None:
    motion = rigid.motion_onto(0.7, 1.0, -2.0, 3.0, 0.5)
    assert motion[0] == 0.7
    np.testing.assert_allclose(rigid.apply(motion, np.array([[1.0, -2.0]])), [[3.0, 0.5]], atol=1e-12)


def test_rows_and_steps_in_place_agree_with_apply_and_compose() -> None:
    points, motion, step = np.array([[1.0, 2.0], [-0.5, 3.0], [4.0, 0.0]]), np.array([0.4, 1.0, -2.0]), np.array([3.0, 0.2, 0.1])
    rows = np.empty((2, 3))
    rigid.apply_to_rows(motion, points, rows)
    np.testing.assert_allclose(rows.T, rigid.apply(motion, points), atol=1e-12)
    both = rigid.compose(step, motion)
    parting = rigid.parting(rigid.transform_of(both), rigid.transform_of(motion), 1.0, 2.0)
    moved = rigid.apply(step, rigid.apply(motion, points))
    np.testing.assert_allclose(rigid.apply(both, points), moved, atol=1e-12)
    np.testing.assert_allclose(parting, np.hypot(*(moved[0] - rows[:, 0])), atol=1e-12)
    rigid.compose_into(motion, step)
    np.testing.assert_allclose(motion, both, atol=1e-12)
