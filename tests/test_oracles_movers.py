"""The oracles of the search for movers against numbers worked out by hand."""

import math

import numpy as np
import oracles_movers as oracles
import pytest
from oracles_search import surface
from test_oracles_search import DEGREE, ring


def test_ends_and_samples_of_sets() -> None:
    assert oracles.ends([2, 3, 5], 10) == (2, 5)
    assert oracles.ends([0, 1, 8, 9], 10) == (8, 1)
    assert oracles.spread([1, 2, 3], 3) == [1, 2, 3]
    assert oracles.spread(list(range(10)), 4) == [0, 2, 5, 7]
    assert oracles.share_in_common([1, 2, 3, 4], [3, 4, 5]) == pytest.approx(2 / 3)
    assert oracles.share_in_common([], [1]) == 0.0


def test_groups_of_a_wall_with_a_post() -> None:
    scan = surface(ring([5.0] * 4 + [2.0] * 3 + [5.0] * 4), 0.0, closed=False)
    assert oracles.groups(scan, [0.0] * 11) == set()
    assert oracles.groups(scan, [0.0] * 4 + [2.0] * 3 + [0.0] * 4) == {(4, 5, 6)}
    assert oracles.groups(scan, [1.0] * 3 + [0.0] * 8) == set()  # on average 0.75
    assert oracles.groups(scan, [1.3] * 3 + [0.0] * 8) == {(0, 1, 2, 3)}  # on average 0.975
    half = [2.0] * 3 + [0.0] * 8
    assert oracles.groups(surface(ring([5.0] * 11), 0.0, closed=False), half) == {tuple(range(11)), (0, 1, 2)}


def test_neighbouring_sets_that_are_near_may_be_one() -> None:
    scan = surface(ring([5.0] * 3 + [4.4] * 3), 0.0, closed=False)
    assert scan.segment == [0] * 3 + [1] * 3
    assert oracles.groups(scan, [2.0] * 6) == {(0, 1, 2), (3, 4, 5), tuple(range(6))}  # 0.6 m apart, 8 footprints are 0.7 m


def test_features_of_a_post_that_stepped_aside() -> None:
    """Three beams of a post, 2 m away, before a wall, 5 m away, turned by six beams."""
    before, after = [5.0] * 5 + [2.0] * 3 + [5.0] * 13, [5.0] * 11 + [2.0] * 3 + [5.0] * 7
    source, target = (surface(ring(ranges), 0.0, closed=False) for ranges in (before, after))
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
    source, target = (surface(ring(ranges), 0.0, closed=False) for ranges in (before, after))
    scene = oracles.Scene(source, target, (0.0, 0.0, 0.0))
    motions = [(6 * DEGREE, 0.0, 0.0), (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)]
    right, wrong, wall = oracles.hypothesis_features(scene, motions, [[5, 6, 7], [5, 6, 7], [14, 15, 16]])
    assert right["total_gain_to_best"] == 0
    assert wrong["total_gain_to_best"] == pytest.approx(-math.log(10))
    assert wrong["residual_to_best"] == pytest.approx(3.0)
    assert wall["total_gain_to_best"] == wall["residual_to_best"] == 0


def test_which_are_accepted() -> None:
    before, after = [5.0] * 5 + [2.0] * 3 + [5.0] * 13, [5.0] * 11 + [2.0] * 3 + [5.0] * 7
    source, target = (surface(ring(ranges), 0.0, closed=False) for ranges in (before, after))
    scene = oracles.Scene(source, target, (0.0, 0.0, 0.0))
    motions = [(0.0, 0.0, 0.0), (6 * DEGREE, 0.0, 0.0), (0.0, 0.0, 0.0), (0.0, 50.0, 0.0)]
    members = [[5, 6, 7], [5, 6, 7], [17, 18, 19], [0, 1, 2]]
    found = [oracles.accept(scene, motions, members, [0.8, 0.9, 0.7, 0.1], least, 3) for least in (0.5, 0.75, 0.95)]
    assert found == [[1, 2], [1], []]
    assert oracles.accept(scene, motions, members, [0.8, 0.9, 0.7, 0.1], 0.0, 1) == [1]


def test_the_motion_of_a_post_among_others() -> None:
    before, after = [5.0] * 5 + [2.0] * 3 + [5.0] * 13, [5.0] * 11 + [2.0] * 3 + [5.0] * 7
    source, target = (surface(ring(ranges), 0.0, closed=False) for ranges in (before, after))
    scene = oracles.Scene(source, target, (0.0, 0.0, 0.0))
    centre, landed = ring(before)[5:8].mean(0), ring(after)[11:14].mean(0)
    found = oracles.hypothesise(scene, 1.0)
    alone = [motion for members, motion in found if members == (5, 6, 7)]
    assert 1 < len(alone) <= 5
    away = [math.dist(oracles.move(motion, centre), landed) for motion in alone]
    assert min(away) < 0.01
    still = [motion for members, motion in oracles.hypothesise(scene, 1e-4) if members == (5, 6, 7)]
    assert len(still) == 1  # nobody moves 45 m/s for a tenth of a millisecond
    marks = oracles.marks(ring(before), (5, 6, 7))
    assert np.array(marks) == pytest.approx(np.array([centre, ring(before)[5], ring(before)[7]]))
    shifts = oracles.best_shifts(target, ring(before)[5:8], [np.zeros(2), landed - centre, landed - centre + 1e-3], 0.1)
    assert [shift.tolist() for shift in shifts] == [(landed - centre).tolist(), [0.0, 0.0]]
