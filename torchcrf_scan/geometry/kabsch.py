"""Weighted least-squares rigid motion in closed form (the paper's Eq. 6), and its naive SVD twin."""

from __future__ import annotations

import torch
from torch import Tensor

from torchcrf_scan.geometry.se2 import rotate


def safe_atan2(y: Tensor, x: Tensor) -> Tensor:
    """atan2 whose value and gradient are 0 where both arguments are 0."""
    at_origin = (y == 0) & (x == 0)
    return torch.atan2(y.masked_fill(at_origin, 0.0), x.masked_fill(at_origin, 1.0))


def kabsch(source: Tensor, target: Tensor, weights: Tensor) -> Tensor:
    """The motion that minimises sum_i w_i |R p_i + t - q_i|^2 (the paper's Eq. 6; spec 7.4).

    Args:
        source, target: (..., P, 2) paired points.
        weights: (..., P), non-negative.

    Returns:
        (..., 3) motions; the identity where all weights are 0, or so small that their products underflow. Gradients are
        finite everywhere; where the rotation is undetermined (one point, identical points) its gradient is 0.
    """
    total = weights.sum(-1, keepdim=True)  # (..., 1)
    some = total > torch.finfo(total.dtype).tiny ** 0.5  # smaller weights count as 0: the gradients of their shares would overflow
    share = weights * some / torch.where(some, total, torch.ones_like(total))
    source_mean = (share[..., None] * source).sum(-2)  # (..., 2)
    target_mean = (share[..., None] * target).sum(-2)
    p, q = source - source_mean[..., None, :], target - target_mean[..., None, :]
    sine = (share * (p[..., 0] * q[..., 1] - p[..., 1] * q[..., 0])).sum(-1)
    cosine = (share * (p * q).sum(-1)).sum(-1)
    rounding = 8 * torch.finfo(p.dtype).eps * (share * _product_of_lengths(source, target)).sum(-1)
    undetermined = torch.maximum(sine.abs(), cosine.abs()) <= rounding  # the remaining spread is rounding noise
    theta = safe_atan2(sine.masked_fill(undetermined, 0.0), cosine.masked_fill(undetermined, 0.0))
    return torch.cat([theta[..., None], target_mean - rotate(theta, source_mean)], dim=-1)


def _product_of_lengths(p: Tensor, q: Tensor) -> Tensor:
    with torch.no_grad():
        return torch.linalg.vector_norm(p, dim=-1) * torch.linalg.vector_norm(q, dim=-1)


def kabsch_naive(source: Tensor, target: Tensor, weights: Tensor) -> Tensor:
    """`kabsch` by the singular value decomposition of the cross-covariance: slower, for tests."""
    total = weights.sum(-1, keepdim=True)
    share = (weights / torch.where(total > 0, total, torch.ones_like(total)))[..., None]
    source_mean, target_mean = (share * source).sum(-2), (share * target).sum(-2)
    p, q = source - source_mean[..., None, :], target - target_mean[..., None, :]
    u, _, vh = torch.linalg.svd((share * p).mT @ q)
    sign = torch.det(u @ vh).sign()
    flip = torch.stack([torch.ones_like(sign), sign], dim=-1)  # excludes reflections
    rotation = vh.mT @ (flip[..., None] * u.mT)
    theta = torch.atan2(rotation[..., 1, 0], rotation[..., 0, 0])
    return torch.cat([theta[..., None], target_mean - rotate(theta, source_mean)], dim=-1)
