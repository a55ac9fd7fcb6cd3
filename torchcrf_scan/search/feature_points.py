"""Per-point arrays of one scan for the features of hypotheses, and the columns of these features."""

from __future__ import annotations

from collections import namedtuple
from typing import Any, NamedTuple, cast

import numpy as np

from torchcrf_scan.loops.jit import Array, Booleans, Integers, kernel
from torchcrf_scan.search.leftover import Unexplained
from torchcrf_scan.search.score import FEATURES

JUMP = 4.0  # units of range beyond an object at which the returns next to it count fully as behind it

Columns: Any = cast(Any, namedtuple)("Columns", FEATURES)
AT = Columns(*range(len(FEATURES)))  # the number of every feature's column


class Points(NamedTuple):
    """One scan of P points, the values of a point side by side in memory.

    Attributes:
        values: (P, 9) position, unit, residual, range, tangent, size of its segment and of its piece.
        labels: (P, 3) segment, piece, and free-space test in the other scan.
    """

    values: Array
    labels: Integers
    is_closed: bool


X, Y, UNIT, RESIDUAL, RANGE, TANGENT_X, TANGENT_Y, SEGMENT_SIZE, PIECE_SIZE = range(9)
SEGMENT, PIECE, SIGHT = range(3)


@kernel
def points_of(scan: Unexplained, counted: Booleans) -> Points:
    """Per-point arrays of a scan; the size of a segment is the number of its points that are counted (P,)."""
    surface, P = scan.grid.scan, len(scan.units)
    segments, pieces = np.zeros(P), np.zeros(P)
    values, labels = np.empty((P, 9)), np.empty((P, 3), np.int64)
    for i in range(P):
        segments[surface.segment[i]] += counted[i]
        pieces[scan.piece[i]] += 1
    for i in range(P):
        values[i, X], values[i, Y] = surface.points[i, 0], surface.points[i, 1]
        values[i, UNIT], values[i, RESIDUAL], values[i, RANGE] = scan.units[i], scan.residual[i], surface.ranges[i]
        values[i, TANGENT_X], values[i, TANGENT_Y] = surface.tangent[i, 0], surface.tangent[i, 1]
        values[i, SEGMENT_SIZE], values[i, PIECE_SIZE] = segments[surface.segment[i]], pieces[scan.piece[i]]
        labels[i, SEGMENT], labels[i, PIECE], labels[i, SIGHT] = surface.segment[i], scan.piece[i], scan.sight[i]
    return Points(values, labels, surface.is_closed)


@kernel
def stands_out(scan: Array, is_closed: bool, first: int, last: int) -> float:
    """Depth jump at both ends of a set: 1 if the returns next to it lie behind, -1 if they lie in front. scan: (P, 9)."""
    P = len(scan)
    total = 0.0
    if first > 0 or is_closed:
        jump = (scan[(first - 1) % P, RANGE] - scan[first, RANGE]) / (JUMP * scan[first, UNIT])
        total += min(max(jump, -1.0), 1.0)
    if last < P - 1 or is_closed:
        jump = (scan[(last + 1) % P, RANGE] - scan[last, RANGE]) / (JUMP * scan[last, UNIT])
        total += min(max(jump, -1.0), 1.0)
    return total / 2
