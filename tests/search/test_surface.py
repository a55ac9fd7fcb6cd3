import math

import numpy as np
import oracles_search as oracles
import pytest
import torch
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from support import assert_close, make_points, normal, polar
from surveyed import NOISE, any_scan, oracle_of, seen
from torch import Tensor

from torchcrf_scan.geometry import se2
from torchcrf_scan.search.surface import AGREES, OCCLUDED, SEEN_THROUGH, UNMEASURED, Surface, look_along


def degrees(first: float, last: float, count: int) -> Tensor:
    return torch.linspace(math.radians(first), math.radians(last), count, dtype=torch.float64)


def wall(x: Tensor | float, bearings: Tensor) -> Tensor:
    """Points of a wall across the sensor's view, x metres ahead."""
    return polar(x / bearings.cos(), bearings)


def ring(first: float = -180.0, count: int = 360, radius: Tensor | float = 5.0) -> Tensor:
    bearings = degrees(first, first + 360.0 * (count - 1) / count, count)
    return polar(radius * torch.ones(count, dtype=torch.float64), bearings)


def surface(points: Tensor, closed: bool = False) -> Surface:
    return seen(points, closed=closed)


def numbers(scan: Surface) -> list[int]:
    """Of the segments, each once."""
    return np.unique(scan.segment).tolist()


# Segments, spacing, tangents.


def test_a_wall_is_one_segment() -> None:
    bearings = degrees(-40, 40, 161)
    found = surface(wall(5.0, bearings))
    assert found.segment.tolist() == [0] * 161
    assert_close(found.tangent, torch.tensor([0.0, 1.0]).expand(161, 2))
    assert_close(found.ranges, 5.0 / bearings.cos())
    assert_close(found.bearings, bearings)
    assert_close(found.step, math.radians(0.5))
    assert len(found.points) == 161
    gap = np.linalg.norm(np.diff(found.points, axis=0), axis=-1)
    assert_close(found.spacing, np.concatenate([gap[:1], np.minimum(gap[1:], gap[:-1]), gap[-1:]]))
    ends = 5.0 / math.cos(math.radians(40)) * math.radians(0.5)  # half a footprint at either end
    assert_close(found.length.sum(), 10 * math.tan(math.radians(40)) + ends)


def test_segments_end_at_depth_jumps() -> None:
    ranges = torch.tensor([5.0] * 30 + [2.0] * 20 + [8.0] * 31, dtype=torch.float64)
    found = surface(polar(ranges, degrees(-20, 20, 81)))
    assert found.segment.tolist() == [0] * 30 + [1] * 20 + [2] * 31
    chord = 2 * ranges * math.sin(math.radians(0.25))
    assert_close(found.spacing, chord)  # never across the jump
    assert_close(np.linalg.norm(found.tangent, axis=-1), torch.ones(81))
    across = np.abs((found.tangent * found.points).sum(-1)) / ranges.numpy()
    assert across.max() < 0.01  # an arc is met at a right angle, up to its ends


@pytest.mark.parametrize("scale", [0.1, 1.0, 10.0])
def test_noise_excuses_a_small_jump(scale: float) -> None:
    points = scale * polar(torch.tensor([5.0] * 10 + [5.6] * 10, dtype=torch.float64), degrees(-9, 10, 20))
    quiet, loud = (seen(points, scale * noise) for noise in (0.1 * NOISE, 2 * NOISE))
    assert numbers(quiet) == [0, 1]
    assert numbers(loud) == [0]


def test_missing_beams_split_a_wall_where_the_hole_is_wide() -> None:
    bearings = degrees(-30, 30, 121)
    narrow, wide = torch.arange(121) != 60, (torch.arange(121) - 60).abs() > 15
    assert numbers(surface(wall(5.0, bearings[narrow]))) == [0]
    assert numbers(surface(wall(5.0, bearings[wide]))) == [0, 1]


def test_a_ring_has_no_ends() -> None:
    found = surface(ring(), closed=True)
    assert found.segment.tolist() == [0] * 360
    assert_close(found.spacing, torch.full((360,), 10 * math.sin(math.radians(0.5)), dtype=torch.float64))
    assert_close(found.length.sum(), 3600 * math.sin(math.radians(0.5)))
    assert_close((found.tangent * found.points).sum(-1), torch.zeros(360))


def test_an_open_ring_has_ends() -> None:
    found = surface(ring(), closed=False)
    assert found.segment.tolist() == [0] * 360
    assert_close(
        found.length[[0, -1]], torch.full((2,), 5 * math.sin(math.radians(0.5)) + 2.5 * math.radians(1)).double(), tolerance=1e-6
    )


