"""Features of the clustering chain: background, movers, outliers (spec 4).

The clusters' motions and the current associations are treated as observed (A-09); C = D-1 motions, the outlier is state D.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from torchcrf_scan.features.scales import Scales, robust_square
from torchcrf_scan.features.shape import gather_points
from torchcrf_scan.geometry import se2


@dataclass(frozen=True, slots=True)
class Correspondence:
    """Every source point under every motion, with its distance to the target.

    Attributes:
        moved: (B, N, C, 2) source points under every motion.
        residual: (B, N, C) distance to the associated target point, or to the nearest one for an outlier (A-15).
        partner: (B, N, 2) associated target point; undefined for an outlier.
        is_inlier: (B, N) whether the point has an association.
    """

    moved: Tensor
    residual: Tensor
    partner: Tensor
    is_inlier: Tensor


def correspond(
    source_points: Tensor, target_points: Tensor, motions: Tensor, nearest: Tensor, association: Tensor
) -> Correspondence:
    """Evaluates the motions on the current associations.

    Args:
        source_points: (B, N, 2); target_points: (B, M, 2); motions: (B, C, 3).
        nearest: (B, N, C) nearest target point of every source point under every motion.
        association: (B, N) target point, -1 outlier.
    """
    moved = se2.apply(motions, source_points[:, None]).transpose(1, 2)  # (B, N, C, 2)
    is_inlier = association >= 0
    partner = gather_points(target_points, association.clamp(min=0))  # (B, N, 2)
    met = torch.where(is_inlier[..., None, None], partner[:, :, None], gather_points(target_points, nearest))
    return Correspondence(moved, torch.linalg.vector_norm(moved - met, dim=-1), partner, is_inlier)


def nearest_distance(at: Correspondence, target_points: Tensor, nearest: Tensor) -> Tensor:
    """(B, N, C) distance to the nearest target point under every motion. target_points: (B, M, 2); nearest: (B, N, C)."""
    return torch.linalg.vector_norm(at.moved - gather_points(target_points, nearest), dim=-1)


def local_features(at: Correspondence, active: Tensor, scales: Scales) -> Tensor:
    """C1..C4: cluster distance, outlier, cluster inlier (inlier part, outlier part).

    active: (B, C) clusters that exist. Returns (B, N, D, 4), the outlier last; an inactive cluster's column is not masked here.
    """
    zero = torch.zeros_like(at.residual)  # (B, N, C)
    unexplained = at.residual.masked_fill(~active[:, None], torch.inf).amin(-1) > scales.outlier_threshold  # (B, N)
    inlier = at.is_inlier[..., None].to(zero.dtype).expand_as(zero)
    clusters = torch.stack([robust_square(at.residual, scales.cluster_distance), zero, inlier, zero], dim=-1)
    none = zero[..., 0]
    outlier = torch.stack([none, unexplained.to(none.dtype), none, (~at.is_inlier).to(none.dtype)], dim=-1)
    return torch.cat([clusters, outlier[:, :, None]], dim=2)


def elasticity(stretch: Tensor, scales: Scales) -> tuple[Tensor, Tensor]:
    """Stiffness (a kernel) and minus the robust square of an edge's elongation (A-16)."""
    return torch.exp(-((stretch / scales.neighbour_distance) ** 2)), robust_square(stretch, scales.neighbour_distance)


def pairwise_features(source_points: Tensor, at: Correspondence, scales: Scales) -> Tensor:
    """Q1..Q8 on every edge (i, i+1); stiffness and elongation need both ends associated (spec 4.2). Returns (B, N-1, D, D, 8)."""
    C = at.moved.shape[2]
    d1 = torch.linalg.vector_norm(source_points[:, 1:] - source_points[:, :-1], dim=-1)  # (B, E)
    d2 = torch.linalg.vector_norm(at.partner[:, 1:] - at.partner[:, :-1], dim=-1)
    both = (at.is_inlier[:, 1:] & at.is_inlier[:, :-1]).to(d1.dtype)
    across = torch.linalg.vector_norm(at.moved[:, 1:, None, :] - at.moved[:, :-1, :, None], dim=-1)  # (B, E, C, C)

    near = torch.exp(-((d1 / scales.neighbour_weight) ** 2))
    stiff, elongation = elasticity(d2 - d1, scales)
    elongation = elongation * both
    parting = robust_square(across - d1[..., None, None], scales.neighbour_distance)

    same = torch.eye(C, dtype=d1.dtype, device=d1.device)  # (C, C)
    different = 1 - same

    def on_edges(value: Tensor, pattern: Tensor) -> Tensor:
        return value[..., None, None] * pattern  # (B, E, C, C)

    inliers = torch.stack(
        [
            same.expand_as(across),
            on_edges(near, same),
            on_edges(1 - near, different),
            on_edges(stiff * both, same),
            on_edges((1 - stiff) * both, different),
            on_edges(elongation, same),
            parting * different,
            torch.zeros_like(across),
        ],
        dim=-1,
    )  # (B, E, C, C, 8)
    switch = inliers.new_tensor([0.0] * 7 + [1.0])
    stay = inliers.new_tensor([1.0] + [0.0] * 7)
    B, E = d1.shape
    rows = torch.cat([inliers, switch.expand(B, E, C, 1, 8)], dim=3)
    last = torch.cat([switch.expand(B, E, 1, C, 8), stay.expand(B, E, 1, 1, 8)], dim=3)
    return torch.cat([rows, last], dim=2)
