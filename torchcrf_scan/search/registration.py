"""Robust rigid registration by Gauss-Newton steps, one hypothesis at a time.

Within a loop over hypotheses points are (2, P), so that sums over them run along memory.
"""

from __future__ import annotations

import numpy as np

from torchcrf_scan.inference.motion import LARGEST_TURN, SHIFT_DAMPING, TURN_DAMPING
from torchcrf_scan.loops.jit import Array, Integers, kernel
from torchcrf_scan.loops.rigid import apply_to_rows, compose_into, inverse, motion_onto, rotate, transform_of
from torchcrf_scan.loops.solve import solve
from torchcrf_scan.search.grid import HALF_SPACING, TANGENT_X, TANGENT_Y, UNIT, ScanGrid, X, Y, locate

LEAST_DAMPING = 1e-10  # square metres, far below any noise: lengths may be of any size
PAIR_ROWS = 7  # of points and their partners: moved x and y, partner's x and y, tangent's x and y, weight

# One step.


@kernel
def surface_residual(moved: Array, grid: ScanGrid, squared: Array, index: Integers) -> None:
    """Writes the square of the distance to a scan's surface in units of its noise and roughness, and the nearest point.

    Args:
        moved, squared, index: as in `locate`.
    """
    locate(moved, grid, squared, index)
    for i in range(len(index)):
        at = grid.features[index[i]]
        along = abs((moved[0, i] - at[X]) * at[TANGENT_X] + (moved[1, i] - at[Y]) * at[TANGENT_Y])
        beyond = max(along - at[HALF_SPACING], 0.0)
        squared[i] = max(squared[i] - (along * along - beyond * beyond), 0.0) / (at[UNIT] * at[UNIT])


@kernel
def gauss_newton_step(pairs: Array, along: float, damping: float) -> Array:
    """(3,) one least-squares step of a rigid motion, applied after the present one; the identity where all weights are 0.

    Args:
        pairs: (7, P) moved points, partners, tangents and weights, a coordinate a row.
        along: 1 point-to-point, 0 point-to-line.
        damping: square length, of a rotation about a single point, which has no lever.
    """
    xs, ys, partner_xs, partner_ys, tangent_xs, tangent_ys, weights = pairs
    total = sum_x = sum_y = 0.0
    for i in range(len(weights)):
        w = weights[i]
        total += w
        sum_x += w * xs[i]
        sum_y += w * ys[i]
    total = max(total, 1e-9)
    pivot_x, pivot_y = sum_x / total, sum_y / total
    slack = 1 - along
    scale = n00 = n01 = n02 = n11 = n12 = n22 = r0 = r1 = r2 = 0.0
    for i in range(len(weights)):
        w, tx, ty = weights[i], tangent_xs[i], tangent_ys[i]
        rx, ry = xs[i] - partner_xs[i], ys[i] - partner_ys[i]
        lx, ly = pivot_y - ys[i], xs[i] - pivot_x  # d moved / d theta, rotation about the weighted centre
        lever = lx * lx + ly * ly
        wlt, wrt, wst = w * slack * (lx * tx + ly * ty), w * slack * (rx * tx + ry * ty), w * slack * tx
        scale += w * lever
        n00 += w * lever - wlt * (lx * tx + ly * ty)
        n01 += w * lx - wlt * tx
        n02 += w * ly - wlt * ty
        n11 += w - wst * tx
        n12 -= wst * ty
        n22 += w - w * slack * ty * ty
        r0 += wrt * (lx * tx + ly * ty) - w * (lx * rx + ly * ry)
        r1 += wrt * tx - w * rx
        r2 += wrt * ty - w * ry
    n00 += TURN_DAMPING * scale + damping * total
    n11, n22 = n11 + SHIFT_DAMPING * total, n22 + SHIFT_DAMPING * total
    theta, x, y = solve(n00, n01, n02, n11, n12, n22, r0, r1, r2)
    step = motion_onto(min(max(theta, -LARGEST_TURN), LARGEST_TURN), pivot_x, pivot_y, pivot_x, pivot_y)
    step[1], step[2] = step[1] + x, step[2] + y
    return step


