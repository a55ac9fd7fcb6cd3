"""Groups of points that may be one object, as lists of indices."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from torchcrf_scan.loops.jit import Array, Booleans, Integers, kernel
from torchcrf_scan.search.leftover import OPEN, Unexplained, are_joined
from torchcrf_scan.search.surface import number_runs

MIN_POINTS = 3
LIFTED = 0.9  # units, mean residual from which a piece may have moved although none of its points is open
SEGMENT_GAP = 8.0  # two unexplained segments this many spacings apart may be one object, seen with a beam missing
PART = 0.7  # of a segment: its unexplained points, if they are fewer, may be an object before a wall


class Groups(NamedTuple):
    """S sets of a scan's points: set s is members[start[s] : start[s + 1]], ascending."""

    start: Integers
    members: Integers


@kernel
def groups_of(scan: Unexplained) -> Groups:
    """Candidate objects: segments and pieces, alone and two neighbours at a time, and unexplained parts and runs."""
    surface, piece, residual = scan.grid.scan, scan.piece, scan.residual
    segment = surface.segment
    P = len(residual)
    is_open = residual >= OPEN
    store = Groups(np.zeros(6 * P + 1, np.int64), np.empty(8 * P, np.int64))  # a point is in two pairs and four other sets at most
    segments = _add_holding(segment, is_open, store, 0)
    whole = _add_holding(piece, _are_lifted(piece, residual, is_open), store, segments)
    parts = _add_parts(is_open, store, segments, whole)
    runs = _add_holding(number_runs(are_joined(segment, is_open, surface.is_closed)), is_open, store, parts)
    pairs = _add_neighbours(surface.points, surface.step, surface.noise, store, 0, segments, runs)
    return _distinct(store, _add_neighbours(surface.points, surface.step, surface.noise, store, segments, whole, pairs))


@kernel
def _are_lifted(number: Integers, residual: Array, is_open: Booleans) -> Booleans:
    """(P,) bool: open points, and those of the sets whose mean residual is high. number: (P,) set of every point."""
    total, size = np.zeros(len(number)), np.zeros(len(number))
    for i in range(len(number)):
        total[number[i]] += residual[i]
        size[number[i]] += 1
    lifted = np.empty(len(number), np.bool_)
    for i in range(len(number)):
        lifted[i] = is_open[i] or total[number[i]] / size[number[i]] >= LIFTED
    return lifted


@kernel
def _add_holding(number: Integers, wanted: Booleans, store: Groups, s: int) -> int:
    """Adds the sets that hold a wanted point (P,), by their numbers (P,), to the s of the store; returns the new s."""
    start, index = store
    size, is_held = np.zeros(len(number), np.int64), np.zeros(len(number), np.bool_)
    for i in range(len(number)):
        size[number[i]] += 1
        is_held[number[i]] = is_held[number[i]] or wanted[i]
    free = np.empty(len(number), np.int64)
    for k in range(len(number)):
        if is_held[k]:
            free[k] = start[s]
            start[s + 1] = start[s] + size[k]
            s += 1
    for i in range(len(number)):
        if is_held[number[i]]:
            index[free[number[i]]] = i
            free[number[i]] += 1
    return s


@kernel
def _add_parts(is_open: Booleans, store: Groups, upto: int, s: int) -> int:
    """Adds the open points of sets 0 to `upto` that have others too: an object before a wall may share its segment."""
    start, index = store
    for g in range(upto):
        count = start[s]
        for k in range(start[g], start[g + 1]):
            if is_open[index[k]]:
                index[count] = index[k]
                count += 1
        if count - start[s] < PART * (start[g + 1] - start[g]) - 1e-9:  # so many just are no part
            s += 1
            start[s] = count
    return s


@kernel
def _add_neighbours(points: Array, step: float, noise: float, store: Groups, low: int, high: int, s: int) -> int:
    """Adds every set from `low` to `high` together with the next one, where they are near."""
    start, index = store
    S = high - low
    for g in range(low, high - 1 if S <= 2 else high):  # the second of two with the first would be the same again
        h = g + 1 if g + 1 < high else low
        last = ends(index[start[g] : start[g + 1]], len(points))[1]
        first = ends(index[start[h] : start[h + 1]], len(points))[0]
        dx, dy = points[last, 0] - points[first, 0], points[last, 1] - points[first, 1]
        footprint = math.sqrt(points[last, 0] ** 2 + points[last, 1] ** 2) * step
        if math.sqrt(dx * dx + dy * dy) < SEGMENT_GAP * footprint + 6 * noise:
            start[s + 1] = _merge(index, start[g], start[g + 1], start[h], start[h + 1], start[s])
            s += 1
    return s


@kernel
def _merge(index: Integers, i: int, last_i: int, j: int, last_j: int, count: int) -> int:
    """Writes two sets that have no point in common to index[count:], ascending; returns the new count."""
    while i < last_i or j < last_j:
        if j == last_j or (i < last_i and index[i] < index[j]):
            index[count] = index[i]
            i += 1
        else:
            index[count] = index[j]
            j += 1
        count += 1
    return count


@kernel
def _distinct(store: Groups, sets: int) -> Groups:
    """Those of all sets that have enough points, each once, in the order of their rows of flags."""
    start, index = store
    order = np.empty(sets, np.int64)
    S = count = 0
    for s in range(sets):
        if start[s + 1] - start[s] >= MIN_POINTS:
            S += _insert(order, S, s, start, index)
    first, members = np.zeros(S + 1, np.int64), np.empty(start[sets], np.int64)
    for k in range(S):
        for i in range(start[order[k]], start[order[k] + 1]):
            members[count] = index[i]
            count += 1
        first[k + 1] = count
    return Groups(first, members[:count].copy())


@kernel
def _insert(order: Integers, count: int, s: int, start: Integers, index: Integers) -> int:
    """Puts set s into the sorted `order` of `count` others; returns 1, or 0 where it is there already."""
    low, high = 0, count
    while low < high:
        middle = (low + high) // 2
        other = order[middle]
        sign = _compare(index, start[s], start[s + 1], start[other], start[other + 1])
        if sign == 0:
            return 0
        if sign < 0:
            high = middle
        else:
            low = middle + 1
    for k in range(count, low, -1):
        order[k] = order[k - 1]
    order[low] = s
    return 1


@kernel
def _compare(index: Integers, i: int, last_i: int, j: int, last_j: int) -> int:
    """Negative, 0 or positive: the row of flags of a set is less than, the same as or greater than that of another."""
    while i < last_i and j < last_j:
        if index[i] != index[j]:
            return index[j] - index[i]
        i, j = i + 1, j + 1
    return (last_i - i) - (last_j - j)


@kernel
def ends(index: Integers, count: int) -> tuple[int, int]:
    """First and last of a set, also where it leads round the seam of a closed scan of `count` points. index: (L,) ascending."""
    first, last = index[0], index[-1]
    if first == 0 and last == count - 1 and count > 1:
        k = 0
        while index[k] < count - count // 2:
            k += 1
        first, last = index[k], index[k - 1]
    return first, last
