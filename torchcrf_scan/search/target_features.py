"""Features of a hypothesised motion on the target's side: the unexplained points near the moved members, and those covered.

Only the boxes of the target within reach of a hypothesis are searched.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from torchcrf_scan.loops.jit import Array, Integers, kernel
from torchcrf_scan.loops.nearest import RUN, box_distance
from torchcrf_scan.search.feature_points import (
    AT,
    PIECE,
    PIECE_SIZE,
    RESIDUAL,
    SEGMENT,
    SEGMENT_SIZE,
    UNIT,
    Points,
    X,
    Y,
    stands_out,
)
from torchcrf_scan.search.landing import Sample, box_of, gap_squared, nearest_member
from torchcrf_scan.search.leftover import OPEN, TRUNCATION

REACH = 6.0  # units beyond the members' extent within which unexplained points of the target count


class TargetScan(NamedTuple):
    """The target's M points, searched near one hypothesis after the other.

    Attributes:
        points: see `feature_points.Points`. boxes: (B, 4) round runs of them.
        near, open_near: (B,) see `reach_of_runs`.
        segment, piece: (M,) the last hypothesis whose members landed on a segment, and on a piece; -1: none.
        found, units: (M,) points near the present hypothesis, and their distances to its members in local units.
    """

    points: Points
    boxes: Array
    near: Array
    open_near: Array
    segment: Integers
    piece: Integers
    found: Integers
    units: Array


@kernel
def target_scan_of(points: Points, boxes: Array) -> TargetScan:
    """A target before the first hypothesis. boxes: (B, 4) round runs of its points."""
    M = len(points.values)
    near, open_near = reach_of_runs(points.values)
    return TargetScan(points, boxes, near, open_near, np.full(M, -1), np.full(M, -1), np.empty(M, np.int64), np.empty(M))


@kernel
def reach_of_runs(target: Array) -> tuple[Array, Array]:
    """(B,) distances, metres, within which members can explain a point of a run, and within which an open one counts.

    To the latter the members' extent is added. -inf where there is no such point. target: (M, 9).
    """
    near, open_near = np.full((len(target) + RUN - 1) // RUN, -np.inf), np.full((len(target) + RUN - 1) // RUN, -np.inf)
    for j in range(len(target)):
        near[j // RUN] = max(near[j // RUN], OPEN * target[j, UNIT])
        if target[j, RESIDUAL] >= OPEN:
            open_near[j // RUN] = max(open_near[j // RUN], REACH * target[j, UNIT])
    return near, open_near


@kernel
def target_features(target: TargetScan, sample: Sample, L: int, size: int, long: float, h: int, row: Array) -> None:
    """Writes the features of hypothesis h on the target's side to `row` (F,).

    Args:
        sample: L moved members of its group. size: points of the group. long: metres, its extent.
    """
    count = _find_near(target, sample, L, long)
    _open_features(target, count, long, row)
    _cover_features(target, count, sample, L, size, h, row)
    first, last = _ends_of_landing(target, count, sample, L)
    row[AT.landing_stands_out] = stands_out(target.points.values, target.points.is_closed, first, last)


@kernel
def _find_near(target: TargetScan, sample: Sample, L: int, long: float) -> int:
    """Writes `found` and `units` of the target, ascending; returns the number of points."""
    values, around = target.points.values, box_of(sample, L)
    count = last = 0
    for b in range(len(target.boxes)):
        reach = max(target.near[b], target.open_near[b] + long)
        if gap_squared(target.boxes[b], around) >= reach * reach:
            continue
        for j in range(b * RUN, min(len(values), (b + 1) * RUN)):
            unit, is_open = values[j, UNIT], values[j, RESIDUAL] >= OPEN
            reach = REACH * unit + long if is_open else OPEN * unit
            if box_distance(around, values[j, X], values[j, Y]) >= reach * reach:
                continue
            enough = 0.0 if is_open else reach * reach
            squared, last = nearest_member(sample, L, values[j, X], values[j, Y], last, enough)
            target.found[count], target.units[count] = j, math.sqrt(squared) / unit
            count += 1
    return count


@kernel
def _open_features(target: TargetScan, count: int, long: float, row: Array) -> None:
    """Writes how many unexplained points are near, their residuals under the hypothesis and the gains over the background."""
    values = target.points.values
    open_points = 0
    total = gain = 0.0
    for k in range(count):
        j, units = target.found[k], target.units[k]
        if values[j, RESIDUAL] >= OPEN and units < REACH + long / values[j, UNIT]:
            open_points += 1
            total += min(units, TRUNCATION)
            gain += values[j, RESIDUAL] - min(units, TRUNCATION)
    row[AT.target_open] = math.log1p(open_points)
    row[AT.target_residual] = total / max(open_points, 1)
    row[AT.target_gain] = gain / max(open_points, 1)
    row[AT.target_total_gain] = math.log1p(max(gain, 0.0))


@kernel
def _cover_features(target: TargetScan, count: int, sample: Sample, L: int, size: int, h: int, row: Array) -> None:
    """Writes the share that the members cover of the segments and pieces on which they land."""
    values, labels, _ = target.points
    in_segments, in_pieces = _mark_landing(target, sample, L, h)
    covered = in_segments_covered = in_pieces_covered = 0
    for k in range(count):
        j = target.found[k]
        if target.units[k] < OPEN:
            covered += 1
            in_segments_covered += values[j, RESIDUAL] >= OPEN and target.segment[labels[j, SEGMENT]] == h
            in_pieces_covered += target.piece[labels[j, PIECE]] == h
    row[AT.distinct] = math.log1p(covered / size)
    row[AT.target_cover] = in_segments_covered / max(in_segments, 1.0)
    row[AT.landing_piece_cover] = in_pieces_covered / in_pieces


@kernel
def _mark_landing(target: TargetScan, sample: Sample, L: int, h: int) -> tuple[float, float]:
    """Marks the segments and pieces on which the members land; returns the numbers of their open points and of all their points."""
    in_segments = in_pieces = 0.0
    for k in range(L):
        j = sample.nearest[k]
        segment, piece = target.points.labels[j, SEGMENT], target.points.labels[j, PIECE]
        if target.segment[segment] != h:
            target.segment[segment] = h
            in_segments += target.points.values[j, SEGMENT_SIZE]
        if target.piece[piece] != h:
            target.piece[piece] = h
            in_pieces += target.points.values[j, PIECE_SIZE]
    return in_segments, in_pieces


@kernel
def _ends_of_landing(target: TargetScan, count: int, sample: Sample, L: int) -> tuple[int, int]:
    """First and last of the points that the members land on or cover, also where these lead round the seam of a closed scan."""
    M = len(target.units)
    half = M - M // 2
    low, high, low_late, high_early = M, -1, M, -1
    for k in range(count + L):
        j = target.found[k] if k < count else sample.nearest[k - count]
        if k < count and not target.units[k] < OPEN:
            continue
        low, high = min(low, j), max(high, j)
        if j >= half:
            low_late = min(low_late, j)
        else:
            high_early = max(high_early, j)
    return (low_late, high_early) if low == 0 and high == M - 1 and M > 1 else (low, high)
