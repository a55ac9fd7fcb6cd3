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
    assert theta == pytest.approx(0.2 / (2 + 2e-4 + 2e-6))
    assert (x, y) == pytest.approx((0.0, 0.0))
    along = np.array([[0.0, 1.0], [0.0, 1.0]])
    assert oracles.gauss_newton_step(points, points + 0.3, along, weights, 0.0) == pytest.approx((0.0, 0.6 / 2.002, 0.0), abs=1e-9)
    assert oracles.gauss_newton_step(points, 100 * turned[:, ::-1] * [-1, 1], none, weights, 1.0)[0] == 0.5
    assert oracles.gauss_newton_step(points, turned, none, 0 * weights, 1.0) == (0.0, 0.0, 0.0)


def test_registration_by_hand() -> None:
    assert oracles.follow((math.pi / 2, 1.0, 0.0), (math.pi, 0.0, 2.0)) == pytest.approx((-math.pi / 2, -1.0, 2.0))
    assert oracles.robust(0.3, 0.3) == 0.25
    post, moved = (oracles.surface(np.array([[x, 0.0]]), 0.0, closed=False) for x in (4.0, 4.1))
    found = oracles.register(post, np.ones(1), moved, (0.0, 0.0, 0.0), [1.0], [1.0])
    assert found == pytest.approx((0.0, 0.1 / 1.001, 0.0))
    assert oracles.register_both(post, moved, (0.0, 0.0, 0.0), [1.0], [1.0]) == pytest.approx((0.0, 0.1 / 1.001, 0.0))
    assert oracles.register(post, np.zeros(1), moved, (0.1, 0.2, 0.3), [1.0], [1.0]) == pytest.approx((0.1, 0.2, 0.3))


def test_ends_and_samples_of_sets() -> None:
    assert oracles.ends([2, 3, 5], 10) == (2, 5)
    assert oracles.ends([0, 1, 8, 9], 10) == (8, 1)
    assert oracles.spread([1, 2, 3], 3) == [1, 2, 3]
    assert oracles.spread(list(range(10)), 4) == [0, 2, 5, 7]
    assert oracles.share_in_common([1, 2, 3, 4], [3, 4, 5]) == pytest.approx(2 / 3)
    assert oracles.share_in_common([], [1]) == 0.0


def test_groups_of_a_wall_with_a_post() -> None:
    scan = oracles.surface(ring([5.0] * 4 + [2.0] * 3 + [5.0] * 4), 0.0, closed=False)
    assert oracles.groups(scan, [0.0] * 11) == set()
    assert oracles.groups(scan, [0.0] * 4 + [2.0] * 3 + [0.0] * 4) == {(4, 5, 6)}
    assert oracles.groups(scan, [1.0] * 3 + [0.0] * 8) == set()  # on average 0.75
    assert oracles.groups(scan, [1.3] * 3 + [0.0] * 8) == {(0, 1, 2, 3)}  # on average 0.975
    half = [2.0] * 3 + [0.0] * 8
    assert oracles.groups(oracles.surface(ring([5.0] * 11), 0.0, closed=False), half) == {tuple(range(11)), (0, 1, 2)}


def test_neighbouring_sets_that_are_near_may_be_one() -> None:
    scan = oracles.surface(ring([5.0] * 3 + [4.4] * 3), 0.0, closed=False)
    assert scan.segment == [0] * 3 + [1] * 3
    assert oracles.groups(scan, [2.0] * 6) == {(0, 1, 2), (3, 4, 5), tuple(range(6))}  # 0.6 m apart, 8 footprints are 0.7 m


