"""Nearest points through boxes, against looking at every point."""

import numpy as np
import oracles_search as oracles
from hypothesis import given
from hypothesis import strategies as st
from support import make_points, normal

from torchcrf_scan.loops.nearest import box_distance, boxes_of, nearest, nearest_within

SEEDS = st.integers(0, 10_000)


@given(st.integers(1, 9) | st.integers(60, 200), st.booleans(), st.booleans(), SEEDS)
def test_the_nearest_point(count: int, twice: bool, in_line: bool, seed: int) -> None:
    points = make_points(count, seed).numpy()
    points = np.repeat(points, 2, axis=0) if twice else points
    points[:, 0] = 2.0 if in_line else points[:, 0]
    boxes = boxes_of(points)
    for place in (4 * normal(8, 2, seed=seed)).tolist():
        distance, first = oracles.nearest(points, place)
        for guess in (-1, 0, len(points) - 1, first):
            squared, index = nearest(boxes, *place, guess)
            np.testing.assert_allclose(squared, distance**2, rtol=1e-12, atol=1e-15)
            assert index == first
        reach = 0.7 * distance**2
        assert nearest_within(boxes, *place, -1, reach) == (reach, -1)
        assert nearest_within(boxes, *place, 0, 2 * distance**2 + 1e-9)[1] == first


@given(st.floats(-3, 3), st.floats(-3, 3))
def test_the_distance_to_a_box(x: float, y: float) -> None:
    box = np.array([-1.0, -0.5, 1.0, 0.5])
    inside = np.clip([x, y], box[:2], box[2:])
    np.testing.assert_allclose(box_distance(box, x, y), np.sum((np.array([x, y]) - inside) ** 2), rtol=1e-12)
