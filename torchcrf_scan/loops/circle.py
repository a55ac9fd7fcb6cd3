"""Angles on a circle, and positions on a rising scale of bearings."""

from __future__ import annotations

import math

import numpy as np

from torchcrf_scan.loops.jit import Array, kernel
from torchcrf_scan.loops.median import lower_median

BACKWARDS = 1e-4  # radians; smaller steps back are rounding errors
LEAST_TURN = 1e-9  # radians; several returns of one beam are not neighbouring beams
USUAL_STEP = math.radians(0.5)  # between beams, if there are not two


@kernel
def rising_turn(difference: float) -> float:
    """Counter-clockwise angle in [0, 2 pi); steps back within rounding error count as 0."""
    return max((difference + BACKWARDS) % (2 * math.pi) - BACKWARDS, 0.0)


@kernel
def turn_apart(difference: float) -> float:
    """`rising_turn` without a division if there are no whole turns to subtract; not exact to the last digit."""
    return max(difference, 0.0) if -BACKWARDS <= difference < 6.0 else rising_turn(difference)


@kernel
def within_circle(angle: float) -> float:
    """angle % (2 pi), mostly without a division."""
    if angle < 0:
        angle += 2 * math.pi
    return angle if 0 <= angle < 2 * math.pi else angle % (2 * math.pi)


@kernel
def turn_between(before: float, after: float) -> float:
    """`rising_turn` from one bearing to another."""
    return max(within_circle(after - before + BACKWARDS) - BACKWARDS, 0.0)


@kernel
def rising_bearing(first: float, half: float, dx: float, dy: float) -> float:
    """Direction of (dx, dy) on the rising scale of a scan's bearings, which begins half a step before the first one, radians."""
    return first + within_circle(math.atan2(dy, dx) - first + half) - half


@kernel
def polar(points: Array, origin: Array) -> tuple[Array, Array]:
    """(P,) ranges and (P,) rising bearings, radians, of points (P, 2) in beam order from a sensor at (2,)."""
    ranges, bearings = np.empty(len(points)), np.empty(len(points))
    before = 0.0
    for i in range(len(points)):
        x, y = points[i, 0] - origin[0], points[i, 1] - origin[1]
        ranges[i] = math.sqrt(x * x + y * y)
        raw = math.atan2(y, x)
        bearings[i] = bearings[i - 1] + rising_turn(raw - before) if i > 0 else raw
        before = raw
    return ranges, bearings


@kernel
def first_from(rising: Array, value: float) -> int:
    """Index of the first entry that is not below the value; the number of entries if all are."""
    low, count = 0, len(rising)
    while count > 0:
        half = count // 2
        if rising[low + half] < value:
            low += half + 1
            count -= half + 1
        else:
            count = half
    return low


@kernel
def usual_step(turn: Array, otherwise: float) -> float:
    """Radians between beams: the lower median of the turns (P,) to the next return, without those within one beam.

    otherwise: for fewer than two beams.
    """
    beams, count = np.empty(len(turn)), 0
    for i in range(len(turn)):
        if turn[i] >= LEAST_TURN:
            beams[count] = turn[i]
            count += 1
    return lower_median(beams[:count]) if count > 0 else otherwise
