"""Grid of a scan for nearest-point queries, built once, with the per-point features of registration.

A start queries some ten thousand nearest points of the same two scans, a search some hundred thousand.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from torchcrf_scan.loops.jit import Array, Integers, entry, kernel
from torchcrf_scan.loops.median import lower_median
from torchcrf_scan.loops.nearest import RUN, Boxes, nearest
from torchcrf_scan.search.surface import Surface

ROUGHNESS = 0.1  # of the spacing: usual distance of a surface from the straight line between two returns,
LONELY = 0.5  # and of a return without neighbours

LENGTH_SHARE = (0.25, 4.0)  # bounds of the length of surface represented by a point, in medians, in registration,
COST_SHARE = (0.1, 10.0)  # and in the comparison of motions

BLOCKS = 16  # along the longer side of the grid
POINTS_PER_SIDE, MOST_SIDES = 2, 16  # one more cell a side for every so many points of a block, and the maximum of cells a side
GRID_MARGIN = 0.1  # of that side, beyond the scan: points move there during the search
FEATURES = 8  # of a point of a `ScanGrid`; they fill a cache line
X, Y, TANGENT_X, TANGENT_Y, HALF_SPACING, UNIT = range(6)  # their meaning; the rest is padding


class ScanGrid(NamedTuple):
    """A scan of P points on which others are registered.

    Attributes:
        scan: the scan itself.
        features: (P, 8) position, tangent, half the spacing, and unit of `surface_residual`, of every point.
        pull: (P,) how much every point counts where it is registered, by the surface that it stands for.
        charge: (P,) the same where motions are compared.
        low: (2,) corner of the grid. per_metre: blocks in a metre. columns, rows: blocks, which count row by row.
        side: (columns rows,) cells along the side of a block, the more the more points are near. cell: (columns rows,) its first
            cell; they count row by row, block after block.
        first: (cells + 1,), near: (L,) the nearest point to a place in cell c is among near[first[c]:first[c + 1]].
    """

    scan: Surface
    features: Array
    pull: Array
    charge: Array
    low: Array
    per_metre: float
    columns: int
    rows: int
    side: Integers
    cell: Integers
    first: Integers
    near: Integers


@kernel
def share_of(length: Array, low: float, high: float) -> Array:
    """(P,) metres of surface in units of their median, clipped."""
    usual = max(lower_median(length), 1e-6)
    share = np.empty_like(length)
    for i in range(len(length)):
        share[i] = min(max(length[i] / usual, low), high)
    return share


@kernel
def _features_of(scan: Surface) -> Array:
    features = np.zeros((len(scan.points), FEATURES))
    for i in range(len(features)):
        tx, ty = scan.tangent[i, 0], scan.tangent[i, 1]
        roughness = LONELY if tx == 0 and ty == 0 else ROUGHNESS
        features[i, X], features[i, Y] = scan.points[i, 0], scan.points[i, 1]
        features[i, TANGENT_X], features[i, TANGENT_Y] = tx, ty
        features[i, HALF_SPACING] = scan.spacing[i] / 2
        features[i, UNIT] = roughness * scan.spacing[i] + 2 * scan.noise
    return features


@kernel
def _points_near(boxes: Boxes, x: float, y: float, half: float, guess: int, near: Integers) -> tuple[int, int]:
    """Writes the points that are nearest to some place in the square round (x, y), and maybe a few others, to `near`.

    A point is nearest to no place there if the point nearest to the middle is nearer to every corner of the square.

    Returns:
        How many they are, and which is nearest to the middle.
    """
    points, small, large = boxes
    least, index = nearest(boxes, x, y, guess)
    px, py = points[index, 0], points[index, 1]
    limit = (abs(px - x) + half) ** 2 + (abs(py - y) + half) ** 2  # nowhere in the square it is farther than this
    count = 0
    for c in range(len(large)):
        dx = max(max(large[c, 0] - x, x - large[c, 2]) - half, 0.0)
        dy = max(max(large[c, 1] - y, y - large[c, 3]) - half, 0.0)
        if dx * dx + dy * dy > limit:
            continue
        for b in range(c * RUN, min(len(small), (c + 1) * RUN)):
            dx = max(max(small[b, 0] - x, x - small[b, 2]) - half, 0.0)
            dy = max(max(small[b, 1] - y, y - small[b, 3]) - half, 0.0)
            if dx * dx + dy * dy > limit:
                continue
            for j in range(b * RUN, min(len(points), (b + 1) * RUN)):
                dx, dy = points[j, 0] - x, points[j, 1] - y
                if dx * dx + dy * dy <= least + 2 * half * (abs(points[j, 0] - px) + abs(points[j, 1] - py)):
                    near[count] = j
                    count += 1
    return count, index


@kernel
def _keep_nearest(
    points: Array, x: float, y: float, half_x: float, half_y: float, some: Integers, count: int, near: Integers
) -> int:
    """Like `_points_near`, for a rectangle and from the first `count` of `some` points alone; returns how many there are."""
    least, px, py = np.inf, 0.0, 0.0
    for k in range(count):
        dx, dy = points[some[k], 0] - x, points[some[k], 1] - y
        if dx * dx + dy * dy < least:
            least, px, py = dx * dx + dy * dy, points[some[k], 0], points[some[k], 1]
    kept = 0
    for k in range(count):
        j = some[k]
        dx, dy = points[j, 0] - x, points[j, 1] - y
        near[kept] = j  # is written over where the point is not kept: no jump
        reach = least + 2 * (half_x * abs(points[j, 0] - px) + half_y * abs(points[j, 1] - py))
        kept += 1 if dx * dx + dy * dy <= reach else 0
    return kept


@kernel
def _lay_out(scan: Surface) -> tuple[Array, float, int, int]:
    """Corner, blocks in a metre, columns and rows of the grid."""
    large = scan.boxes.large
    low, high = np.full(2, np.inf), np.full(2, -np.inf)
    for c in range(len(large)):
        for axis in range(2):
            low[axis] = min(low[axis], large[c, axis])
            high[axis] = max(high[axis], large[c, 2 + axis])
    extent = max(max(high[0] - low[0], high[1] - low[1]), 1e-6)
    size = extent * (1 + 2 * GRID_MARGIN) / BLOCKS
    columns = int((high[0] - low[0] + 2 * GRID_MARGIN * extent) / size) + 1
    rows = int((high[1] - low[1] + 2 * GRID_MARGIN * extent) / size) + 1
    for axis in range(2):
        low[axis] -= GRID_MARGIN * extent
    return low, 1 / size, columns, rows


@entry
def grid_of(scan: Surface) -> ScanGrid:
    """The grid of a scan; takes some tenths of a millisecond."""
    points, P = scan.points, len(scan.points)
    low, per_metre, columns, rows = _lay_out(scan)
    size = 1 / per_metre
    side, cell = np.empty(columns * rows, np.int64), np.empty(columns * rows, np.int64)
    some, fewer = np.empty(P, np.int64), np.empty(P, np.int64)
    first, near = np.zeros(16 * columns * rows + 1, np.int64), np.empty(64 * columns * rows + P, np.int64)
    cells, total, guess = 0, 0, 0
    for block in range(columns * rows):
        left, bottom = low[0] + (block % columns) * size, low[1] + (block // columns) * size
        half = size / 2 * (1 + 1e-9)  # a place on an edge may be counted to either side
        count, guess = _points_near(scan.boxes, left + size / 2, bottom + size / 2, half, guess, some)
        inside = 0
        for k in range(count):
            x, y = points[some[k], 0] - left, points[some[k], 1] - bottom
            inside += 1 if min(x, y) >= 0 and max(x, y) <= size else 0
        sides = min(1 + min(count // 2, 1) + inside // POINTS_PER_SIDE, MOST_SIDES)
        side[block], cell[block] = sides, cells
        if cells + sides * sides >= len(first):
            first = np.concatenate((first, np.empty(len(first), np.int64)))
        for row in range(sides):
            y = bottom + (row + 0.5) / sides * size
            of_row = _keep_nearest(points, left + size / 2, y, half, half / sides, some, count, fewer)
            while total + sides * of_row > len(near):
                near = np.concatenate((near, np.empty(len(near), np.int64)))
            for column in range(sides):
                x = left + (column + 0.5) / sides * size
                total += _keep_nearest(points, x, y, half / sides, half / sides, fewer, of_row, near[total:])
                cells += 1
                first[cells] = total
    pull, charge = share_of(scan.length, LENGTH_SHARE[0], LENGTH_SHARE[1]), share_of(scan.length, COST_SHARE[0], COST_SHARE[1])
    return ScanGrid(
        scan, _features_of(scan), pull, charge, low, per_metre, columns, rows, side, cell, first[: cells + 1], near[:total]
    )


@kernel
def locate(moved: Array, grid: ScanGrid, squared: Array, index: Integers) -> None:
    """Writes squared distance to and index of the nearest point of every moved point.

    Args:
        moved: (2 or more, P or more) x and y of points in the frame of `grid`.
        squared: (P,). index: (P,).
    """
    points = grid.scan.points
    low_x, low_y, per_metre, columns, rows = grid.low[0], grid.low[1], grid.per_metre, grid.columns, grid.rows
    side, cells, first, near = grid.side, grid.cell, grid.first, grid.near
    found = np.uint64(0)
    for i in range(len(index)):
        x, y = moved[0, i], moved[1, i]
        u, v = (x - low_x) * per_metre, (y - low_y) * per_metre
        if 0 <= u < columns and 0 <= v < rows:
            column, row = int(u), int(v)
            block = np.uint64(row * columns + column)  # unsigned numbers never count from an array's end
            sides = side[block]
            cell = np.uint64(cells[block] + int((v - row) * sides) * sides + int((u - column) * sides))
            least = np.inf
            for k in range(np.uint64(first[cell]), np.uint64(first[cell + np.uint64(1)])):
                j = np.uint64(near[k])
                dx, dy = points[j, 0] - x, points[j, 1] - y
                distance = dx * dx + dy * dy
                if distance < least:
                    least, found = distance, j
        else:
            least, far = nearest(grid.scan.boxes, x, y, int(found))
            found = np.uint64(far)
        squared[i], index[i] = least, found
