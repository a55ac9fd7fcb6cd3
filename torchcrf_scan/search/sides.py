"""Straight sides that slide along themselves: their motion follows from their ends (design finding 12).

Between its ends such a side is explained by the background as well as by its own motion, and its many returns outweigh the few
at its ends. The ends decide: where the side has come to be, the first scan sees farther; where it left, the second one does.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from torchcrf_scan.loops.jit import Array, Integers, entry, kernel
from torchcrf_scan.loops.rigid import apply_to_rows, compose, inverse
from torchcrf_scan.search.free_space import range_slack
from torchcrf_scan.search.groups import Groups
from torchcrf_scan.search.leftover import OPEN, Leftover, Unexplained, residual_at
from torchcrf_scan.search.surface import OCCLUDED, SEEN_THROUGH, UNMEASURED, Surface, look_along

FEWEST = 6  # returns of a side
WIDEST_HOLE = 6.0  # beam steps without a return within a side
IN_LINE = 2.0  # units, distance of a side's returns from the line of the same side in the other scan
CONTRADICTED = 2  # returns at the ends that contradict the background, at least;
AGAINST = 0.25  # as a share of these, at most, returns that contradict the side's motion,
EXPLAINED = 0.8  # and of the returns that the other scan can see, at least, those explained by it


class Sides(NamedTuple):
    """S sides that slide: their motions (S, 3) `T_target_source` and their source points."""

    motions: Array
    groups: Groups


class Match(NamedTuple):
    """A side's returns in both scans, from `first` to `last`, and its direction (x, y) that way in the target's frame."""

    first: int
    last: int
    target_first: int
    target_last: int
    x: float
    y: float


@entry
def sliding_sides(leftover: Leftover) -> Sides:
    """The straight sides whose ends contradict the background and agree with a motion along themselves."""
    source, target, unit = leftover.source, leftover.target, leftover.unit
    runs, others = straight_runs(source.grid.scan, unit), straight_runs(target.grid.scan, unit)
    motions, start = np.empty((len(runs), 3)), np.zeros(len(runs) + 1, np.int64)
    members, count, S = np.empty(2 * len(source.units), np.int64), 0, 0
    for r in range(len(runs)):
        is_found, side = _match(leftover.carried, runs[r], target.grid.scan.points, others, IN_LINE * unit)
        if not is_found:
            continue
        is_moved, motion = _slide(leftover, side)
        if is_moved:
            for i in range(side.first, side.last + 1):
                members[count] = i
                count += 1
            motions[S] = motion
            S += 1
            start[S] = count
    return Sides(motions[:S].copy(), Groups(start[: S + 1].copy(), members[:count].copy()))


@kernel
def straight_runs(scan: Surface, tolerance: float) -> Integers:
    """(R, 2) first and last point of runs of beams in line: split at the point farthest from the chord until all are near it.

    tolerance: metres.
    """
    points, P = scan.points, len(scan.points)
    runs, todo = np.empty((P, 2), np.int64), np.empty((P + 1, 2), np.int64)
    count = left = first = 0
    for i in range(P):
        if i == P - 1 or scan.bearings[i + 1] - scan.bearings[i] > WIDEST_HOLE * scan.step:
            todo[left, 0], todo[left, 1] = first, i
            left, first = left + 1, i + 1
    while left > 0:
        left -= 1
        a, b = todo[left, 0], todo[left, 1]
        if b - a + 1 < FEWEST:
            continue
        x, y = points[b, 0] - points[a, 0], points[b, 1] - points[a, 1]
        farthest, at = tolerance * max(math.sqrt(x * x + y * y), 1e-9), a
        for i in range(a + 1, b):
            away = abs(x * (points[i, 1] - points[a, 1]) - y * (points[i, 0] - points[a, 0]))
            if away > farthest:
                farthest, at = away, i
        if at == a:
            runs[count, 0], runs[count, 1] = a, b
            count += 1
        else:
            todo[left, 0], todo[left, 1] = a, at
            todo[left + 1, 0], todo[left + 1, 1] = at, b
            left += 2
    return runs[:count].copy()


@kernel
def _match(carried: Array, run: Integers, points: Array, others: Integers, tolerance: float) -> tuple[bool, Match]:
    """The target's run (R, 2) in line with a source's run (2,) under the background that overlaps it most, if there is one.

    Args:
        carried: (N, 2), points: (M, 2). tolerance: metres.
    """
    a, b = run[0], run[1]
    most, best = 0.0, Match(a, b, 0, 0, 0.0, 0.0)
    for k in range(len(others)):
        c, d = others[k, 0], others[k, 1]
        x, y = carried[b, 0] - carried[a, 0], carried[b, 1] - carried[a, 1]
        u, v = points[d, 0] - points[c, 0], points[d, 1] - points[c, 1]
        long, other = math.sqrt(x * x + y * y), math.sqrt(u * u + v * v)
        if x * u + y * v <= 0:
            continue
        if long >= other:
            x, y = x / long, y / long
            is_in_line = _is_in_line(carried, a, b, points, c, d, x, y, tolerance)
        else:
            x, y = u / other, v / other
            is_in_line = _is_in_line(points, c, d, carried, a, b, x, y, tolerance)
        low = max(carried[a, 0] * x + carried[a, 1] * y, points[c, 0] * x + points[c, 1] * y)
        high = min(carried[b, 0] * x + carried[b, 1] * y, points[d, 0] * x + points[d, 1] * y)
        if is_in_line and high - low > most:
            most, best = high - low, Match(a, b, c, d, x, y)
    return most > 0, best


@kernel
def _is_in_line(points: Array, a: int, b: int, others: Array, c: int, d: int, x: float, y: float, tolerance: float) -> bool:
    """Whether points c to d of the others (M, 2) lie along direction (x, y) through points a and b (N, 2)."""
    middle_x, middle_y = (points[a, 0] + points[b, 0]) / 2, (points[a, 1] + points[b, 1]) / 2
    away = 0.0
    for j in range(c, d + 1):
        away = max(away, abs(x * (others[j, 1] - middle_y) - y * (others[j, 0] - middle_x)))
    return away <= tolerance


@kernel
def _slide(leftover: Leftover, side: Match) -> tuple[bool, Array]:
    """Whether a side moves along itself, and its motion (3,): of those that align an end, the one that explains it best."""
    source, target, carried, points = leftover.source, leftover.target, leftover.carried, leftover.target.grid.scan.points
    x, y = side.x, side.y
    low, high = carried[side.first, 0] * x + carried[side.first, 1] * y, carried[side.last, 0] * x + carried[side.last, 1] * y
    there_low = points[side.target_first, 0] * x + points[side.target_first, 1] * y
    there_high = points[side.target_last, 0] * x + points[side.target_last, 1] * y
    left_low, left_high = _contradicted(carried, source, side.first, side.last, x, y, there_low, there_high)
    come_low, come_high = _contradicted(points, target, side.target_first, side.target_last, x, y, low, high)
    ahead, back = left_low + come_high, left_high + come_low  # evidence for a motion along the direction, and against it
    contradicted = max(ahead, back)
    motion, least = leftover.background, np.inf
    if contradicted < CONTRADICTED or min(ahead, back) > AGAINST * contradicted:
        return False, motion
    first_gap = _end_gap(source, side.first, -1, target, side.target_first)
    last_gap = _end_gap(source, side.last, 1, target, side.target_last)
    shifts = np.zeros(3)
    shifts[0] = there_low - low if first_gap < np.inf else 0.0
    shifts[1] = there_high - high if last_gap < np.inf else 0.0
    if max(first_gap, last_gap) < np.inf:
        if abs(shifts[0] - shifts[1]) > math.hypot(first_gap, last_gap) + leftover.unit:
            return False, motion  # it is not rigid, or an end of it is not its end
        one, other = last_gap**2, first_gap**2
        shifts[2] = (one * shifts[0] + other * shifts[1]) / max(one + other, 1e-12)
    for shift in shifts:
        if (shift if ahead > back else -shift) < OPEN * leftover.unit:
            continue
        step = np.zeros(3)
        step[1], step[2] = shift * x, shift * y
        moved = compose(step, leftover.background)
        cost = _cost(leftover, side, moved, contradicted)
        if cost < least:
            motion, least = moved, cost
    return least < np.inf, motion


@kernel
def _contradicted(
    points: Array, scan: Unexplained, first: int, last: int, x: float, y: float, low: float, high: float
) -> tuple[int, int]:
    """Numbers of points first to last (P, 2) before `low` and beyond `high` along (x, y) that the other scan sees through."""
    before = beyond = 0
    for i in range(first, last + 1):
        if scan.sight[i] == SEEN_THROUGH:
            along = points[i, 0] * x + points[i, 1] * y
            before += along < low
            beyond += along > high
    return before, beyond


@kernel
def _end_gap(source: Unexplained, i: int, direction: int, target: Unexplained, j: int) -> float:
    """Metres between returns at an end of a side in both scans, i and j; inf where one of them only cannot see on."""
    if _is_end(source.grid.scan, i, direction) and _is_end(target.grid.scan, j, direction):
        return max(source.grid.scan.spacing[i], target.grid.scan.spacing[j], 1e-6)
    return np.inf


@kernel
def _is_end(scan: Surface, i: int, direction: int) -> bool:
    """Whether the surface ends at point i: the next return is not in front of it, and the scan goes on."""
    P = len(scan.ranges)
    j = i + direction
    if not scan.is_closed and not 0 <= j < P:
        return False
    return scan.ranges[j % P] > scan.ranges[i] - range_slack(scan.ranges[i], scan.step, scan.noise)


@kernel
def _cost(leftover: Leftover, side: Match, motion: Array, contradicted: int) -> float:
    """Mean residual of a side's returns in both scans under a motion (3,); inf if it does not explain them."""
    source, target = leftover.source, leftover.target
    ahead, against = _explained(source, side.first, side.last, motion, target)
    back, against_back = _explained(target, side.target_first, side.target_last, inverse(motion), source)
    seen = max(ahead[1] + back[1], 1.0)
    if against + against_back > AGAINST * contradicted or ahead[0] + back[0] < EXPLAINED * seen:
        return np.inf
    return (ahead[2] + back[2]) / seen


@kernel
def _explained(scan: Unexplained, first: int, last: int, motion: Array, other: Unexplained) -> tuple[Array, int]:
    """What another scan says of points first to last under a motion (3,).

    Returns:
        (3,) of those that it can see: how many it explains, their number, the sum of their residuals; how many it sees through.
    """
    L = last - first + 1
    moved, residual, near = np.empty((2, L)), np.empty(L), np.empty(L, np.int64)
    apply_to_rows(motion, scan.grid.scan.points[first : last + 1], moved)
    residual_at(moved, other.grid, other.units, residual, near)
    total, through = np.zeros(3), 0
    for k in range(L):
        sight = look_along(other.grid.scan, moved[0, k], moved[1, k])
        if sight not in (OCCLUDED, UNMEASURED):
            through += sight == SEEN_THROUGH
            total[0] += residual[k] < OPEN
            total[1] += 1
            total[2] += residual[k]
    return total, through
