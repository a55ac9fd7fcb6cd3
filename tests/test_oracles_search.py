"""The oracles of the search against numbers worked out by hand."""

import math

import numpy as np
import oracles_search as oracles
import pytest

DEGREE = math.radians(1.0)


def ring(ranges: list[float], first: float = 0.0, step: float = DEGREE) -> np.ndarray:
    """Points at these ranges, a beam after the other."""
    angles = first + step * np.arange(len(ranges))
    return np.c_[np.array(ranges) * np.cos(angles), np.array(ranges) * np.sin(angles)]


WALL = ring([5.0] * 5)
CHORD = 10 * math.sin(DEGREE / 2)


def test_medians_and_inverses() -> None:
    assert oracles.lower_median([4.0, 1.0, 3.0, 2.0]) == 2.0
    assert oracles.invert((math.pi / 2, 1.0, 0.0)) == pytest.approx((-math.pi / 2, 0.0, 1.0))


def test_the_nearest_of_equals_is_the_first() -> None:
    points = np.array([[9.0, 9.0], [0.0, 1.0], [0.0, -1.0]])
    assert oracles.nearest(points, (0.0, 0.0)) == (1.0, 1)
    assert oracles.nearest(points, (0.0, -1.5)) == (0.5, 2)


def test_the_surface_of_a_wall_and_of_a_post_before_it() -> None:
    found = oracles.surface(ring([5.0, 5.0, 2.0, 5.0]), 0.0, closed=False)
    assert found.joined == [True, False, False, False]
    assert found.segment == [0, 0, 1, 2]
    assert found.step == pytest.approx(DEGREE)
    assert found.spacing == pytest.approx([CHORD, CHORD, 2 * DEGREE, 5 * DEGREE])
    half = CHORD / 2 + 5 * DEGREE / 2
    assert found.length == pytest.approx([half, half, 2 * DEGREE, 5 * DEGREE])
    assert found.tangent[0] == pytest.approx((-math.sin(DEGREE / 2), math.cos(DEGREE / 2)))
    assert found.tangent[2] == (0.0, 0.0)
    assert found.units[2] == pytest.approx(DEGREE)


def test_a_closed_scan_goes_on_at_its_end() -> None:
    assert oracles.numbered([True, False, True, True]) == [0, 0, 0, 0]
    assert oracles.numbered([True, False, True, False]) == [0, 0, 1, 1]
    around = oracles.surface(ring([5.0] * 180 + [2.0] * 60 + [5.0] * 120), 0.0, closed=True)
    assert around.segment == [0] * 180 + [1] * 60 + [0] * 120
    assert around.bearings[-1] == pytest.approx(math.radians(359))


def test_pieces_are_cut_where_neighbours_are_far() -> None:
    points = ring([5.0, 5.0, 5.4, 5.4])  # 0.4 m is more than 2.5 footprints of 0.087 m, but no more than a flat wall may leave
    found = oracles.surface(points, 0.0, closed=False)
    assert found.segment == [0, 0, 0, 0]
    assert oracles.pieces(found) == [0, 0, 1, 1]


def test_what_beams_say_of_a_point() -> None:
    scan = oracles.surface(ring([5.0] * 5 + [8.0] * 5), 0.0, closed=False)
    places = {
        (4.0, 2.0): "seen through",
        (6.0, 2.0): "occluded",
        (5.0, 2.0): "agrees",
        (6.0, 4.5): "agrees",
        (4.0, -9.0): "occluded",
    }
    for (reach, degree), verdict in places.items():
        at = math.radians(degree)
        assert oracles.sight(scan, (reach * math.cos(at), reach * math.sin(at))) == verdict
    hole = oracles.surface(np.concatenate([ring([5.0] * 5), ring([5.0] * 5, 10 * DEGREE)]), 0.0, closed=False)
    assert oracles.sight(hole, (4 * math.cos(7 * DEGREE), 4 * math.sin(7 * DEGREE))) == "unmeasured"


