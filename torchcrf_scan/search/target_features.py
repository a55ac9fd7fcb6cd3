"""What a hypothesised motion explains of the target: the second half of `inference.hypothesis_features` in loops.

Only the boxes of the target within reach of a hypothesis are looked into.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from torchcrf_scan.loops.jit import Array, Integers, kernel
from torchcrf_scan.loops.nearest import RUN
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

REACH = 6.0  # units, and the extent: how far from the members unexplained points of the target are asked for


class Marks(NamedTuple):
    """(M,) each: the hypothesis that last landed on a segment of the target, and on a piece."""

    segment: Integers
    piece: Integers


@kernel
def reach_of_runs(target: Array) -> tuple[Array, Array]:
    """How far from the members, metres, no point of a run can be explained by them, and no open one near but for their extent.

    target: (M, 9). Returns (ceil(M / 8),) each, -inf where there is none.
    """
    near, open_near = np.full((len(target) + RUN - 1) // RUN, -np.inf), np.full((len(target) + RUN - 1) // RUN, -np.inf)
    for j in range(len(target)):
        near[j // RUN] = max(near[j // RUN], OPEN * target[j, UNIT])
        if target[j, RESIDUAL] >= OPEN:
            open_near[j // RUN] = max(open_near[j // RUN], REACH * target[j, UNIT])
    return near, open_near


@kernel
def target_features(
    target: Points,
    small: Array,
    near: Array,
    open_near: Array,
    sample: Sample,
    L: int,
    size: int,
    long: float,
    marks: Marks,
    h: int,
    row: Array,
) -> None:
    """Unexplained points near the members, and whether they cover what they land on.

    Args:
        small: boxes round the runs of the target. near, open_near: of `reach_of_runs`.
        size: of the group. long: metres, its extent. h: number of the hypothesis, for `marks`.
    """
    values, labels, is_closed = target
    M = len(values)
    in_segments, in_pieces = _mark_landing(target, sample, L, marks, h)
    around = box_of(sample, L)
    low, high, half = M, -1, M - M // 2  # ends of the points that it lands on or covers, and these in two halves
    low_late, high_early = M, -1
    covered = in_segments_covered = in_pieces_covered = count = 0
    total = gain = 0.0
    last = 0
    for b in range(len(small)):
        reach = max(near[b], open_near[b] + long)
        if gap_squared(small[b], around) >= reach * reach:
            continue
        for j in range(b * RUN, min(M, (b + 1) * RUN)):
            unit, is_open = values[j, UNIT], values[j, RESIDUAL] >= OPEN
            reach = REACH * unit + long if is_open else OPEN * unit
            x, y = values[j, X], values[j, Y]
            dx, dy = max(max(around[0] - x, x - around[2]), 0.0), max(max(around[1] - y, y - around[3]), 0.0)
            if dx * dx + dy * dy >= reach * reach:
                continue
            squared, last = nearest_member(sample, L, x, y, last, 0.0 if is_open else reach * reach)
            units = math.sqrt(squared) / unit
            if is_open and units < REACH + long / unit:
                count += 1
                total += min(units, TRUNCATION)
                gain += values[j, RESIDUAL] - min(units, TRUNCATION)
            if units < OPEN:
                covered += 1
                in_segments_covered += is_open and marks.segment[labels[j, SEGMENT]] == h
                in_pieces_covered += marks.piece[labels[j, PIECE]] == h
                low, high = min(low, j), max(high, j)
                if j >= half:
                    low_late = min(low_late, j)
                else:
                    high_early = max(high_early, j)
    for k in range(L):
        j = sample.nearest[k]
        low, high = min(low, j), max(high, j)
        if j >= half:
            low_late = min(low_late, j)
        else:
            high_early = max(high_early, j)
    if low == 0 and high == M - 1 and M > 1:  # round the seam of a closed scan
        low, high = low_late, high_early
    row[AT.distinct] = math.log1p(covered / size)
    row[AT.target_open] = math.log1p(count)
    row[AT.target_residual] = total / max(count, 1)
    row[AT.target_gain] = gain / max(count, 1)
    row[AT.target_total_gain] = math.log1p(max(gain, 0.0))
    row[AT.target_cover] = in_segments_covered / max(in_segments, 1.0)
    row[AT.landing_piece_cover] = in_pieces_covered / in_pieces
    row[AT.landing_stands_out] = stands_out(values, is_closed, low, high)


@kernel
def _mark_landing(target: Points, sample: Sample, L: int, marks: Marks, h: int) -> tuple[float, float]:
    """Marks the segments and pieces that the members land on; returns how many open points and how many points they have."""
    in_segments = in_pieces = 0.0
    for k in range(L):
        j = sample.nearest[k]
        segment, piece = target.labels[j, SEGMENT], target.labels[j, PIECE]
        if marks.segment[segment] != h:
            marks.segment[segment] = h
            in_segments += target.values[j, SEGMENT_SIZE]
        if marks.piece[piece] != h:
            marks.piece[piece] = h
            in_pieces += target.values[j, PIECE_SIZE]
    return in_segments, in_pieces
