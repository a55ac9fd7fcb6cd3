"""Sides that slide along themselves: found by their ends, and moved as a whole."""

import numpy as np
import pytest
from hypothesis import given
from support import assert_close
from surveyed import any_scan, grids, seen

from torchcrf_scan import JointScanCRF, Scan
from torchcrf_scan.data.laser import cast
from torchcrf_scan.data.world import Shapes, box
from torchcrf_scan.search.leftover import leftover_of
from torchcrf_scan.search.sides import Sides, sliding_sides, straight_runs
from torchcrf_scan.search.surface import Surface

BEARINGS = np.radians(np.arange(-180, 180, 0.5))
YARD = np.array([(-15, -6, 20, -6), (20, -6, 20, 14), (20, 14, -15, 14), (-15, 14, -15, -6), (5, -6, 5, -4), (8, -4, 5, -4)], float)
TRAVEL = 0.8
NOISE = 0.01


def ranges_of(outlines: list[np.ndarray], seed: int, bearings: np.ndarray = BEARINGS) -> np.ndarray:
    """(B,) what a standing sensor measures in the yard."""
    rng = np.random.default_rng(seed)
    return cast(Shapes.of([YARD, *outlines]), bearings, 0, rng).ranges + NOISE * rng.standard_normal(len(bearings))


def vehicle(x: float, y: float, length: float) -> np.ndarray:
    """(4, 4) outline of a vehicle two metres wide whose near side is on the line at y."""
    return box(length, 2.0) + np.tile([x, y + 1.0], 2)


def passes(length: float, y: float, x: float, travel: float = TRAVEL) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(B,) ranges before and after, and (B,) bool, the returns of the vehicle."""
    before, after = (ranges_of([vehicle(x + k * travel, y, length)], k) for k in range(2))
    return before, after, before < ranges_of([], 0) - 0.3


def scan_of(ranges: np.ndarray, bearings: np.ndarray = BEARINGS) -> Surface:
    points = ranges[:, None] * np.stack([np.cos(bearings), np.sin(bearings)], axis=1)
    return seen(points, NOISE, closed=len(bearings) == len(BEARINGS))


def slides(before: np.ndarray, after: np.ndarray, bearings: np.ndarray = BEARINGS) -> Sides:
    """The sides that slide between two scans of a standing sensor."""
    source, target = grids(scan_of(before, bearings), scan_of(after, bearings))
    return sliding_sides(leftover_of(source, target, np.zeros(3)))


PASSING = [(4, 1.2, 0.0), (4, 2.5, 3.0), (4, 1.2, 6.0), (6, 1.2, 0.0), (6, 1.2, 3.0), (10, 2.0, 3.0)]


@pytest.mark.parametrize(("length", "y", "x"), PASSING)
@pytest.mark.parametrize("travel", [TRAVEL, -TRAVEL])
def test_a_side_moves_as_its_ends_do(length: float, y: float, x: float, travel: float) -> None:
    before, after, on = passes(length, y, x, travel)
    found = slides(before, after)
    assert len(found.motions) == 1
    assert_close(found.motions[0], [0.0, travel, 0.0], tolerance=0.15)  # ends are seen to a beam
    members = found.groups.members
    assert on[members].mean() > 0.98
    is_side = on & (np.abs(before * np.sin(BEARINGS) - y) < 4 * NOISE)
    assert np.isin(np.flatnonzero(is_side), members).mean() > 0.95


@pytest.mark.parametrize(("length", "y", "x"), PASSING)
def test_what_hangs_together_with_moving_ends_moves_with_them(length: float, y: float, x: float) -> None:
    before, after, on = passes(length, y, x)
    answer = JointScanCRF.from_pretrained().match(*(Scan.from_ranges(r, BEARINGS, range_max=40.0) for r in (before, after)), dt=0.1)
    assert len(answer.motions) == 2
    assert (answer.cluster[on] == 1).mean() > 0.9
    assert (answer.cluster[~on] == 1).mean() < 0.01
    assert_close(answer.motions, [[0, 0, 0], [0, TRAVEL, 0]], tolerance=0.15)


def test_both_engines_move_it_alike() -> None:
    before, after, on = passes(6, 1.2, 3.0)
    scans = [Scan.from_ranges(r, BEARINGS, range_max=40.0) for r in (before, after)]
    one, other = (JointScanCRF.from_pretrained(backend=backend).match(*scans, dt=0.1) for backend in ("auto", "eager"))
    assert (one.cluster[on] == 1).mean() > 0.9
    assert (one.cluster == other.cluster).all()
    assert_close(one.motions, other.motions, tolerance=1e-3)


def test_an_end_that_stands_still_holds_its_side() -> None:
    """It has grown longer, which nothing rigid does."""
    before, after = (ranges_of([vehicle(0.5 * extra, 1.5, 3.0 + extra)], k) for k, extra in enumerate((0.0, 1.0)))
    assert len(slides(before, after).motions) == 0


def test_nothing_slides_where_nothing_moves() -> None:
    before, after, _ = passes(6, 1.2, 0.0, travel=0.0)
    assert len(slides(before, after).motions) == 0


def test_a_side_that_comes_out_from_behind_something_does_not_slide() -> None:
    wall = [vehicle(0.0, 3.0, 6.0)]
    screens = [np.array([[x, 1.5, x + 1.5, 1.5]]) for x in (0.8, 1.6)]  # hides another part of the wall in every scan
    before, after = (ranges_of([*wall, screen], k) for k, screen in enumerate(screens))
    found = slides(before, after)
    for k in range(len(found.motions)):
        members = found.groups.members[found.groups.start[k] : found.groups.start[k + 1]]
        assert (np.abs(before[members] * np.sin(BEARINGS[members]) - 1.5) < 4 * NOISE).all()  # the screen moves, not the wall


def test_a_side_without_ends_in_view_is_left_as_it_is() -> None:
    ahead = BEARINGS[np.abs(BEARINGS - np.pi / 2) < 0.6]
    before, after = (ranges_of([vehicle(k * TRAVEL, 1.2, 8.0)], k, ahead) for k in range(2))
    assert len(slides(before, after, ahead).motions) == 0


def test_runs_end_at_corners_and_jumps() -> None:
    bearing = np.radians(np.arange(-60, 61))
    corner = np.minimum(4.0 / np.cos(bearing), 4.0 / np.maximum(np.abs(np.sin(bearing)), 1e-9))  # three walls, at right angles
    corner[55:66] = 2.0 / np.cos(bearing[55:66])  # and a board before the second one
    runs = straight_runs(seen(corner[:, None] * np.stack([np.cos(bearing), np.sin(bearing)], axis=1)), 0.02)
    found = sorted(runs.tolist())
    assert found == [[0, 15], [15, 54], [55, 65], [66, 105], [105, 120]]


@given(any_scan())
def test_runs_are_in_line(scan: Surface) -> None:
    for first, last in straight_runs(scan, 0.05):
        chord, arms = scan.points[last] - scan.points[first], scan.points[first : last + 1] - scan.points[first]
        away = chord[0] * arms[:, 1] - chord[1] * arms[:, 0]
        assert (np.abs(away) <= 0.05 * max(np.hypot(*chord), 1e-9) + 1e-12).all()