def test_residuals() -> None:
    straight = np.array([[4.0, -0.2], [4.0, 0.0], [4.0, 0.2]])
    wall = oracles.surface(straight, 0.01, closed=False)
    assert oracles.point_residual(wall, (4.06, 0.0)) == pytest.approx((0.06 / 0.12, 1))
    assert oracles.point_residual(wall, (9.0, 0.0))[0] == 3.0
    assert oracles.surface_residual(wall, (4.06, 0.05)) == pytest.approx((0.06 / (0.1 * 0.2 + 0.02), 1))  # sliding is free
    assert oracles.surface_residual(wall, (4.0, 0.5))[0] == pytest.approx(0.2 / 0.04)  # but for what is beyond the end
    post = oracles.surface(np.array([[4.0, 0.0]]), 0.0, closed=False)
    unit = 0.5 * 4 * math.radians(0.5)
    assert oracles.surface_residual(post, (4.0, 0.1))[0] == pytest.approx(0.1 / unit)


def test_the_cost_of_a_motion() -> None:
    wall = oracles.surface(WALL, 0.0, closed=False)
    assert oracles.background_cost((0.0, 0.0, 0.0), wall, wall) == pytest.approx(0.0, abs=1e-9)
    closer = (2 * 6.0 + 3 * 1.5) / 5  # two are seen through, three lie beside the view; the other way all are hidden
    assert oracles.background_cost((0.0, -3.0, 0.0), wall, wall) == pytest.approx(closer + 1.5, abs=1e-4)
    assert oracles.one_way_cost((math.pi, 0.0, 0.0), wall, wall) == pytest.approx(1.5)  # the sensor does not look there
    nearer = oracles.one_way_cost((0.0, 0.001, 0.0), wall, wall)
    assert oracles.one_way_cost((0.0, 0.001, 0.0), wall, wall, slack=2.0) == pytest.approx(nearer / 2)


def test_a_gauss_newton_step_of_two_points() -> None:
    points, weights = np.array([[1.0, 0.0], [-1.0, 0.0]]), np.ones(2)
    turned, none = points + np.array([[0.0, 0.1], [0.0, -0.1]]), np.zeros((2, 2))
    theta, x, y = oracles.gauss_newton_step(points, turned, none, weights, 1.0)
    assert theta == pytest.approx(0.2 / (2 + 2e-4))
    assert (x, y) == pytest.approx((0.0, 0.0))
    along = np.array([[0.0, 1.0], [0.0, 1.0]])
    assert oracles.gauss_newton_step(points, points + 0.3, along, weights, 0.0) == pytest.approx((0.0, 0.6 / 2.002, 0.0), abs=1e-9)
    assert oracles.gauss_newton_step(points, 100 * turned[:, ::-1] * [-1, 1], none, weights, 1.0)[0] == 0.5
    assert oracles.gauss_newton_step(points, turned, none, 0 * weights, 1.0) == (0.0, 0.0, 0.0)


def test_registration_by_hand() -> None:
    assert oracles.follow((math.pi / 2, 1.0, 0.0), (math.pi, 0.0, 2.0)) == pytest.approx((-math.pi / 2, -1.0, 2.0))
    assert oracles.robust(0.3, 0.3) == 0.25
    post, moved = (oracles.surface(np.array([[x, 0.0]]), 0.0, closed=False) for x in (4.0, 4.1))
    found = oracles.register(post.points, np.ones(1), moved, (0.0, 0.0, 0.0), [1.0], [1.0])
    assert found == pytest.approx((0.0, 0.1 / 1.001, 0.0))
    assert oracles.register_both(post, moved, (0.0, 0.0, 0.0), [1.0], [1.0]) == pytest.approx((0.0, 0.1 / 1.001, 0.0))
    assert oracles.register(post.points, np.zeros(1), moved, (0.1, 0.2, 0.3), [1.0], [1.0]) == pytest.approx((0.1, 0.2, 0.3))
    assert oracles.unit_length(post, moved) == pytest.approx(4 * math.radians(0.5) / 2)
