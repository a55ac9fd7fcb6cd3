"""Features of the association chain: which point of the second scan corresponds to a source point (spec 1.2 and 3).

A state is a candidate (a target point) or, last, the outlier. Errors are stored as minus a robust square, so that a sensible
weight is positive. In the dense model every target point is a candidate.
"""

from __future__ import annotations

import torch
from torch import Tensor

from torchcrf_scan.features.scales import KAPPA, Scales, robust_square
from torchcrf_scan.features.shape import ShapeDescriptors, gather_points
from torchcrf_scan.geometry import se2
from torchcrf_scan.names import ANGLES, DISTANCES, GEODESICS, LOCAL_CHANNELS, SHAPE_CHANNELS, STATIC_CHANNELS

ANOTHER_PLACE = 3  # target points away


def _of_candidates(values: Tensor, candidates: Tensor) -> Tensor:
    """values: (B, M, ...) of target points; candidates: (B, N, K). Returns (B, N, K, ...)."""
    flat = candidates.flatten(1)  # (B, NK)
    index = flat.view(*flat.shape, *[1] * (values.dim() - 2)).expand(-1, -1, *values.shape[2:])
    return values.gather(1, index).unflatten(1, candidates.shape[1:])


def shape_features(source: ShapeDescriptors, target: ShapeDescriptors, candidates: Tensor, scales: Scales) -> Tensor:
    """L1..L9: similarity of the neighbourhoods of source point and candidate; invariant to motions of either scan.

    Args:
        source, target: descriptors of N and M points.
        candidates: (B, N, K) target points.

    Returns:
        (B, N, K, 9), order of `LOCAL_CHANNELS`. The sides after and before the point weigh one half each (A-02).
    """

    def lengths(of_source: Tensor, of_target: Tensor, scale: Tensor) -> Tensor:
        error = of_source[:, :, None] - _of_candidates(of_target, candidates)  # (B, N, K, 3, 2)
        return robust_square(error, scale[:, None]).mean(-1)

    angle = se2.wrap(source.angle[:, :, None] - _of_candidates(target.angle, candidates))
    distance, turn, geodesic = scales.local[:SHAPE_CHANNELS].split([len(DISTANCES), len(ANGLES), len(GEODESICS)])
    return torch.cat(
        [
            lengths(source.distance, target.distance, distance),
            robust_square(angle, turn),
            lengths(source.geodesic, target.geodesic, geodesic),
        ],
        dim=-1,
    )


def position_features(
    source_points: Tensor, target_points: Tensor, candidates: Tensor, initial_motion: Tensor, scales: Scales
) -> Tensor:
    """L10 radius and L11 translation (under the initial motion: the identity, or odometry). Returns (B, N, K, 2)."""
    q = gather_points(target_points, candidates)  # (B, N, K, 2)
    radius = torch.linalg.vector_norm(source_points, dim=-1)[:, :, None] - torch.linalg.vector_norm(q, dim=-1)
    moved = se2.apply(initial_motion, source_points)
    translation = torch.linalg.vector_norm(moved[:, :, None] - q, dim=-1)
    errors = {"radius": radius, "translation": translation}
    return torch.stack([robust_square(errors[name], scales.local[LOCAL_CHANNELS.index(name)]) for name in errors], dim=-1)


def registered_distance(moved: Tensor, target_points: Tensor, candidates: Tensor) -> Tensor:
    """(B, N, K) metres to the candidates after the point's own motion. moved: (B, N, 2) source points under it."""
    return torch.linalg.vector_norm(moved[:, :, None] - gather_points(target_points, candidates), dim=-1)


def registered_feature(moved: Tensor, target_points: Tensor, candidates: Tensor, scales: Scales) -> Tensor:
    """L12: distance after the point's own motion. moved: (B, N, 2) source points under it. Returns (B, N, K)."""
    return robust_square(registered_distance(moved, target_points, candidates), scales.local[STATIC_CHANNELS])


