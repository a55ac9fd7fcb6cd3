"""Hypothesised motions of movers: groups of the source aligned with groups of the target.

All hypotheses of one group follow each other, so that work on the group alone is done once.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from torchcrf_scan.loops.jit import Array, Booleans, Integers, entry, kernel
from torchcrf_scan.loops.nearest import Boxes, nearest_within
from torchcrf_scan.loops.rigid import apply, compose, motion_onto, wrap
from torchcrf_scan.search.grid import ScanGrid
from torchcrf_scan.search.groups import MIN_POINTS, Groups, ends, groups_of
from torchcrf_scan.search.leftover import TRUNCATION, Leftover
from torchcrf_scan.search.registration import register

FASTEST = 45.0  # metres per second; limit for road vehicles
FARTHEST = 1.0  # and limit as a share of the range
SCREEN_POINTS = 8  # of a segment, to compare starts
STARTS = 5  # of a segment, to register
REGISTER_POINTS = 16
USUAL_TURN = 0.1  # radians, standard deviation of a mover's turn between two scans
SETTLE_GATES = np.array((4.0, 3.0, 2.0, 2.0, 1.5, 1.5))  # units, one per iteration,
SETTLE_ALONG = np.array((1.0, 1.0, 0.5, 0.5, 0.2, 0.2))  # and weight of the residual along the surface


class Hypotheses(NamedTuple):
    """H motions of source segments.

    Attributes:
        motions: (H, 3) `T_target_source`.
        group: (H,) which of the groups it moves, ascending.
    """

    motions: Array
    group: Integers
    groups: Groups


@entry
def members_of(hypotheses: Hypotheses, which: Integers, count: int) -> Booleans:
    """(G, P) bool: the points moved by the hypotheses `which` (G,), of a scan of P = `count`."""
    start, index = hypotheses.groups
    members = np.zeros((len(which), count), np.bool_)
    for g in range(len(which)):
        s = hypotheses.group[which[g]]
        for k in range(start[s], start[s + 1]):
            members[g, index[k]] = True
    return members


@entry
def hypothesise(leftover: Leftover, dt: float) -> Hypotheses:
    """Hypotheses that align every group with unexplained points with every such group of the other scan.

    By centroid and by both ends (a car is seen to another length in every scan); the best starts are registered.

    Args:
        leftover: of `leftover_of`. dt: seconds between the scans.
    """
    source, target, carried, unit = leftover.source, leftover.target, leftover.carried, leftover.unit
    if min(len(source.units), len(target.units)) < MIN_POINTS:
        return Hypotheses(np.empty((0, 3)), np.empty(0, np.int64), Groups(np.zeros(1, np.int64), np.empty(0, np.int64)))
    groups, goals = groups_of(source), _marks(target.grid.scan.points, groups_of(target))
    shift, group = _starts(carried, groups, _marks(carried, groups), goals, target.grid.scan.boxes, target.units, 2 * unit, dt)
    motions = _settle(source.grid.scan.points, groups, shift, group, leftover.background, target.grid, unit)
    return Hypotheses(motions, group, groups)


# --- starts -------------------------------------------------------------------------------------------------------------------


@kernel
def _marks(points: Array, groups: Groups) -> Array:
    """(S, 3, 2): centroid, first and last point of every set."""
    marks = np.empty((len(groups.start) - 1, 3, 2))
    for s in range(len(marks)):
        members = groups.members[groups.start[s] : groups.start[s + 1]]
        first, last = ends(members, len(points))
        x = y = 0.0
        for i in members:
            x, y = x + points[i, 0], y + points[i, 1]
        marks[s, 0, 0], marks[s, 0, 1] = x / len(members), y / len(members)
        marks[s, 1, 0], marks[s, 1, 1] = points[first, 0], points[first, 1]
        marks[s, 2, 0], marks[s, 2, 1] = points[last, 0], points[last, 1]
    return marks


@kernel
def _starts(
    carried: Array, groups: Groups, marks: Array, goals: Array, boxes: Boxes, units: Array, near: float, dt: float
) -> tuple[Array, Integers]:
    """(H, 2) distinct translations of least residual after the background's motion, and (H,) their groups.

    Args:
        carried: (P, 2). marks: (S, 3, 2), goals: (T, 3, 2). boxes, units: the target, see `residual_units`.
        near: metres below which two translations are the same. dt: seconds.
    """
    start, index = groups
    S, A = len(marks), 3 * len(goals) + 1
    is_again, farthest = _are_again(goals), TRUNCATION * units.max()
    chosen, group = np.empty((STARTS * S, 2)), np.empty(STARTS * S, np.int64)
    shift, points = np.empty((A, 2)), np.empty((SCREEN_POINTS, 2))
    H = 0
    for s in range(S):
        count = _shifts(marks[s], goals, is_again, dt, shift)
        L = pick_members(index[start[s] : start[s + 1]], carried, points)
        found = _screen(boxes, units, farthest, points[:L], shift[:count], near, chosen[H : H + min(STARTS, A)])
        group[H : H + found] = s
        H += found
    return chosen[:H].copy(), group[:H].copy()


@kernel
def _are_again(goals: Array) -> Booleans:
    """(T, 3) bool: marks equal to that of an earlier set, as sets often begin or end at the same point. goals: (T, 3, 2)."""
    again = np.zeros((len(goals), 3), np.bool_)
    for m in range(3):
        for t in range(len(goals)):
            for k in range(t):
                if goals[k, m, 0] == goals[t, m, 0] and goals[k, m, 1] == goals[t, m, 1]:
                    again[t, m] = True
                    break
    return again


@kernel
def _shifts(marks: Array, goals: Array, is_again: Booleans, dt: float, shift: Array) -> int:
    """Writes the zero translation and those to all marks within a mover's reach to `shift`; returns their number."""
    shift[0, 0] = shift[0, 1] = 0.0
    count = 1
    reach = min(math.hypot(marks[0, 0], marks[0, 1]) * FARTHEST, FASTEST * dt)
    for t in range(len(goals)):
        for m in range(3):
            x, y = goals[t, m, 0] - marks[m, 0], goals[t, m, 1] - marks[m, 1]
            if not is_again[t, m] and math.sqrt(x * x + y * y) <= reach:
                shift[count, 0], shift[count, 1] = x, y
                count += 1
    return count


