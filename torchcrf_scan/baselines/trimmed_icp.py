"""Trimmed iterated closest points for one rigid motion, from a grid of starts: a strong classical registration.

All gates are multiples of the scans' resolution, so one setting serves a street and a table top.
"""

from __future__ import annotations

import math

import numpy as np

from torchcrf_scan.baselines.cloud import Cloud, fit_motion
from torchcrf_scan.baselines.labels import as_background
from torchcrf_scan.geometry import se2
from torchcrf_scan.scan import OUTLIER, Floats, PairPrediction, ScanPair

KEPT_SHARE = 0.8
COARSE_POINTS = 80
COARSE_GATES = (16.0, 16.0, 12.0, 12.0, 8.0, 8.0, 6.0, 4.0)  # units of resolution, one per iteration
FINE_GATES = (4.0, 4.0, 3.0, 3.0, 2.0, 2.0, 2.0, 2.0)
LINE_GATES = (3.0, 3.0, 2.0, 2.0, 2.0, 1.5, 1.5, 1.5)
REFINED = 4  # number of starts to refine
TRUNCATION = 3.0  # units; larger residuals are clipped
REACH = 0.12  # of the median range: unit of the grid's shifts
TURNS = (0.0, 0.12, -0.12, 0.3, -0.3)  # radians
SHIFTS = ((0.0, 0.0), (1.0, 0.0), (-1.0, 0.0), (0.0, 1.0), (0.0, -1.0), (2.5, 0.0), (-2.5, 0.0))  # multiples of the reach


def match_under(pair: ScanPair, motion: Floats) -> PairPrediction:
    """Labels a pair of scans, at least one point each, under one given motion (3,): background inside the gate."""
    target = Cloud.of(pair.target)
    distance, nearest = target.nearest(se2.apply(motion, pair.source.points))
    is_near = distance <= association_gate(distance, target)[nearest]
    return as_background(pair, np.where(is_near, nearest, OUTLIER), motion)


def association_gate(distance: Floats, target: Cloud) -> Floats:
    """(M,) maximum distance to a counterpart, metres: half the distance to the next return, usual spacing and usual residual.

    distance: (N,) of the source's points to their nearest returns, under the motion of most of them.
    """
    return target.spacing / 2 + np.median(target.spacing) + np.median(distance)


def register_trimmed(source: Cloud, target: Cloud) -> Floats:
    """(3,) `T_target_source`: coarse ICP from every start, fine ICP and point-to-line steps from the best ones; the best result."""
    unit = resolution(source, target)
    stride = max(1, math.ceil(len(source) / COARSE_POINTS))
    motions = start_grid(source, target)
    for gate in COARSE_GATES:
        motions = trimmed_step(motions, source.points[::stride], target, gate * unit)
    motions = motions[np.argsort(misfit(motions, source, target, unit, stride), kind="stable")[:REFINED]]
    for gate in FINE_GATES:
        motions = trimmed_step(motions, source.points, target, gate * unit)
    for gate in LINE_GATES:
        motions = line_step(motions, source.points, target, gate * unit)
    return motions[np.argmin(misfit(motions, source, target, unit))]


def resolution(source: Cloud, target: Cloud) -> float:
    """Median spacing of both scans, metres: the unit of all gates."""
    return float(np.median(np.concatenate([source.spacing, target.spacing])))


def start_grid(source: Cloud, target: Cloud) -> Floats:
    """(H, 3) the identity, and rotations and shifts scaled by the scene's size."""
    reach = REACH * np.median(np.concatenate([source.ranges, target.ranges]))
    return np.array([[turn, x * reach, y * reach] for turn in TURNS for x, y in SHIFTS])


def trimmed_step(motions: Floats, points: Floats, target: Cloud, gate: float) -> Floats:
    """One ICP iteration of H motions (H, 3): Kabsch on the nearest pairs inside the gate, without the worst of all pairs."""
    distance, index = target.nearest(se2.apply(motions, points))  # (H, P)
    weights = _kept(distance, gate)
    found = fit_motion(np.broadcast_to(points, (*distance.shape, 2)), target.points[index], weights)
    return np.where(weights.sum(-1, keepdims=True) >= 2, found, motions)


def line_step(motions: Floats, points: Floats, target: Cloud, gate: float) -> Floats:
    """The same with distances across the surface only (point to line), by one damped Gauss-Newton step."""
    moved = se2.apply(motions, points)  # (H, P, 2)
    distance, index = target.nearest(moved)
    return slide(motions, moved, target.points[index], target.tangent[index], _kept(distance, gate))


def slide(motions: Floats, moved: Floats, target: Floats, tangent: Floats, weights: Floats) -> Floats:
    """One damped Gauss-Newton step of point-to-line distances.

    Args:
        motions: (H, 3). moved: (H, P, 2) the points under them.
        target, tangent: (H, P, 2) their counterparts and the surface's directions there. weights: (H, P).
    """
    normal = np.stack([-tangent[..., 1], tangent[..., 0]], axis=-1)
    total = np.maximum(weights.sum(-1), 1.0)[:, None]
    centre = (weights[..., None] * moved).sum(1) / total  # (H, 2)
    arm = moved - centre[:, None]
    turning = arm[..., 0] * normal[..., 1] - arm[..., 1] * normal[..., 0]
    jacobian = np.concatenate([turning[..., None], normal], axis=-1)  # (H, P, 3)
    residual = ((moved - target) * normal).sum(-1)
    weighted = weights[..., None] * jacobian
    spread = (weights * (arm**2).sum(-1)).sum(-1)[:, None]
    damping = 1e-3 * np.concatenate([spread, total, total], axis=-1) + 1e-12
    system = weighted.swapaxes(1, 2) @ jacobian + damping[..., None] * np.eye(3)
    step = -np.linalg.solve(system, (weighted * residual[..., None]).sum(1)[..., None])[..., 0]  # (H, 3)
    shift = centre - se2.rotate(step[:, 0], centre) + step[:, 1:]
    return se2.compose(np.concatenate([step[:, :1], shift], axis=-1), motions)


def misfit(motions: Floats, source: Cloud, target: Cloud, unit: float, stride: int = 1) -> Floats:
    """(H,) mean truncated distance of every `stride`-th point to the nearest, in both directions. motions: (H, 3)."""
    forward = target.nearest(se2.apply(motions, source.points[::stride]))[0]
    back = source.nearest(se2.apply(se2.inverse(motions), target.points[::stride]))[0]
    return np.minimum(forward, TRUNCATION * unit).mean(-1) + np.minimum(back, TRUNCATION * unit).mean(-1)


def _kept(distance: Floats, gate: float) -> Floats:
    """(H, P) 1 for pairs inside the gate and among the nearest 80 % of their row."""
    last = math.ceil(KEPT_SHARE * distance.shape[-1]) - 1
    limit = np.partition(distance, last, axis=-1)[..., last : last + 1]
    return (distance <= np.minimum(limit, gate)).astype(np.float64)