def outlier_inputs(local: Tensor, data_margin: Tensor, candidates: Tensor, candidate_mask: Tensor) -> Tensor:
    """The outlier booster's 14 inputs (A-10): the best of every channel, the best margin, and its lead over other places.

    Args:
        local: (B, N, K, 12) channels of the candidates.
        data_margin: (B, N, K) data booster.
        candidates, candidate_mask: (B, N, K); another place is `ANOTHER_PLACE` or more points away.

    Returns:
        (B, N, 14); without a candidate every channel is -kappa (the largest error) and the margin 0.
    """
    some = candidate_mask.any(-1)  # (B, N)
    best_local = local.masked_fill(~candidate_mask[..., None], -torch.inf).amax(-2)
    best_local = torch.where(some[..., None], best_local, torch.full_like(best_local, -KAPPA))
    masked = data_margin.masked_fill(~candidate_mask, -torch.inf)
    best, place = masked.max(-1)
    other = (candidates - candidates.gather(-1, place[..., None])).abs() >= ANOTHER_PLACE
    second = masked.masked_fill(~other, -torch.inf).amax(-1)
    gap = torch.where(second > -torch.inf, best - second, torch.zeros_like(best))
    gap = torch.where(some, gap, torch.zeros_like(gap))
    best = torch.where(some, best, torch.zeros_like(best))
    return torch.cat([best_local, best[..., None], gap[..., None]], dim=-1)


def pairwise_features(
    source_points: Tensor, target_points: Tensor, candidates: Tensor, scales: Scales, *, has_lengths: bool = True
) -> Tensor:
    """P1..P4 on every edge (i, i+1): sequence, pairwise outlier, pairwise distance, pairwise translation (spec 3).

    Args:
        source_points: (B, N, 2); target_points: (B, M, 2); candidates: (B, N, K).
        has_lengths: False: P3 and P4 of two inliers, of which the model has no weight, are 0.

    Returns:
        (B, N-1, K+1, K+1, 4); the last state is the outlier. Costs N K^2.
    """
    before, after = candidates[:, :-1], candidates[:, 1:]
    return edge_features(source_points, target_points, before, after, scales, has_lengths=has_lengths)


def edge_features(
    source_points: Tensor, target_points: Tensor, before: Tensor, after: Tensor, scales: Scales, *, has_lengths: bool = True
) -> Tensor:
    """P1..P4 of every edge (i, i+1) for some states of its two points; otherwise as `pairwise_features`.

    Args:
        before, after: (B, N-1, K) and (B, N-1, L) target points of the edge's first and second point.

    Returns:
        (B, N-1, K+1, L+1, 4); the last states are the outlier.
    """
    index_step = after[:, :, None, :] - before[:, :, :, None]  # (B, N-1, K, L)
    in_sequence = (index_step == 1).to(source_points.dtype)
    inliers = torch.stack([in_sequence, *[torch.zeros_like(in_sequence)] * 3], dim=-1)
    if has_lengths:
        partners = gather_points(target_points, before), gather_points(target_points, after)
        lengths = length_features(source_points, *partners, scales)
        inliers = torch.cat([inliers[..., :2], lengths], dim=-1)
    switch = torch.cat([scales.pairwise_outlier.new_tensor([0.0, 1.0]), scales.pairwise_outlier])
    stay = torch.cat([scales.pairwise_outlier.new_zeros(2), scales.pairwise_outlier])
    B, E, K, L = inliers.shape[:4]
    rows = torch.cat([inliers, switch.expand(B, E, K, 1, 4)], dim=3)
    last = torch.cat([switch.expand(B, E, 1, L, 4), stay.expand(B, E, 1, 1, 4)], dim=3)
    return torch.cat([rows, last], dim=2)


def length_features(source_points: Tensor, before: Tensor, after: Tensor, scales: Scales) -> Tensor:
    """(B, N-1, K, L, 2) P3 and P4 of two inliers. before, after: (B, N-1, K, 2), (B, N-1, L, 2) target points of an edge's ends."""
    v2 = after[:, :, None, :] - before[:, :, :, None]  # (B, N-1, K, L, 2)
    v1 = (source_points[:, 1:] - source_points[:, :-1])[:, :, None, None]  # (B, N-1, 1, 1, 2)
    d1, d2 = torch.linalg.vector_norm(v1, dim=-1), torch.linalg.vector_norm(v2, dim=-1)
    shift = torch.linalg.vector_norm(v1 - v2, dim=-1)
    return torch.stack([robust_square(d1 - d2, scales.pairwise[0]), robust_square(shift, scales.pairwise[1])], dim=-1)
