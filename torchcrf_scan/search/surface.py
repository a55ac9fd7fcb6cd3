"""One scan as pieces of surface, and the free-space test of single points."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from torchcrf_scan.features.free_space import WIDEST_GAP
from torchcrf_scan.loops.circle import USUAL_STEP, polar, rising_bearing, rising_turn, turn_apart, usual_step
from torchcrf_scan.loops.jit import Array, Booleans, Integers, entry, kernel
from torchcrf_scan.loops.nearest import Boxes, boxes_of
from torchcrf_scan.search.free_space import range_slack

GRAZING = math.radians(10.0)  # a larger angle of incidence is taken for a depth jump (adaptive breakpoint detector)
WIDEST_TURN = GRAZING * (1 - 1e-4)  # between neighbours on a surface; beams are whole steps apart, and just `GRAZING` is too far

AGREES, SEEN_THROUGH, OCCLUDED, UNMEASURED = 0, 1, 2, 3  # results of the free-space test


class Surface(NamedTuple):
    """A scan of P points with its geometry.

    Attributes:
        boxes: round runs of the points. points: (P, 2) in beam order. origin: (2,) of the sensor.
        ranges, bearings: (P,) from there, the latter rising. spacing: (P,) metres to the nearest point on the same surface.
        tangent: (P, 2) of the surface, 0 of a point without neighbours. length: (P,) metres of surface that a point stands for.
        segment: (P,) number of the piece of surface. step: radians between beams. noise: metres, of a range.
    """

    boxes: Boxes
    points: Array
    origin: Array
    ranges: Array
    bearings: Array
    spacing: Array
    tangent: Array
    length: Array
    segment: Integers
    step: float
    noise: float
    is_closed: bool


@kernel
def number_runs(joined: Booleans) -> Integers:
    """(P,) numbers from 0; joined[i]: i and i + 1 have the same, the last and the first included."""
    number = np.zeros(len(joined), np.int64)
    for i in range(1, len(joined)):
        number[i] = number[i - 1] + (0 if joined[i - 1] else 1)
    if joined[-1]:
        last = number[-1]
        for i in range(len(joined)):
            if number[i] == last:
                number[i] = 0
    return number


@kernel
def distinct_neighbour(i: int, gap: Array, joined: Booleans, direction: int) -> int:
    """The nearest point ahead (1) or behind (-1) of point i on its surface that is elsewhere; the last one tried if there is none.

    gap: (P,) to the next point. joined: (P,) on one surface with it.
    """
    P, j = len(gap), i
    for _ in range(P):
        edge = j if direction > 0 else (j - 1) % P
        j = (j + direction) % P
        if gap[edge] > 0 or not joined[edge]:
            break
    return j


@entry
def surface_of(points: Array, noise: float, is_closed: bool, origin: Array) -> Surface:
    """The surface of (P, 2) points in beam order, P >= 1. noise: metres; origin: (2,) of the sensor."""
    P = len(points)
    ranges, bearings = polar(points, origin)
    turn, gap = np.empty(P), np.empty(P)
    for i in range(P):
        j = (i + 1) % P
        gap[i] = math.hypot(points[j, 0] - points[i, 0], points[j, 1] - points[i, 1])
        turn[i] = rising_turn(bearings[j] - bearings[i])
    step = usual_step(turn[: P - 1], USUAL_STEP)
    joined = np.empty(P, np.bool_)
    for i in range(P):
        least = min(ranges[i], ranges[(i + 1) % P])
        largest = least * math.sin(turn[i]) / math.sin(max(GRAZING - turn[i], 1e-3)) + 6 * noise
        joined[i] = gap[i] <= largest and turn[i] < WIDEST_TURN
    if not is_closed:
        joined[P - 1] = False
    spacing, length, tangent = np.empty(P), np.empty(P), np.empty((P, 2))
    for i in range(P):
        j, k = distinct_neighbour(i, gap, joined, 1), distinct_neighbour(i, gap, joined, -1)
        ahead = (j - 1) % P  # the edge to the next point elsewhere, k the one from the last
        footprint = ranges[i] * step
        nearest = min(gap[ahead] if joined[ahead] else np.inf, gap[k] if joined[k] else np.inf)
        spacing[i] = nearest if nearest < np.inf else footprint
        ax = ay = 0.0
        length[i] = 0.0
        if joined[ahead]:
            ax, ay = ax + points[j, 0] - points[i, 0], ay + points[j, 1] - points[i, 1]
        if joined[k]:
            ax, ay = ax + points[i, 0] - points[k, 0], ay + points[i, 1] - points[k, 1]
        length[i] = (gap[ahead] if joined[ahead] else footprint) / 2 + (gap[k] if joined[k] else footprint) / 2
        arm = max(math.sqrt(ax * ax + ay * ay), 1e-9)
        tangent[i, 0], tangent[i, 1] = ax / arm, ay / arm
    segment = number_runs(joined)
    return Surface(boxes_of(points), points, origin, ranges, bearings, spacing, tangent, length, segment, step, noise, is_closed)


@kernel
def bearing_of(scan: Surface, dx: float, dy: float) -> float:
    """Direction of (dx, dy) on the scale of the scan's rising bearings, radians."""
    return rising_bearing(scan.bearings[0], scan.step / 2, dx, dy)


@kernel
def look_between(scan: Surface, bearing: float, after: int, reach: float) -> int:
    """Free-space test of a point at a bearing and `reach` metres away: one of the four results above.

    after: first beam whose bearing is not less.
    """
    M, half = len(scan.ranges), scan.step / 2
    if not scan.is_closed and bearing > scan.bearings[M - 1] + half:
        return OCCLUDED
    left, right = max(after - 1, 0), min(after, M - 1)
    if scan.is_closed:
        left, right = (after - 1 if after > 0 else M - 1), (after if after < M else 0)
    apart = max(turn_apart(bearing - scan.bearings[left]), turn_apart(scan.bearings[right] - bearing))
    if left == right:
        apart = min(apart, half)
    if not apart < WIDEST_GAP * scan.step:
        return UNMEASURED
    slack = range_slack(reach, scan.step, scan.noise)
    if reach + slack < min(scan.ranges[left], scan.ranges[right]):
        return SEEN_THROUGH
    if reach > max(scan.ranges[left], scan.ranges[right]) + slack:
        return OCCLUDED
    return AGREES


@kernel
def look_along(scan: Surface, x: float, y: float) -> int:
    """Free-space test of a point (x, y) in the frame of `scan`: one of the four results above."""
    dx, dy = x - scan.origin[0], y - scan.origin[1]
    bearing = bearing_of(scan, dx, dy)
    return look_between(scan, bearing, int(np.searchsorted(scan.bearings, bearing)), math.sqrt(dx * dx + dy * dy))