def test_segments_lead_round_a_closed_scan() -> None:
    radius = torch.tensor([5.0] * 100 + [2.0] * 50 + [5.0] * 210, dtype=torch.float64)
    points = ring(radius=radius)
    assert surface(points, closed=True).segment.tolist() == [0] * 100 + [1] * 50 + [0] * 210
    assert surface(points, closed=False).segment.tolist() == [0] * 100 + [1] * 50 + [2] * 210


@pytest.mark.parametrize("first", [-180.0, -90.0, 0.0, 30.0])
@pytest.mark.parametrize("count", [360, 720])
def test_bearings_rise_through_the_scan(first: float, count: int) -> None:
    points = ring(first, count)
    found = surface(points, closed=True)
    assert (np.diff(found.bearings) > 0).all()
    assert_close(found.bearings - found.bearings[0], degrees(0, 360 - 360 / count, count))
    assert_close(se2.wrap(found.bearings - torch.atan2(points[:, 1], points[:, 0]).numpy()), torch.zeros(count))


@pytest.mark.parametrize("short_by", [0.0, 1e-3, 4e-3])
def test_a_scan_whose_last_beam_is_the_first_again(short_by: float) -> None:
    radius = torch.tensor([5.0] * 100 + [2.0] * 50 + [5.0] * 211, dtype=torch.float64)
    found = surface(polar(radius, degrees(-180, 180 - short_by, 361)), closed=True)
    assert (np.diff(found.bearings) > 0).all()
    assert found.segment.tolist() == [0] * 100 + [1] * 50 + [0] * 211


def test_a_lonely_point() -> None:
    found = surface(torch.tensor([[3.0, 4.0]], dtype=torch.float64))
    assert found.segment.tolist() == [0]
    assert found.tangent.tolist() == [[0.0, 0.0]]
    footprint = 5.0 * found.step
    assert_close(found.spacing, [footprint])
    assert_close(found.length, [footprint])


def test_lonely_points_of_a_scan() -> None:
    ranges = torch.tensor([9.0, 9.0, 9.0, 3.0, 9.0, 9.0, 9.0], dtype=torch.float64)
    found = surface(polar(ranges, degrees(-3, 3, 7)))
    assert found.segment.tolist() == [0, 0, 0, 1, 2, 2, 2]
    assert found.tangent[3].tolist() == [0.0, 0.0]
    assert_close(found.spacing[3], 3 * math.radians(1))
    assert_close(found.length[3], 3 * math.radians(1))


@given(st.floats(0.05, 20), st.integers(2, 60), st.booleans(), st.integers(0, 10_000))
def test_the_unit_of_length_does_not_matter(scale: float, n: int, closed: bool, seed: int) -> None:
    smooth = polar(4 + make_points(n, seed)[:, 0] / 6, degrees(-170.3, 170.9, n))  # no step is the grazing angle itself
    found, scaled = seen(smooth, closed=closed), seen(scale * smooth, scale * NOISE, closed=closed)
    assert scaled.segment.tolist() == found.segment.tolist()
    assert_close(scaled.tangent, found.tangent)
    assert_close(scaled.spacing, scale * found.spacing)
    assert_close(scaled.length, scale * found.length)
    assert_close(scaled.step, found.step)


@given(st.floats(-3, 3), st.integers(2, 60), st.integers(0, 10_000))
@settings(max_examples=25)
def test_a_turned_sensor_sees_the_same_segments(theta: float, n: int, seed: int) -> None:
    points = polar(4 + make_points(n, seed)[:, 0] / 6, degrees(-120, 120, n))
    turn = torch.tensor([theta, 0.0, 0.0], dtype=torch.float64)
    found, turned = surface(points), surface(se2.apply(turn, points))
    assert turned.segment.tolist() == found.segment.tolist()
    assert_close(turned.tangent, se2.rotate(theta, found.tangent))
    assert_close(turned.spacing, found.spacing)


@given(st.floats(-3, 3), st.floats(-20, 20), st.floats(-20, 20), st.integers(2, 60), st.booleans(), st.integers(0, 10_000))
@settings(max_examples=25)
def test_a_scan_in_another_frame_is_the_same_scan(theta: float, x: float, y: float, n: int, closed: bool, seed: int) -> None:
    points = polar(4 + make_points(n, seed)[:, 0] / 6, degrees(-120, 120, n))
    offset = torch.tensor([theta, x, y], dtype=torch.float64)
    here, there = seen(points, closed=closed), seen(se2.apply(offset, points), closed=closed, origin=offset[1:])
    assert there.segment.tolist() == here.segment.tolist()
    for name in ("ranges", "spacing", "length", "step"):
        assert_close(getattr(there, name), getattr(here, name))
    assert_close(there.tangent, se2.rotate(theta, here.tangent))
    assert_close(se2.wrap(there.bearings - here.bearings - theta), torch.zeros(n))
    moved = 5 * normal(30, 2, seed=seed)
    assert verdicts(se2.apply(offset, moved), there) == verdicts(moved, here)