def test_features_of_a_post_that_stepped_aside() -> None:
    """Three beams of a post, 2 m away, before a wall, 5 m away, turned by six beams."""
    before, after = [5.0] * 5 + [2.0] * 3 + [5.0] * 13, [5.0] * 11 + [2.0] * 3 + [5.0] * 7
    source, target = (oracles.surface(ring(ranges), 0.0, closed=False) for ranges in (before, after))
    scene = oracles.Scene(source, target, (0.0, 0.0, 0.0))
    (row,) = oracles.hypothesis_features(scene, [(6 * DEGREE, 0.0, 0.0)], [[5, 6, 7]])
    assert len(row) == 43
    unit, step = 4 * math.sin(DEGREE / 2) / 2, 4 * (1 + 2 * math.cos(DEGREE)) / 3 * math.sin(3 * DEGREE)  # of the centroid
    sure = ("share_of_segment", "share_of_piece", "explained", "open_before", "landing_open", "target_cover", "stands_out")
    sure += ("landing_piece_cover", "landing_stands_out", "seen_through_before", "unexcused", "landing_unexcused", "unexcused_both")
    assert {name: row[name] for name in sure} == dict.fromkeys(sure, 1.0)
    none = ("occluded_before", "seen_through", "occluded", "landing_occluded_before")
    none += ("residual_to_best", "total_gain_to_best", "target_total_gain_to_best")
    assert {name: row[name] for name in none} == pytest.approx(dict.fromkeys(none, 0.0))
    assert row["size"] == pytest.approx(math.log(3))
    assert row["range"] == pytest.approx(math.log(2 / 5))
    assert row["residual"] == pytest.approx(0.0, abs=1e-9)
    assert row["gain"] == row["target_gain"] == pytest.approx(3.0)
    assert row["total_gain"] == row["fair_gain"] == row["target_total_gain"] == pytest.approx(math.log(10))
    assert row["gain_both_ways"] == pytest.approx(math.log(19))
    assert row["distinct"] == pytest.approx(math.log(2))
    assert row["target_open"] == pytest.approx(math.log(4))
    assert row["displacement"] == pytest.approx(math.log1p(step / unit))
    assert row["displacement_in_spacings"] == pytest.approx(math.log1p(step / (2 * DEGREE)))
    assert row["displacement_in_range"] == pytest.approx(step / 2)
    assert row["rotation"] == pytest.approx(math.log1p(6 * DEGREE / 0.1))
    assert row["linearity"] == pytest.approx(1.0, abs=0.02)
    long = 4 * math.sin(DEGREE / 2) * math.sqrt(2 / 3)
    assert row["extent"] == pytest.approx(math.log1p(long / unit), abs=1e-3)
    assert row["displacement_in_extent"] == pytest.approx(math.log1p(step / long), abs=1e-3)
    assert row["along_surface"] == pytest.approx(1.0, abs=0.01)
    assert row["scene_open"] == pytest.approx(3 / 18)  # the wall that the post hides now
    assert row["units_around"] == pytest.approx((2 + 3 + 2 + 2) / (18 + 3))  # two of these have a neighbour of the wall


def test_rivals_are_those_that_move_the_same_points() -> None:
    before, after = [5.0] * 5 + [2.0] * 3 + [5.0] * 13, [5.0] * 11 + [2.0] * 3 + [5.0] * 7
    source, target = (oracles.surface(ring(ranges), 0.0, closed=False) for ranges in (before, after))
    scene = oracles.Scene(source, target, (0.0, 0.0, 0.0))
    motions = [(6 * DEGREE, 0.0, 0.0), (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)]
    right, wrong, wall = oracles.hypothesis_features(scene, motions, [[5, 6, 7], [5, 6, 7], [14, 15, 16]])
    assert right["total_gain_to_best"] == 0
    assert wrong["total_gain_to_best"] == pytest.approx(-math.log(10))
    assert wrong["residual_to_best"] == pytest.approx(3.0)
    assert wall["total_gain_to_best"] == wall["residual_to_best"] == 0


def test_which_are_accepted() -> None:
    before, after = [5.0] * 5 + [2.0] * 3 + [5.0] * 13, [5.0] * 11 + [2.0] * 3 + [5.0] * 7
    source, target = (oracles.surface(ring(ranges), 0.0, closed=False) for ranges in (before, after))
    scene = oracles.Scene(source, target, (0.0, 0.0, 0.0))
    motions = [(0.0, 0.0, 0.0), (6 * DEGREE, 0.0, 0.0), (0.0, 0.0, 0.0), (0.0, 50.0, 0.0)]
    members = [[5, 6, 7], [5, 6, 7], [17, 18, 19], [0, 1, 2]]
    found = [oracles.accept(scene, motions, members, [0.8, 0.9, 0.7, 0.1], least, 3) for least in (0.5, 0.75, 0.95)]
    assert found == [[1, 2], [1], []]
    assert oracles.accept(scene, motions, members, [0.8, 0.9, 0.7, 0.1], 0.0, 1) == [1]
