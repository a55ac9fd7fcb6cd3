"""Robust rigid registration of many hypotheses at once: one scan against another from H starts."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from torchcrf_scan.geometry import se2
from torchcrf_scan.inference.surface import Surface

ROUGHNESS = 0.1  # of the spacing: how far an ordinary surface leaves the straight line between two returns,
LONELY = 0.5  # and a return that has no neighbours
TURN_DAMPING, SHIFT_DAMPING = 1e-4, 1e-3  # of a step, in shares of the lever's weight and of the weight
LEAST_DAMPING = 1e-6  # of a turn about one spot, which has no lever
LARGEST_TURN = 0.5  # radians in one step


def nearest_points(moved: Tensor, target: Surface) -> tuple[Tensor, Tensor]:
    """Distance to and index of the nearest target point. moved: (..., P, 2). Returns (..., P) each, without gradient."""
    distance, index = target.tree.query(moved.detach().reshape(-1, 2).cpu().numpy())
    shape = moved.shape[:-1]
    return torch.from_numpy(distance).to(moved).view(shape), torch.from_numpy(index).to(moved.device).view(shape)


def surface_residual(moved: Tensor, other: Surface) -> tuple[Tensor, Tensor]:
    """Distance to the other scan's surface in units of its noise and roughness, and the nearest point's index.

    The surface goes on along its tangent for half a spacing on either side of every return: sliding along a wall costs nothing
    between its returns, and leaving it costs at once, however far the returns are apart.

    Args:
        moved: (..., 2) points in the frame of `other`.

    Returns:
        (...,) each.
    """
    distance, index = nearest_points(moved, other)
    along = ((moved - other.points[index]) * other.tangent[index]).sum(-1).abs()
    spacing = other.spacing[index]
    saved = along**2 - (along - spacing / 2).clamp(min=0) ** 2
    is_lonely = (other.tangent[index] == 0).all(-1)
    unit = torch.where(is_lonely, LONELY, ROUGHNESS) * spacing + 2 * other.noise
    return (distance**2 - saved).clamp(min=0).sqrt() / unit, index


def gauss_newton_step(moved: Tensor, partner: Tensor, tangent: Tensor, weights: Tensor, along: float) -> Tensor:
    """One least-squares step of a rigid motion, applied after the present one.

    Minimises sum_i w_i (r^T (I - (1 - along) t t^T) r): point-to-point at along = 1, point-to-line at 0.

    Args:
        moved, partner, tangent: (..., P, 2); weights: (..., P).

    Returns:
        (..., 3); the identity where all weights are 0. Damped, so finite for any number of points.
    """
    residual = moved - partner
    centre = (weights[..., None] * moved).sum(-2, keepdim=True) / weights.sum(-1)[..., None, None].clamp(min=1e-9)
    arm = moved - centre
    lever = torch.stack([-arm[..., 1], arm[..., 0]], dim=-1)  # d moved / d theta, turning about the weighted centre
    slack = 1 - along

    def dot_metric(a: Tensor, b: Tensor) -> Tensor:
        return (a * b).sum(-1) - slack * (a * tangent).sum(-1) * (b * tangent).sum(-1)

    axes = torch.eye(2, dtype=moved.dtype, device=moved.device)
    basis = (lever, axes[0].expand_as(lever), axes[1].expand_as(lever))
    total = weights.sum(-1).clamp(min=1e-9)
    normal = torch.stack([torch.stack([(weights * dot_metric(a, b)).sum(-1) for b in basis], -1) for a in basis], -2)
    right = torch.stack([-(weights * dot_metric(a, residual)).sum(-1) for a in basis], -1)
    scale = (weights * (lever**2).sum(-1)).sum(-1)
    damping = torch.stack([TURN_DAMPING * scale + LEAST_DAMPING * total, SHIFT_DAMPING * total, SHIFT_DAMPING * total], dim=-1)
    step, _ = torch.linalg.solve_ex(normal + torch.diag_embed(damping), right)  # damped, so there is no failure to look for
    theta, shift = step[..., 0].clamp(-LARGEST_TURN, LARGEST_TURN), step[..., 1:]
    pivot = centre[..., 0, :]
    return torch.cat([theta[..., None], pivot - se2.rotate(theta, pivot) + shift], dim=-1)


def register(
    source: Tensor,
    weights: Tensor,
    target: Surface,
    motions: Tensor,
    gates: Sequence[float],
    along: Sequence[float],
) -> Tensor:
    """Iterated closest points with robust (Geman-McClure) weights and a shrinking gate.

    Args:
        source: (P, 2) points, or (H, P, 2) of every hypothesis its own. weights: (P,) or (H, P).
        target: the other scan.
        motions: (H, 3) starts.
        gates: residual, in metres, at which a point's weight has fallen to a quarter; one per iteration.
        along: how much of the residual along the surface counts, one per iteration (1 = point to point).

    Returns:
        (H, 3) refined motions.
    """
    for gate, slack in zip(gates, along, strict=True):
        moved = se2.apply(motions, source)  # (H, P, 2)
        distance, index = nearest_points(moved, target)
        unit = gate + target.spacing[index] / 2
        robust = weights / (1 + (distance / unit) ** 2) ** 2
        step = gauss_newton_step(moved, target.points[index], target.tangent[index], robust, slack)
        motions = se2.compose(step, motions)
    return motions


def register_both(source: Surface, target: Surface, motions: Tensor, gates: Sequence[float], along: Sequence[float]) -> Tensor:
    """Like `register`, with all points of both scans in one step: source on target and target on source.

    Args:
        motions: (H, 3) starts.
        gates: `surface_residual` at which a point's weight has fallen to a quarter, one per iteration.
        along: how much of the residual along the surface counts, one per iteration (1 = point to point).

    Returns:
        (H, 3) refined motions.
    """
    for gate, slack in zip(gates, along, strict=True):
        moved, back = se2.apply(motions, source.points), se2.apply(se2.inverse(motions), target.points)
        (ahead, i), (behind, j) = surface_residual(moved, target), surface_residual(back, source)  # (H, P), (H, M)
        step = gauss_newton_step(
            torch.cat([moved, moved.gather(1, j[..., None].expand(-1, -1, 2))], dim=1),  # (H, P + M, 2)
            torch.cat([target.points[i], target.points.expand_as(back)], dim=1),
            torch.cat([target.tangent[i], se2.rotate(motions[:, :1], source.tangent[j])], dim=1),
            1 / (1 + (torch.cat([ahead, behind], dim=1) / gate) ** 2) ** 2,
            slack,
        )
        motions = se2.compose(step, motions)
    return motions
