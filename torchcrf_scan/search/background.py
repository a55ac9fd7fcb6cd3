"""Registration of the background from a guess, and the cost of a motion: the residual it leaves unexplained."""

from __future__ import annotations

import math

import numpy as np

from torchcrf_scan.loops.jit import Array, Integers, entry, kernel
from torchcrf_scan.loops.median import lower_median
from torchcrf_scan.loops.rigid import apply_to_rows, inverse, parting, transform_of
from torchcrf_scan.search.grid import COST_SHARE, ScanGrid, share_of
from torchcrf_scan.search.registration import register, register_both, surface_residual
from torchcrf_scan.search.surface import OCCLUDED, SEEN_THROUGH, UNMEASURED, Surface, bearing_of, look_between

TRUNCATION = 3.0  # units; larger residuals are clipped
CONTRADICTION = 3.0  # units charged for a point that contradicts the other scan's free space (design finding 17)
TRUSTED = 2.5  # units both ways; a guess with less remaining cost after its refinement is accepted as the background,
FOLLOWED = 8.0  # units; if the refinement moved half of the points by less than this
UNSEEN = 1.5  # units charged for a point outside the other scan's view; otherwise leaving the map would be free
POLISH_GATES, POLISH_ALONG = np.array((4.0, 3.0, 2.0, 1.5)), np.array((0.1,) * 4)
REFINE_GATES, REFINE_ALONG = np.array((3.0, 2.0, 2.0, 1.5, 1.5, 1.5)), np.array((0.03,) * 6)


@entry
def unit_length(source: Surface, target: Surface) -> float:
    """Metres: the size of an ordinary registration error, from spacing and noise alone: the unit of all gates."""
    return lower_median(np.concatenate((source.spacing, target.spacing))) / 2 + 2 * max(source.noise, target.noise)


@kernel
def every(values: Array, stride: int) -> Array:
    """Every stride-th of the rows, as a contiguous array."""
    return values[::stride].copy()


@kernel
def stride_of(points: int, most: int) -> int:
    """Stride that selects about `most` of the points, 0: all."""
    return 1 if most == 0 else max(1, -(-points // most))


@kernel
def _charge_far(scan: Surface, moved: Array, share: Array, squared: Array, limit: float) -> float:
    """Sum over the points whose squared residual is at least `limit`, by their free-space tests.

    Args:
        moved: (2 or more, P) points in the frame of `scan`. share, squared: (P,).
    """
    M, bearings = len(scan.ranges), scan.bearings
    after, total = 0, 0.0
    for i in range(len(share)):
        if squared[i] < limit:
            continue
        dx, dy = moved[0, i] - scan.origin[0], moved[1, i] - scan.origin[1]
        bearing = bearing_of(scan, dx, dy)
        while after > 0 and bearings[after - 1] >= bearing:  # the next far point mostly lies between the same or the next beams
            after -= 1
        while after < M and bearings[after] < bearing:
            after += 1
        sight = look_between(scan, bearing, after, math.sqrt(dx * dx + dy * dy))
        if sight in (OCCLUDED, UNMEASURED):
            total += share[i] * UNSEEN
        else:
            total += share[i] * (TRUNCATION + (CONTRADICTION if sight == SEEN_THROUGH else 0.0))
    return total


@kernel
def _one_way(motion: Array, points: Array, share: Array, other: ScanGrid, slack: float, moved: Array, index: Integers) -> float:
    """Truncated residual of (P, 2) points under a motion, weighted by (P,) shares, in the other scan, plus the free-space cost.

    moved: (3, P) and index: (P,) are scratch space.
    """
    apply_to_rows(motion, points, moved)
    squared = moved[2]
    surface_residual(moved, other, squared, index)
    limit = (TRUNCATION * slack) ** 2
    near = weight = 0.0
    for i in range(len(share)):
        weight += share[i]
        near += share[i] * math.sqrt(squared[i]) if squared[i] < limit else 0.0
    return (near / slack + _charge_far(other.scan, moved, share, squared, limit)) / weight


@kernel
def _some_of(grid: ScanGrid, stride: int) -> tuple[Array, Array]:
    """Every stride-th point, (P, 2), and its share of the scan's surface, (P,)."""
    if stride == 1:
        return grid.scan.points, grid.charge
    return every(grid.scan.points, stride), share_of(every(grid.scan.length, stride), COST_SHARE[0], COST_SHARE[1])


@entry
def background_cost(motions: Array, source: ScanGrid, target: ScanGrid, most: int, slack: float) -> Array:
    """(H,) truncated residual of the whole scene under every motion, both ways (design finding 17).

    Args:
        motions: (H, 3).
        most: approximate number of points of either scan to evaluate, 0: all.
        slack: factor on the unit of residuals, for motions that are not registered yet.
    """
    points, share = _some_of(source, stride_of(len(source.features), most))
    partners, partner_share = _some_of(target, stride_of(len(target.features), most))
    moved, index = np.empty((3, len(points))), np.empty(len(points), np.int64)
    back, back_index = np.empty((3, len(partners))), np.empty(len(partners), np.int64)
    cost = np.empty(len(motions))
    for h in range(len(motions)):
        forward = _one_way(motions[h], points, share, target, slack, moved, index)
        cost[h] = forward + _one_way(inverse(motions[h]), partners, partner_share, source, slack, back, back_index)
    return cost


@kernel
def cost_of(motion: Array, source: ScanGrid, target: ScanGrid) -> float:
    """`background_cost` of one motion (3,), with all points."""
    return float(background_cost(motion.reshape(1, 3), source, target, 0, 1.0)[0])


@entry
def polish(motions: Array, source: ScanGrid, target: ScanGrid, unit: float) -> Array:
    """(H, 3) motions registered with wide gates, from starts (H, 3) that are a few gates off; accurate enough for `refine`."""
    return register(source.scan.points, source.pull, target, motions, unit * POLISH_GATES, POLISH_ALONG)


@entry
def refine(motions: Array, source: ScanGrid, target: ScanGrid) -> Array:
    """(H, 3) motions registered point-to-line with all points both ways, from good starts, by the residual of `background_cost`."""
    return register_both(source, target, motions, REFINE_GATES, REFINE_ALONG)


@kernel
def _median_gap(points: Array, one: Array, other: Array) -> float:
    """Lower median over points (P, 2) of the distance between their places under two motions (3,), metres."""
    a, b, gap = transform_of(one), transform_of(other), np.empty(len(points))
    for i in range(len(points)):
        gap[i] = parting(a, b, points[i, 0], points[i, 1])
    return lower_median(gap)


@entry
def follow(guess: Array, source: ScanGrid, target: ScanGrid) -> tuple[bool, Array]:
    """Whether the refinement of a guess (3,) is accepted as the background, and the refined motion (3,)."""
    unit = unit_length(source.scan, target.scan)
    motion = refine(polish(guess.reshape(1, 3), source, target, unit), source, target)[0]
    is_near = _median_gap(source.scan.points, motion, guess) < FOLLOWED * unit
    return is_near and cost_of(motion, source, target) < TRUSTED, motion
