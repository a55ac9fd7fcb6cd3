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
