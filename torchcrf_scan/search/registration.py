"""Robust rigid registration, one hypothesis at a time; `inference.registration` in loops.

Inside a loop over hypotheses points are (2, P), so that sums over them run along memory.
"""

from __future__ import annotations

import math

import numpy as np

from torchcrf_scan.inference.motion import LARGEST_TURN, LEAST_DAMPING, SHIFT_DAMPING, TURN_DAMPING
from torchcrf_scan.loops.jit import Array, Integers, kernel
from torchcrf_scan.loops.rigid import inverse, wrap
from torchcrf_scan.search.grid import HALF_SPACING, TANGENT_X, TANGENT_Y, UNIT, ScanGrid, X, Y, locate

PAIR_ROWS = 7  # of points and their partners: moved x and y, partner's x and y, tangent's x and y, weight

# One step.


@kernel
def carry(motion: Array, points: Array, moved: Array) -> None:
    """Writes (P, 2) points under a motion (3,) to (2, P)."""
    cos, sin = math.cos(motion[0]), math.sin(motion[0])
    for i in range(len(points)):
        x, y = points[i, 0], points[i, 1]
        moved[0, i] = cos * x - sin * y + motion[1]
        moved[1, i] = sin * x + cos * y + motion[2]


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
def _solve(normal: Array, right: Array) -> None:
    """Solves a positive definite system (3, 3) in place of its right side (3,); only the upper half is read."""
    a, b, c = normal[0, 0], normal[0, 1], normal[0, 2]
    l1, l2 = b / a, c / a
    d = normal[1, 1] - l1 * b
    e = normal[1, 2] - l1 * c
    l3 = e / d
    f = normal[2, 2] - l2 * c - l3 * e
    y1 = right[1] - l1 * right[0]
    y2 = right[2] - l2 * right[0] - l3 * y1
    right[2] = y2 / f
    right[1] = y1 / d - l3 * right[2]
    right[0] = right[0] / a - l1 * right[1] - l2 * right[2]


@kernel
def gauss_newton_step(pairs: Array, along: float) -> Array:
    """(3,) one least-squares step of a rigid motion, applied after the present one; the identity where all weights are 0.

    Args:
        pairs: (7, P) moved points, partners, tangents and weights, a coordinate a row.
        along: 1 point-to-point, 0 point-to-line.
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
        lx, ly = pivot_y - ys[i], xs[i] - pivot_x  # d moved / d theta, turning about the weighted centre
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
    normal, step = np.empty((3, 3)), np.empty(3)
    normal[0, 0], normal[0, 1], normal[0, 2] = n00 + TURN_DAMPING * scale + LEAST_DAMPING * total, n01, n02
    normal[1, 1], normal[1, 2], normal[2, 2] = n11 + SHIFT_DAMPING * total, n12, n22 + SHIFT_DAMPING * total
    step[0], step[1], step[2] = r0, r1, r2
    _solve(normal, step)
    step[0] = min(max(step[0], -LARGEST_TURN), LARGEST_TURN)
    cos, sin = math.cos(step[0]), math.sin(step[0])
    step[1] += pivot_x - (cos * pivot_x - sin * pivot_y)
    step[2] += pivot_y - (sin * pivot_x + cos * pivot_y)
    return step


@kernel
def compose_into(motion: Array, step: Array) -> None:
    """Lets a motion (3,) be followed by a step (3,), in place."""
    cos, sin = math.cos(step[0]), math.sin(step[0])
    x, y = motion[1], motion[2]
    motion[0] = wrap(step[0] + motion[0])
    motion[1] = cos * x - sin * y + step[1]
    motion[2] = sin * x + cos * y + step[2]


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
        source: (P, 2), weights: (P,) points and how much they count.
        motions: (H, 3) starts.
        gates: (I,) residual, in metres, at which a point's weight has fallen to a quarter, of every iteration.
        along: (I,) how much of the residual along the surface counts (1 = point to point).
    """
    refined = motions.copy()
    pairs, squared, index = np.empty((PAIR_ROWS, len(source))), np.empty(len(source)), np.empty(len(source), np.int64)
    for h in range(len(motions)):
        motion = refined[h]
        for i in range(len(gates)):
            carry(motion, source, pairs)
            locate(pairs, target, squared, index)
            _pair(target, squared, index, weights, gates[i], pairs)
            compose_into(motion, gauss_newton_step(pairs, along[i]))
    return refined


@kernel
def _pair_both(
    source: ScanGrid, target: ScanGrid, turn: float, squared: Array, onto: Integers, back: Integers, gate: float, pairs: Array
) -> None:
    """Writes the rows of `pairs` from all source points, moved already, to the target, and from all target points back."""
    N = len(onto)
    cos, sin = math.cos(turn), math.sin(turn)
    for i in range(N):
        at = target.features[onto[i]]
        pairs[2, i], pairs[3, i], pairs[4, i], pairs[5, i] = at[X], at[Y], at[TANGENT_X], at[TANGENT_Y]
    for k in range(len(back)):
        i, at = N + k, source.features[back[k]]
        pairs[0, i], pairs[1, i] = pairs[0, back[k]], pairs[1, back[k]]
        pairs[2, i], pairs[3, i] = target.features[k, X], target.features[k, Y]
        pairs[4, i] = cos * at[TANGENT_X] - sin * at[TANGENT_Y]
        pairs[5, i] = sin * at[TANGENT_X] + cos * at[TANGENT_Y]
    for i in range(len(squared)):
        kept = gate * gate / (gate * gate + squared[i])
        pairs[6, i] = kept * kept


@kernel
def register_both(source: ScanGrid, target: ScanGrid, motions: Array, gates: Array, along: Array) -> Array:
    """(H, 3) like `register`, with all points of both scans in one step: source on target and target on source.

    Args:
        motions: (H, 3) starts.
        gates: (I,) `surface_residual` at which a point's weight has fallen to a quarter, of every iteration.
        along: (I,) how much of the residual along the surface counts (1 = point to point).
    """
    N, M = len(source.features), len(target.features)
    refined = motions.copy()
    pairs, returned, squared = np.empty((PAIR_ROWS, N + M)), np.empty((2, M)), np.empty(N + M)
    onto, back = np.empty(N, np.int64), np.empty(M, np.int64)
    for h in range(len(motions)):
        motion = refined[h]
        for i in range(len(gates)):
            carry(motion, source.scan.points, pairs)
            surface_residual(pairs, target, squared[:N], onto)
            carry(inverse(motion), target.scan.points, returned)
            surface_residual(returned, source, squared[N:], back)
            _pair_both(source, target, motion[0], squared, onto, back, gates[i], pairs)
            compose_into(motion, gauss_newton_step(pairs, along[i]))
    return refined
