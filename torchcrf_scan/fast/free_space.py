"""Free-space test of single points in the frame of a scan; `features.free_space` without batches."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from torchcrf_scan.features.free_space import LEAST_SLACK, SLACK_SHARE, SLACK_STEPS, WIDEST_GAP
from torchcrf_scan.loops.circle import (
    LEAST_TURN,
    USUAL_STEP,
    first_from,
    polar,
    rising_bearing,
    rising_turn,
    turn_between,
    usual_step,
)
from torchcrf_scan.loops.jit import Array, kernel
from torchcrf_scan.search.free_space import range_slack


class Sweep(NamedTuple):
    """Ranges and bearings of a scan of N points; the attributes are those of `features.free_space.Sweep`.

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
    """The sweep of (N, 2) points in beam order. noise: in their unit; origin: (2,) of the sensor."""
    ranges, bearings = polar(points, origin)
    turns = np.empty(max(len(points) - 1, 0))
    for i in range(len(turns)):
        turns[i] = rising_turn(bearings[i + 1] - bearings[i])
    return Sweep(origin, ranges, bearings, usual_step(turns, USUAL_STEP), noise, is_closed)


@kernel
def beam_after(sweep: Sweep, dx: float, dy: float) -> tuple[float, int]:
    """Bearing of the direction (dx, dy) on the scale of the sweep's own, and the first beam whose bearing is not less.

    A beam is not less up to `LEAST_TURN`: where nothing moves, returns lie on beams exactly, and rounding must not choose.
    """
    bearing = rising_bearing(sweep.bearings[0] if len(sweep.bearings) > 0 else 0.0, sweep.step / 2, dx, dy)
    return bearing, first_from(sweep.bearings, bearing - LEAST_TURN)


@kernel
def beams_beside(sweep: Sweep, dx: float, dy: float) -> tuple[bool, float, float]:
    """Whether a direction is in the field of view, and the lesser and the greater range of the beams beside it.

    Where the beams are too far apart to tell, the lesser range is 0 and the greater infinite.
    """
    N = len(sweep.ranges)
    if N == 0:
        return True, 0.0, np.inf
    bearing = rising_bearing(sweep.bearings[0], sweep.step / 2, dx, dy)
    after = first_from(sweep.bearings, bearing)
    if sweep.is_closed:
        left, right = (after - 1) % N, after % N
    else:
        if bearing > sweep.bearings[N - 1] + sweep.step / 2:
            return False, 0.0, np.inf
        left, right = max(after - 1, 0), min(after, N - 1)
    if left != right:
        beside = max(turn_between(sweep.bearings[left], bearing), turn_between(bearing, sweep.bearings[right]))
        if not beside < WIDEST_GAP * sweep.step:
            return True, 0.0, np.inf
    return True, min(sweep.ranges[left], sweep.ranges[right]), max(sweep.ranges[left], sweep.ranges[right])


@kernel
def look(sweep: Sweep, x: float, y: float) -> tuple[float, float]:
    """Free-space test of a point: degrees to which it is seen through and hidden, each from 0 to 1."""
    dx, dy = x - sweep.origin[0], y - sweep.origin[1]
    reach = math.sqrt(dx * dx + dy * dy)
    is_inside, near, far = beams_beside(sweep, dx, dy)
    if not is_inside:
        return 0.0, 1.0
    slack = range_slack(reach, sweep.step, sweep.noise)
    return min(max((near - reach) / slack - 1, 0.0), 1.0), min(max((reach - far) / slack - 1, 0.0), 1.0)


@kernel
def look_slope(sweep: Sweep, x: float, y: float, to_seen: float, to_hidden: float) -> tuple[float, float]:
    """Slope of a point from those of its free-space test."""
    dx, dy = x - sweep.origin[0], y - sweep.origin[1]
    reach = math.sqrt(dx * dx + dy * dy)
    is_inside, near, far = beams_beside(sweep, dx, dy)
    if not is_inside or reach == 0:
        return 0.0, 0.0
    slack = range_slack(reach, sweep.step, sweep.noise)
    widening = SLACK_STEPS * sweep.step + SLACK_SHARE if slack > LEAST_SLACK else 0.0
    before, beyond, slope = (near - reach) / slack, (reach - far) / slack, 0.0
    if 1 < before < 2:
        slope -= to_seen * (1 + before * widening) / slack
    if 1 < beyond < 2:
        slope += to_hidden * (1 - beyond * widening) / slack
    return slope * dx / reach, slope * dy / reach