# Many steps.


@kernel
def _pair(grid: ScanGrid, squared: Array, index: Integers, weights: Array, gate: float, pairs: Array) -> None:
    """Writes partner, tangent and robust weight of all points to the rows 2.. of `pairs`."""
    for i in range(len(index)):
        at = grid.features[index[i]]
        unit = gate + at[HALF_SPACING]
        kept = unit * unit / (unit * unit + squared[i])
        pairs[2, i], pairs[3, i], pairs[4, i], pairs[5, i] = at[X], at[Y], at[TANGENT_X], at[TANGENT_Y]
        pairs[6, i] = weights[i] * kept * kept


@kernel
def register(source: Array, weights: Array, target: ScanGrid, motions: Array, gates: Array, along: Array) -> Array:
    """(H, 3) refined motions: iterated closest points with robust (Geman-McClure) weights and a shrinking gate.

    Args:
        source: (P, 2), weights: (P,) points and their weights.
        motions: (H, 3) starts.
        gates: (I,) residual, in metres, at which a point's weight is a quarter, for every iteration.
        along: (I,) weight of the residual along the surface (1 = point to point).
    """
    refined = motions.copy()
    pairs, squared, index = np.empty((PAIR_ROWS, len(source))), np.empty(len(source)), np.empty(len(source), np.int64)
    for h in range(len(motions)):
        motion = refined[h]
        for i in range(len(gates)):
            apply_to_rows(motion, source, pairs)
            locate(pairs, target, squared, index)
            _pair(target, squared, index, weights, gates[i], pairs)
            compose_into(motion, gauss_newton_step(pairs, along[i], LEAST_DAMPING))
    return refined


@kernel
def _pair_both(
    source: ScanGrid, target: ScanGrid, motion: Array, squared: Array, onto: Integers, back: Integers, gate: float, pairs: Array
) -> None:
    """Writes the rows of `pairs` from all source points, moved already, to the target, and from all target points back."""
    N, by = len(onto), transform_of(motion)
    for i in range(N):
        at = target.features[onto[i]]
        pairs[2, i], pairs[3, i], pairs[4, i], pairs[5, i] = at[X], at[Y], at[TANGENT_X], at[TANGENT_Y]
    for k in range(len(back)):
        i, at = N + k, source.features[back[k]]
        pairs[0, i], pairs[1, i] = pairs[0, back[k]], pairs[1, back[k]]
        pairs[2, i], pairs[3, i] = target.features[k, X], target.features[k, Y]
        pairs[4, i], pairs[5, i] = rotate(by, at[TANGENT_X], at[TANGENT_Y])
    for i in range(len(squared)):
        kept = gate * gate / (gate * gate + squared[i])
        pairs[6, i] = kept * kept


@kernel
def register_both(source: ScanGrid, target: ScanGrid, motions: Array, gates: Array, along: Array) -> Array:
    """(H, 3) like `register`, with all points of both scans in one step: source on target and target on source.

    Args:
        motions: (H, 3) starts.
        gates: (I,) `surface_residual` at which a point's weight is a quarter, for every iteration.
        along: (I,) weight of the residual along the surface (1 = point to point).
    """
    N, M = len(source.features), len(target.features)
    refined = motions.copy()
    pairs, returned, squared = np.empty((PAIR_ROWS, N + M)), np.empty((2, M)), np.empty(N + M)
    onto, back = np.empty(N, np.int64), np.empty(M, np.int64)
    for h in range(len(motions)):
        motion = refined[h]
        for i in range(len(gates)):
            apply_to_rows(motion, source.scan.points, pairs)
            surface_residual(pairs, target, squared[:N], onto)
            apply_to_rows(inverse(motion), target.scan.points, returned)
            surface_residual(returned, source, squared[N:], back)
            _pair_both(source, target, motion, squared, onto, back, gates[i], pairs)
            compose_into(motion, gauss_newton_step(pairs, along[i], LEAST_DAMPING))
    return refined
