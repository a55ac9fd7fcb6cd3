"""Shape descriptors of the neighbourhood of every point of one scan; `features.shape` without batches."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from torchcrf_scan.loops.jit import Array, entry, kernel
from torchcrf_scan.loops.median import lower_median

ORDERS = (1, 3, 5)  # "first, third or fifth neighbour"
MIN_ARM = 1e-6  # metres; the angle between shorter arms is undefined and set to pi
FARTHEST = max(ORDERS)
NO_SPACING = 0.1  # metres, of two scans without points


class Shape(NamedTuple):
    """A scan of P points; the attributes are those of `features.shape.ShapeDescriptors`.

    Attributes:
        distance, geodesic: (P, 3, 2). angle: (P, 3). radius: (P,).
    """

    distance: Array
    geodesic: Array
    angle: Array
    radius: Array


@kernel
def neighbour(i: int, offset: int, count: int, is_closed: bool) -> int:
    """The point `offset` on from i; clamped to the scan's ends, or wrapped round a closed scan."""
    if is_closed:
        return (i + offset) % count
    return min(max(i + offset, 0), count - 1)


@kernel
def arm_angle(ux: float, uy: float, vx: float, vy: float) -> float:
    """Angle from u to v in [0, 2 pi); pi if an arm is too short to have a direction."""
    if min(ux * ux + uy * uy, vx * vx + vy * vy) < MIN_ARM**2:
        return math.pi
    return math.atan2(ux * vy - uy * vx, ux * vx + uy * vy) % (2 * math.pi)


@kernel
def describe(points: Array, is_closed: bool) -> Shape:
    """Shape descriptors of (P, 2) points in beam order, P >= 0."""
    P = len(points)
    distance, geodesic, angle = np.empty((P, len(ORDERS), 2)), np.empty((P, len(ORDERS), 2)), np.empty((P, len(ORDERS)))
    radius, gap = np.empty(P), np.empty(P)
    for i in range(P):
        j = neighbour(i, 1, P, is_closed)
        gap[i] = math.sqrt((points[j, 0] - points[i, 0]) ** 2 + (points[j, 1] - points[i, 1]) ** 2)
        radius[i] = math.sqrt(points[i, 0] ** 2 + points[i, 1] ** 2)
    for i in range(P):
        x, y = points[i, 0], points[i, 1]
        ahead = behind = 0.0
        place = 0
        for step in range(FARTHEST):
            before = i - step - 1
            ahead += gap[neighbour(i, step, P, is_closed)]
            behind += gap[before % P] if is_closed or before >= 0 else 0.0
            if step + 1 == ORDERS[place]:
                j, k = neighbour(i, step + 1, P, is_closed), neighbour(i, -step - 1, P, is_closed)
                vx, vy = points[j, 0] - x, points[j, 1] - y
                ux, uy = points[k, 0] - x, points[k, 1] - y
                distance[i, place, 0], distance[i, place, 1] = math.sqrt(vx * vx + vy * vy), math.sqrt(ux * ux + uy * uy)
                geodesic[i, place, 0], geodesic[i, place, 1] = ahead, behind
                angle[i, place] = arm_angle(ux, uy, vx, vy)
                place += 1
    return Shape(distance, geodesic, angle, radius)


@kernel
def _open_spacing(points: Array, into: Array) -> None:
    """Writes metres (P,) between a point (P, 2) and the nearer of the next distinct ones on either side: not across a jump.

    The scan is regarded as open; 0 if all points coincide.
    """
    P, gap = len(points), 0.0
    for i in range(P):  # from behind
        if i > 0:
            step = math.sqrt((points[i, 0] - points[i - 1, 0]) ** 2 + (points[i, 1] - points[i - 1, 1]) ** 2)
            gap = step if step > 0 else gap
        into[i] = gap
    gap = 0.0
    for i in range(P - 1, -1, -1):  # from ahead
        if i + 1 < P:
            step = math.sqrt((points[i + 1, 0] - points[i, 0]) ** 2 + (points[i + 1, 1] - points[i, 1]) ** 2)
            gap = step if step > 0 else gap
        into[i] = min(into[i], gap) if min(into[i], gap) > 0 else max(into[i], gap)


@entry
def resolution(source_points: Array, target_points: Array, noise: float) -> float:
    """Metres: half the usual spacing of a pair's points plus twice their noise (`features.potentials.resolution`)."""
    N = len(source_points)
    spacing = np.empty(N + len(target_points))
    _open_spacing(source_points, spacing[:N])
    _open_spacing(target_points, spacing[N:])
    usual = lower_median(spacing) if len(spacing) > 0 else NO_SPACING
    return usual / 2 + 2 * noise
