"""The leftover of a background motion: residuals and free-space tests of both scans under it."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from torchcrf_scan.loops.jit import Array, Booleans, Integers, entry, kernel
from torchcrf_scan.loops.rigid import apply, apply_to_rows, inverse
from torchcrf_scan.search.background import unit_length
from torchcrf_scan.search.grid import HALF_SPACING, ScanGrid, locate
from torchcrf_scan.search.surface import Surface, look_along, number_runs

TRUNCATION = 3.0  # units; larger residuals are clipped
OPEN = 1.5  # units; points of larger residual are unexplained
PIECE_GAP = 2.5  # beam spacings above which two neighbours on a segment may belong to two objects


class Unexplained(NamedTuple):
    """One scan of P points with its residuals under the background's motion.

    Attributes:
        grid: the scan, for nearest points.
        units: (P,) metres, usual distance of a well registered point.
        residual: (P,) units to the other scan, at most `TRUNCATION`.
        sight: (P,) free-space test in the other scan (`surface.look_along`).
        piece: (P,) number of every point's piece.
    """

    grid: ScanGrid
    units: Array
    residual: Array
    sight: Integers
    piece: Integers


class Leftover(NamedTuple):
    """Both scans under a background motion.

    Attributes:
        background: (3,). carried: (P, 2) source points under it.
        unit: metres, the size of an ordinary registration error.
    """

    source: Unexplained
    target: Unexplained
    background: Array
    carried: Array
    unit: float


@entry
def leftover_of(source: ScanGrid, target: ScanGrid, background: Array) -> Leftover:
    """The leftover of a background motion (3,)."""
    forward = apply(background, source.scan.points)
    source_units, target_units = _point_units(source), _point_units(target)
    here = _unexplained(source, source_units, background, target, target_units)
    there = _unexplained(target, target_units, inverse(background), source, source_units)
    return Leftover(here, there, background, forward, unit_length(source.scan, target.scan))


@kernel
def _point_units(grid: ScanGrid) -> Array:
    """(P,) metres: usual distance of a well registered point of another scan from a point of the surface."""
    units = np.empty(len(grid.features))
    for i in range(len(units)):
        units[i] = grid.features[i, HALF_SPACING] + 2 * grid.scan.noise
    return units


@kernel
def residual_at(moved: Array, grid: ScanGrid, units: Array, residual: Array, index: Integers) -> None:
    """Writes distance to a scan in its local units (M,), truncated, and nearest point. moved: (2, P). residual, index: (P,)."""
    locate(moved, grid, residual, index)
    for i in range(len(index)):
        residual[i] = min(math.sqrt(residual[i]) / units[index[i]], TRUNCATION)


@kernel
def _unexplained(grid: ScanGrid, units: Array, motion: Array, other: ScanGrid, other_units: Array) -> Unexplained:
    """Residuals and free-space tests of a scan under a motion (3,) into the frame of the other. units: (P,), other_units: (M,)."""
    P = len(units)
    moved, residual, index, sight = np.empty((2, P)), np.empty(P), np.empty(P, np.int64), np.empty(P, np.int64)
    apply_to_rows(motion, grid.scan.points, moved)
    residual_at(moved, other, other_units, residual, index)
    for i in range(P):
        sight[i] = look_along(other.scan, moved[0, i], moved[1, i])
    return Unexplained(grid, units, residual, sight, pieces(grid.scan))


@kernel
def are_joined(segment: Integers, is_open: Booleans, is_closed: bool) -> Booleans:
    """(P,) bool: a point and the next one lie on one segment and are both open or both not (P,)."""
    P = len(is_open)
    joined = np.empty(P, np.bool_)
    for i in range(P):
        j = i + 1 if i + 1 < P else 0
        joined[i] = segment[i] == segment[j] and is_open[i] == is_open[j]
    joined[P - 1] = joined[P - 1] and is_closed
    return joined


@kernel
def pieces(surface: Surface) -> Integers:
    """(P,) number of every point's piece: segments, cut where neighbours lie far apart for a surface met at no flat angle."""
    points, ranges, step, noise = surface.points, surface.ranges, surface.step, surface.noise
    P = len(points)
    joined = are_joined(surface.segment, np.zeros(P, np.bool_), surface.is_closed)
    for i in range(P):
        j = i + 1 if i + 1 < P else 0
        dx, dy = points[j, 0] - points[i, 0], points[j, 1] - points[i, 1]
        joined[i] = joined[i] and math.sqrt(dx * dx + dy * dy) <= PIECE_GAP * ranges[i] * step + 6 * noise
    return number_runs(joined)