# Free space. A wall 5 m ahead with a doorway; through it, a wall 10 m ahead.

BEARINGS = degrees(-40, 40, 321)
SCENE = wall(torch.where(BEARINGS.tan().abs() < 0.2, 10.0, 5.0), BEARINGS)


VERDICTS = {AGREES: "agrees", SEEN_THROUGH: "seen through", OCCLUDED: "occluded", UNMEASURED: "unmeasured"}


def look(*points: tuple[float, float], scan: Surface | None = None) -> list[str]:
    return verdicts(np.array(points), surface(SCENE) if scan is None else scan)


def verdicts(points: Tensor | np.ndarray, scan: Surface) -> list[str]:
    """What the beams of a scan say of points (P, 2) in its frame."""
    return [VERDICTS[look_along(scan, x, y)] for x, y in np.asarray(points)]


def test_free_space_of_a_doorway() -> None:
    assert look((5.0, 0.0), (7.0, 1.0), (3.0, 3.0 * 0.5), (4.0, -2.0)) == ["seen through"] * 4
    assert look((12.0, 0.0), (8.0, 4.0), (6.0, -3.0), (20.0, 2.0)) == ["occluded"] * 4
    assert look((10.0, 0.0), (5.0, 3.0), (10.02, 1.0), (4.99, -2.0)) == ["agrees"] * 4


def test_the_sensor_does_not_look_behind_itself() -> None:
    assert look((-3.0, 0.0), (0.0, 3.0), (1.0, -5.0)) == ["occluded"] * 3


def test_at_a_depth_edge_everything_between_agrees() -> None:
    edge = float(BEARINGS[(BEARINGS.tan() < 0.2).nonzero()[-1, 0]]) + math.radians(0.1)  # between the two beams
    assert look(*((r * math.cos(edge), r * math.sin(edge)) for r in (5.1, 7.0, 10.1))) == ["agrees"] * 3


def test_the_scan_agrees_with_itself() -> None:
    assert verdicts(SCENE, surface(SCENE)) == ["agrees"] * len(SCENE)


def test_a_closed_scan_agrees_with_itself() -> None:
    for first in (-180.0, 30.0):
        points = ring(first)
        assert verdicts(points, surface(points, closed=True)) == ["agrees"] * 360


def test_a_closed_scan_looks_across_its_ends() -> None:
    scan = surface(ring(), closed=True)
    end = math.radians(179.5)  # between the last beam and the first
    points = [(r * math.cos(end), r * math.sin(end)) for r in (3.0, 5.0, 7.0)]
    assert look(*points, scan=scan) == ["seen through", "agrees", "occluded"]


def test_missing_beams_say_nothing() -> None:
    scan = surface(wall(5.0, BEARINGS[(BEARINGS.abs() > math.radians(2))]))
    assert look((3.0, 0.0), (5.0, 0.0), (8.0, 0.0), scan=scan) == ["unmeasured"] * 3
    assert look((3.0, 1.0), scan=scan) == ["seen through"]


def test_points_all_round_are_seen_through_and_hidden() -> None:
    assert {"seen through", "occluded"} <= {*verdicts(20 * normal(500, 2), surface(SCENE))}


# Against loops that know nothing of the package.


@given(any_scan())
def test_a_surface_equals_the_oracle(scan: Surface) -> None:
    expected = oracle_of(scan)
    assert scan.segment.tolist() == expected.segment
    for name in ("ranges", "spacing", "length", "tangent", "step"):
        assert_close(getattr(scan, name), getattr(expected, name))
    assert_close(se2.wrap(scan.bearings - np.array(expected.bearings)), np.zeros(len(scan.points)))


@given(any_scan(), st.integers(0, 10_000))
def test_sights_equal_the_oracle(scan: Surface, seed: int) -> None:
    assume(len(scan.points) > 2 or not scan.is_closed)  # with one beam or two there is no closed circle to speak of
    places = scan.points[0] + 4 * normal(20, 2, seed=seed).numpy()
    assert verdicts(places, scan) == [oracles.sight(oracle_of(scan), place) for place in places]
