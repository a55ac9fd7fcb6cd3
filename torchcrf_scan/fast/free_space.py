"""What the beams of one scan say of points carried into it; `features.free_space` in loops."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from torchcrf_scan.features.free_space import SLACK_SHARE, SLACK_STEPS, WIDEST_GAP
from torchcrf_scan.loops.circle import first_from, rising_turn, turn_between, within_circle
from torchcrf_scan.loops.jit import Array, kernel
from torchcrf_scan.loops.median import lower_median

USUAL_STEP = math.radians(0.5)  # of a scan with one point


class Sweep(NamedTuple):
    """A scan of N points as its sensor sees it; the attributes are those of `features.free_space.Sweep`.

    Attributes:
        origin: (2,). ranges, bearings: (N,), the latter rising. step: radians. noise: of a range. is_closed: over the whole circle.
    """

    origin: Array
    ranges: Array
    bearings: Array
    step: float
    noise: float
    is_closed: bool


@kernel
def sweep_of(points: Array, noise: float, is_closed: bool, origin: Array) -> Sweep:
    """points: (N, 2) in beam order; noise: in their unit; origin: (2,) of the sensor."""
    N = len(points)
    ranges, bearings, turns = np.empty(N), np.empty(N), np.empty(max(N - 1, 0))
    first = before = turned = 0.0
    for i in range(N):
        x, y = points[i, 0] - origin[0], points[i, 1] - origin[1]
        ranges[i] = math.sqrt(x * x + y * y)
        raw = math.atan2(y, x)
        if i == 0:
            first = raw
        else:
            turns[i - 1] = rising_turn(raw - before)
            turned += turns[i - 1]
        bearings[i] = first + turned
        before = raw
    return Sweep(origin, ranges, bearings, lower_median(turns) if N > 1 else USUAL_STEP, noise, is_closed)


@kernel
def look(sweep: Sweep, x: float, y: float) -> tuple[float, float]:
    """How far the beams contradict a point in their frame (they went on past it) and hide it, each from 0 (not) to 1 (clearly)."""
    N = len(sweep.ranges)
    if N == 0:
        return 0.0, 0.0
    dx, dy = x - sweep.origin[0], y - sweep.origin[1]
    reach = math.sqrt(dx * dx + dy * dy)
    first, half = sweep.bearings[0], sweep.step / 2
    bearing = first + within_circle(math.atan2(dy, dx) - first + half) - half
    after = first_from(sweep.bearings, bearing)
    if sweep.is_closed:
        left, right = (after - 1) % N, after % N
    else:
        if bearing > sweep.bearings[N - 1] + half:
            return 0.0, 1.0
        left, right = max(after - 1, 0), min(after, N - 1)
    if left != right:
        beside = max(turn_between(sweep.bearings[left], bearing), turn_between(bearing, sweep.bearings[right]))
        if not beside < WIDEST_GAP * sweep.step:
            return 0.0, 0.0
    near, far = min(sweep.ranges[left], sweep.ranges[right]), max(sweep.ranges[left], sweep.ranges[right])
    slack = max(SLACK_STEPS * (sweep.noise + reach * sweep.step) + SLACK_SHARE * reach, 1e-6)
    return min(max((near - reach) / slack - 1, 0.0), 1.0), min(max((reach - far) / slack - 1, 0.0), 1.0)
