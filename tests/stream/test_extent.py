"""Boxes and partial views of them."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from torchcrf_scan.stream import extent as box

CAR = np.array([4.0, 2.0])
NOISE = np.full(2, 0.01)


def seen(low: tuple[float, float], high: tuple[float, float]) -> box.Interval:
    return box.Interval(np.array(low), np.array(high))


def test_what_points_cover_along_and_across_a_heading() -> None:
    points = np.array([[1.0, 1.0], [1.0, 4.0], [2.0, 2.0]])
    found = box.cover(points, np.array([1.0, 2.0]), np.pi / 2)
    np.testing.assert_allclose(found.low, [-1, -1], atol=1e-12)
    np.testing.assert_allclose(found.high, [2, 0], atol=1e-12)
    np.testing.assert_allclose(found.middle, [0.5, -0.5], atol=1e-12)
    np.testing.assert_allclose(found.size, [3, 1], atol=1e-12)


@given(st.integers(1, 4), st.integers(1, 4), st.integers(0, 2**16))
def test_many_at_once_as_one_by_one(n_boxes: int, n_clusters: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    clusters = [rng.normal(0, 3, (rng.integers(1, 6), 2)) for _ in range(n_clusters)]
    centres, headings = rng.normal(0, 3, (n_boxes, 2)), rng.uniform(-4, 4, n_boxes)
    starts = np.cumsum([0, *(len(of) for of in clusters[:-1])])
    all_of_them = box.covers(np.concatenate(clusters), starts, centres, headings)
    assert all_of_them.low.shape == (n_boxes, n_clusters, 2)
    for t in range(n_boxes):
        for k in range(n_clusters):
            one = box.cover(clusters[k], centres[t], headings[t])
            np.testing.assert_allclose(all_of_them.low[t, k], one.low, atol=1e-12)
            np.testing.assert_allclose(all_of_them.high[t, k], one.high, atol=1e-12)


def test_points_within_a_box_are_not_apart_from_it() -> None:
    np.testing.assert_array_equal(box.gap(seen((-2, 0.5), (-1, 1)), CAR), 0)
    np.testing.assert_array_equal(box.gap(seen((-3, -1), (3, 1)), CAR), 0)  # a box within the points
    np.testing.assert_allclose(box.gap(seen((3, -4), (4, -3.5)), CAR), [2, -3])


def test_a_face_that_the_sensor_sees_places_the_box() -> None:
    view = box.look(seen((-2.3, -0.9), (-2.2, 0.9)), CAR, np.array([-20.0, 0.0]), NOISE)  # the rear, from behind
    np.testing.assert_allclose(view.shift[0], -0.3)
    np.testing.assert_array_equal(view.is_seen, [True, False])
    np.testing.assert_array_equal(view.excess, 0)
    view = box.look(seen((1.7, -0.9), (1.8, 0.9)), CAR, np.array([20.0, 0.0]), NOISE)  # the front, from ahead
    np.testing.assert_allclose(view.shift[0], -0.2)


def test_points_within_the_box_tell_nothing_without_the_sensor() -> None:
    view = box.look(seen((-1, -0.5), (1, 0.5)), CAR, None, NOISE)
    np.testing.assert_array_equal(view.is_seen, False)
    np.testing.assert_array_equal(view.excess, 0)


def test_points_beyond_push_the_box() -> None:
    view = box.look(seen((-1, -0.5), (2.5, 0.5)), CAR, None, NOISE)
    np.testing.assert_allclose(view.shift[0], 0.5)
    np.testing.assert_array_equal(view.is_seen, [True, False])


def test_a_box_grows_away_from_the_face_that_is_seen() -> None:
    view = box.look(seen((-2, -1), (3, 1)), CAR, np.array([-20.0, 0.0]), NOISE)
    np.testing.assert_allclose(view.excess, [1, 0])
    assert view.side[0] == 1  # its rear stays
    np.testing.assert_allclose(view.shift, [0, 0])
    view = box.look(seen((-2, -1), (3, 1)), CAR, np.array([0.0, 9.0]), NOISE)  # from beside: no motion is read from the growth
    assert not view.is_seen[0]
    assert view.side[0] == 1


@given(
    st.tuples(st.floats(-5, 5), st.floats(-5, 5)),
    st.tuples(st.floats(0, 6), st.floats(0, 6)),
    st.none() | st.tuples(st.floats(-9, 9), st.floats(-9, 9)),
)
def test_a_box_that_is_moved_as_seen_covers_its_points(low, size, sensor) -> None:
    points = seen(low, tuple(np.add(low, size)))
    view = box.look(points, CAR, None if sensor is None else np.array(sensor), NOISE)
    assert (view.excess >= 0).all()
    assert (np.abs(view.side) <= 1).all()
    fits = view.is_seen & (points.size <= CAR)
    assert (points.high - view.shift <= CAR / 2 + 1e-9)[fits].all()
    assert (points.low - view.shift >= -CAR / 2 - 1e-9)[fits].all()
