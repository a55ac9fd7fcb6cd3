"""What the neighbourhood of every point of one scan looks like (spec 1.1): computed once a scan, in O(N)."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from torchcrf_scan.geometry.kabsch import safe_atan2

ORDERS = (1, 3, 5)  # "first, third or fifth neighbour"
MIN_ARM = 1e-6  # metres; the angle between shorter arms is undefined and called straight


@dataclass(frozen=True, slots=True)
class ShapeDescriptors:
    """Rigid-motion invariant descriptors of B scans, and the radius.

    Attributes:
        distance: (B, N, 3, 2) metres to the neighbours of order 1, 3, 5 after and before the point.
        geodesic: (B, N, 3, 2) metres along the scan to the same neighbours.
        angle: (B, N, 3) signed angle between them, [0, 2 pi) (A-04).
        radius: (B, N) distance from the sensor.
    """

    distance: Tensor
    geodesic: Tensor
    angle: Tensor
    radius: Tensor


def neighbour_index(mask: Tensor, closed: Tensor, offset: int) -> Tensor:
    """(B, N) index of the neighbour `offset` points on; clamped to the scan's ends, or wrapped round a closed scan (A-05, A-06)."""
    count = mask.sum(-1, keepdim=True).clamp(min=1)
    index = torch.arange(mask.shape[-1], device=mask.device) + offset
    clamped = index.clamp(min=0).minimum(count - 1)
    return torch.where(closed[:, None], index % count, clamped)


def gather_points(points: Tensor, index: Tensor) -> Tensor:
    """points: (B, M, 2); index: (B, ...). Returns (B, ..., 2)."""
    flat = index.flatten(1)
    return points.gather(1, flat[..., None].expand(-1, -1, points.shape[-1])).unflatten(1, index.shape[1:])


def describe(points: Tensor, mask: Tensor, closed: Tensor) -> ShapeDescriptors:
    """points: (B, N, 2); mask: (B, N); closed: (B,). The descriptors of padding are finite and mean nothing."""
    arms = {k: gather_points(points, neighbour_index(mask, closed, k)) - points for k in range(-max(ORDERS), max(ORDERS) + 1)}

    def length(vector: Tensor) -> Tensor:
        return torch.linalg.vector_norm(vector, dim=-1)

    def along(k: int, sign: int) -> Tensor:
        return torch.stack([length(arms[sign * (step + 1)] - arms[sign * step]) for step in range(k)]).sum(0)

    return ShapeDescriptors(
        distance=torch.stack([torch.stack([length(arms[k]), length(arms[-k])], -1) for k in ORDERS], -2),
        geodesic=torch.stack([torch.stack([along(k, 1), along(k, -1)], -1) for k in ORDERS], -2),
        angle=torch.stack([_angle(arms[-k], arms[k]) for k in ORDERS], -1),
        radius=length(points),
    )


def _angle(u: Tensor, v: Tensor) -> Tensor:
    """Angle from u to v in [0, 2 pi); pi where an arm is shorter than MIN_ARM."""
    cross = u[..., 0] * v[..., 1] - u[..., 1] * v[..., 0]
    angle = safe_atan2(cross, (u * v).sum(-1)) % (2 * torch.pi)
    short = torch.minimum((u**2).sum(-1), (v**2).sum(-1)) < MIN_ARM**2
    return torch.where(short, torch.full_like(angle, torch.pi), angle)


def local_spacing(shape: ShapeDescriptors) -> Tensor:
    """(B, N) metres between a point and the next on its own surface: the nearer of the two neighbours, across no depth jump."""
    nearest = shape.distance[:, :, 0]  # (B, N, 2)
    return torch.where(nearest.amin(-1) > 0, nearest.amin(-1), nearest.amax(-1))
