"""Shape descriptors of the neighbourhood of every point (spec 1.1): computed once per scan, in O(N)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from torchcrf_scan.geometry.kabsch import safe_atan2
from torchcrf_scan.loops.shape import MIN_ARM, ORDERS


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


def neighbour_index(mask: Tensor, closed: Tensor, offsets: Sequence[int]) -> Tensor:
    """(B, K, N) index of the neighbour at every offset; clamped to the scan's ends, or wrapped round a closed scan (A-05, A-06).

    mask: (B, N); closed: (B,); offsets: K.
    """
    count = mask.sum(-1)[:, None, None].clamp(min=1)
    index = torch.arange(mask.shape[-1], device=mask.device) + torch.tensor(offsets, device=mask.device)[:, None]  # (K, N)
    clamped = index.clamp(min=0).minimum(count - 1)
    return torch.where(closed[:, None, None], index % count, clamped)


def gather_points(points: Tensor, index: Tensor) -> Tensor:
    """points: (B, M, 2); index: (B, ...). Returns (B, ..., 2)."""
    flat = index.flatten(1)
    return points.gather(1, flat[..., None].expand(-1, -1, points.shape[-1])).unflatten(1, index.shape[1:])


def describe(points: Tensor, mask: Tensor, closed: Tensor) -> ShapeDescriptors:
    """Descriptors of points (B, N, 2); mask: (B, N); closed: (B,). Those of padding are finite and undefined."""
    most = max(ORDERS)
    arms = gather_points(points, neighbour_index(mask, closed, range(-most, most + 1))) - points[:, None]  # (B, 11, N, 2)
    lengths = torch.linalg.vector_norm(arms, dim=-1)
    gaps = torch.linalg.vector_norm(arms.diff(dim=1), dim=-1)  # (B, 10, N) from each of them to the next

    def along(k: int, sign: int) -> Tensor:
        return torch.stack([gaps[:, most + step if sign > 0 else most - 1 - step] for step in range(k)]).sum(0)

    after, before = (torch.stack([arms[:, most + sign * k] for k in ORDERS], -2) for sign in (1, -1))  # (B, N, 3, 2)
    return ShapeDescriptors(
        distance=torch.stack([torch.stack([lengths[:, most + k], lengths[:, most - k]], -1) for k in ORDERS], -2),
        geodesic=torch.stack([torch.stack([along(k, 1), along(k, -1)], -1) for k in ORDERS], -2),
        angle=_angle(before, after),
        radius=torch.linalg.vector_norm(points, dim=-1),
    )


def _angle(u: Tensor, v: Tensor) -> Tensor:
    """Angle from u to v in [0, 2 pi); pi where an arm is shorter than MIN_ARM."""
    cross = u[..., 0] * v[..., 1] - u[..., 1] * v[..., 0]
    angle = safe_atan2(cross, (u * v).sum(-1)) % (2 * torch.pi)
    short = torch.minimum((u**2).sum(-1), (v**2).sum(-1)) < MIN_ARM**2
    return torch.where(short, torch.full_like(angle, torch.pi), angle)


def local_spacing(shape: ShapeDescriptors, mask: Tensor) -> Tensor:
    """(B, N) metres between a point and the nearer of the next distinct ones on either side, so not across a depth jump.

    0 if all points coincide. shape: of scans regarded as open. mask: (B, N).
    """
    after, before = shape.distance[:, :, 0].masked_fill(~mask[..., None], 0.0).unbind(-1)  # (B, N)
    N = mask.shape[1]
    ahead = N - 1 - _last_before((after > 0).flip(-1)).flip(-1)
    behind = _last_before(before > 0)
    gaps = [
        torch.where(ahead < N, after.gather(-1, ahead.clamp(max=N - 1)), 0.0),
        torch.where(behind >= 0, before.gather(-1, behind.clamp(min=0)), 0.0),
    ]
    nearest = torch.stack(gaps, -1)
    return torch.where(nearest.amin(-1) > 0, nearest.amin(-1), nearest.amax(-1))


def _last_before(there: Tensor) -> Tensor:
    """(B, N) the last place up to every place where something is there (B, N); -1: none."""
    return torch.arange(there.shape[1], device=there.device).expand_as(there).masked_fill(~there, -1).cummax(-1).values