@kernel
def pick(k: int, size: int, most: int) -> int:
    """The k-th of at most `most` members, evenly spread over `size`."""
    return k * size // most if size > most else k


@kernel
def pick_members(members: Integers, points: Array, picked: Array) -> int:
    """Writes at most len(picked) of the members' points (P, 2) to `picked`, of members (L,); returns their number."""
    count = min(len(members), len(picked))
    for k in range(count):
        i = members[pick(k, len(members), len(picked))]
        picked[k, 0], picked[k, 1] = points[i, 0], points[i, 1]
    return count


@kernel
def _screen(boxes: Boxes, units: Array, farthest: float, points: Array, shift: Array, near: float, chosen: Array) -> int:
    """Writes distinct shifts (A, 2) of least residual to `chosen` (K, 2); returns their number.

    The sum of a residual is abandoned when it exceeds the least one.
    """
    cost, seen, guess = np.zeros(len(shift)), np.zeros(len(shift), np.int64), -1
    for k in range(len(chosen)):
        least, best = np.inf, -1
        for a in range(len(shift)):
            x, y, total, i = shift[a, 0], shift[a, 1], cost[a], seen[a]
            while i < len(points) and total < least:
                residual, guess = residual_units(boxes, units, farthest, points[i, 0] + x, points[i, 1] + y, guess)
                total += residual
                i += 1
            cost[a], seen[a] = total, i
            if total < least:
                least, best = total, a
        if best < 0:
            return k
        chosen[k, 0], chosen[k, 1] = shift[best, 0], shift[best, 1]
        for a in range(len(shift)):
            x, y = shift[a, 0] - chosen[k, 0], shift[a, 1] - chosen[k, 1]
            if math.sqrt(x * x + y * y) < near:
                cost[a] = np.inf
    return len(chosen)


@kernel
def residual_units(boxes: Boxes, units: Array, farthest: float, x: float, y: float, guess: int) -> tuple[float, int]:
    """Distance to a scan in its local units, truncated, and the index of its nearest point, -1 for a truncated one.

    units: (M,) metres, farthest: `TRUNCATION` times the largest of them. guess: index that is tried first, -1: none.
    """
    squared, index = nearest_within(boxes, x, y, guess, farthest * farthest)
    return (min(math.sqrt(squared) / units[index], TRUNCATION) if index >= 0 else TRUNCATION), index


# --- registration -------------------------------------------------------------------------------------------------------------


@kernel
def _settle(
    source: Array, groups: Groups, shift: Array, group: Integers, background: Array, target: ScanGrid, unit: float
) -> Array:
    """(H, 3) registered motions with regularised rotations, which few points determine badly.

    Args:
        source: (P, 2). shift: (H, 2) after the background, group: (H,). unit: metres.
    """
    start, index = groups
    motions, gates = np.empty((len(shift), 3)), unit * SETTLE_GATES
    points, weights = np.empty((REGISTER_POINTS, 2)), np.ones(REGISTER_POINTS)
    for h in range(len(shift)):
        motions[h, 0] = wrap(background[0])
        motions[h, 1], motions[h, 2] = background[1] + shift[h, 0], background[2] + shift[h, 1]
    h = 0
    while h < len(shift):
        s, last = group[h], h + 1
        while last < len(shift) and group[last] == s:
            last += 1
        L = pick_members(index[start[s] : start[s + 1]], source, points)
        settled = register(points[:L], weights[:L], target, motions[h:last], gates, SETTLE_ALONG)
        for k in range(last - h):
            motions[h + k] = _steady(settled[k], points[:L], background[0], unit)
        h = last
    return motions


@kernel
def _steady(motion: Array, points: Array, heading: float, unit: float) -> Array:
    """(3,) a motion rotated towards the background's heading about its points' centre, as far as the points allow.

    Args:
        motion: (3,). points: (L, 2). unit: metres, the error of a point.
    """
    moved = apply(motion, points)
    L = len(moved)
    x = y = told = 0.0
    for i in range(L):
        x, y = x + moved[i, 0] / L, y + moved[i, 1] / L
    for i in range(L):
        told += (moved[i, 0] - x) ** 2 + (moved[i, 1] - y) ** 2
    turn = -wrap(motion[0] - heading) / (1 + told / unit**2 * USUAL_TURN**2)
    return compose(motion_onto(turn, x, y, x, y), motion)
