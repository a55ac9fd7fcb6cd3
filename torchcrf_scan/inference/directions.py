"""Directions of the surfaces of scans, from stretches that are long compared with the noise."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from torchcrf_scan.geometry.kabsch import safe_atan2
from torchcrf_scan.loops.circle import LEAST_TURN

STRETCH, STEPS = 10.0, 2.0  # a surface's direction comes from the points within this many noises and steps to the next point
NEIGHBOURS = 32  # on either side, at most: on a near wall neighbours of a dense scan are much closer than the noise
MISSING = 4.5  # beams; neighbours farther apart are not on one surface: whatever is between them returned nothing
STRAIGHT = 3.0  # noises that the middle one of three neighbours may be off the line through the others


def turns_of(points: Tensor) -> tuple[Tensor, Tensor]:
    """(B, N-1) radians from a beam to the next, and whether both are real; padding lies at the sensor. points: (B, N, 2)."""
    here, there = points[:, :-1], points[:, 1:]
    cross = here[..., 0] * there[..., 1] - here[..., 1] * there[..., 0]
    real = (here != 0).any(-1) & (there != 0).any(-1)
    return torch.atan2(cross, (here * there).sum(-1)).abs(), real


def usual_turn(points: Tensor) -> Tensor:
    """(B, 1) radians between beams, the lower median; NaN for fewer than two. points: (B, N, 2) in beam order."""
    turn, real = turns_of(nn.functional.pad(points, (0, 0, 0, 2)))
    return turn.masked_fill(~real | (turn < LEAST_TURN), torch.nan).nanmedian(-1, keepdim=True).values


def surface_runs(points: Tensor, noise: Tensor) -> Tensor:
    """(B, N) ascending numbers of the runs of neighbouring beams of which few are missing; padding belongs to none.

    points: (B, N, 2) in beam order, as seen from the sensor. noise: (B,); neighbours a few noises apart are never cut.
    """
    turn, real = turns_of(points)
    gap = torch.linalg.vector_norm(points.diff(dim=1), dim=-1)
    is_apart = ~real | ((turn > MISSING * usual_turn(points)) & (gap > STRETCH * noise[:, None]))
    return nn.functional.pad(is_apart.long().cumsum(-1), (1, 0))


def spacing_of(points: Tensor) -> Tensor:
    """(B, N) distance from a point to the nearer of its neighbours; 0 without one. points: (B, N, 2) in beam order."""
    _, real = turns_of(points)
    gap = torch.linalg.vector_norm(points.diff(dim=1), dim=-1).masked_fill(~real, torch.inf)
    near = torch.minimum(*(nn.functional.pad(gap, side, value=torch.inf) for side in ((0, 1), (1, 0))))
    return near.masked_fill(near == torch.inf, 0.0)


def is_straight(points: Tensor, run: Tensor, noise: Tensor) -> Tensor:
    """(B, N) whether a point is in line with two neighbours of its run. points: (B, N, 2); run: (B, N); noise: (B,)."""
    first, middle, last = points[:, :-2], points[:, 1:-1], points[:, 2:]
    chord, arm = last - first, middle - first
    off = (chord[..., 0] * arm[..., 1] - chord[..., 1] * arm[..., 0]).abs()
    length = torch.linalg.vector_norm(chord, dim=-1)
    is_line = (off <= STRAIGHT * noise[:, None] * length) & (length > 0) & (run[:, :-2] == run[:, 2:])  # (B, N-2)
    if points.shape[1] < 3:
        return torch.zeros_like(points[..., 0], dtype=torch.bool)
    sides = [nn.functional.pad(is_line, (k, 2 - k)) for k in range(3)]
    return sides[0] | sides[1] | sides[2]


def surface_tangents(points: Tensor, mask: Tensor, noise: Tensor, run: Tensor | None = None) -> tuple[Tensor, Tensor]:
    """Direction of the surface at every point, from a stretch that is long compared with the noise.

    Args:
        points: (B, N, 2) in beam order. mask: (B, N) points to use. noise: (B,) metres.
        run: (B, N) of `surface_runs`, beyond which no surface extends; None: not known.

    Returns:
        (B, N, 2) unit vectors along the main axis of the neighbouring points, and (B, N) whether there is such an axis.
    """
    padded = nn.functional.pad(points, (0, 0, NEIGHBOURS, NEIGHBOURS)).unfold(1, 2 * NEIGHBOURS + 1, 1)  # (B, N, 2, W)
    real = nn.functional.pad(mask, (NEIGHBOURS, NEIGHBOURS)).unfold(1, 2 * NEIGHBOURS + 1, 1) & mask[..., None]
    if run is not None:
        numbers = nn.functional.pad(run, (NEIGHBOURS, NEIGHBOURS), value=-1).unfold(1, 2 * NEIGHBOURS + 1, 1)
        real = real & (numbers == run[..., None])
    arm = padded.mT - points[..., None, :]  # (B, N, W, 2)
    squared = (arm**2).sum(-1)
    others = real & (torch.arange(2 * NEIGHBOURS + 1, device=points.device) != NEIGHBOURS)
    is_found = others.any(-1)
    nearest = squared.masked_fill(~others, torch.inf).amin(-1).masked_fill(~is_found, 0.0)
    stretch = (STRETCH * noise[:, None]) ** 2 + STEPS**2 * nearest
    kernel = (1 - squared / stretch[..., None]).clamp(min=0) * real
    share = (kernel / kernel.sum(-1, keepdim=True).clamp(min=1e-9))[..., None]
    spread = arm - (share * arm).sum(-2, keepdim=True)
    xx, yy = (share * spread**2).sum(-2).unbind(-1)
    xy = (share[..., 0] * spread[..., 0] * spread[..., 1]).sum(-1)
    angle = safe_atan2(2 * xy, xx - yy) / 2
    return torch.stack([angle.cos(), angle.sin()], -1), is_found & (xx + yy > 0)
