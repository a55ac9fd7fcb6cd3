"""Disturbances of real recordings that the ideal simulator lacks: the sensor moves while it sweeps, and it tilts."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from torchcrf_scan.batch import ScanPairBatch
from torchcrf_scan.features.potentials import resolution
from torchcrf_scan.geometry import se2

BUMP_BEAMS = 8  # neighbouring beams that share an error


def skew(points: Tensor, mask: Tensor, amount: Tensor, generator: torch.Generator) -> Tensor:
    """Scan distortion by motion of the sensor during a sweep, relative to the middle of the sweep.

    Args:
        points: (B, P, 2). mask: (B, P). amount: (B,) typical displacement of the ends of the sweep, metres.
    """
    count = mask.sum(-1, keepdim=True).clamp(min=2)
    phase = 2 * torch.arange(points.shape[1], device=points.device) / (count - 1) - 1  # (B, P), -1 to 1
    ranges = torch.linalg.vector_norm(points, dim=-1).masked_fill(~mask, torch.nan)
    usual = ranges.nanmedian(-1).values.nan_to_num(nan=1.0).clamp(min=1e-3)
    twist = amount[:, None] * torch.randn(len(points), 3, generator=generator).to(points)
    twist = torch.cat([twist[:, :1] / usual[:, None], twist[:, 1:]], dim=-1)
    moved = se2.apply(phase[..., None] * twist[:, None], points[:, :, None])[:, :, 0]
    return torch.where(mask[..., None], moved, points)


def bump(points: Tensor, amount: Tensor, generator: torch.Generator) -> Tensor:
    """Range errors shared by neighbouring beams, as of a tilted sensor. points: (B, P, 2); amount: (B,) metres."""
    knots = torch.randn(len(points), 1, points.shape[1] // BUMP_BEAMS + 2, generator=generator)
    error = torch.nn.functional.interpolate(knots, size=points.shape[1], mode="linear", align_corners=True)[:, 0].to(points)
    ranges = torch.linalg.vector_norm(points, dim=-1, keepdim=True).clamp(min=1e-6)
    return points * (1 + (amount[:, None] * error)[..., None] / ranges).clamp(min=0.5)


def disturb(batch: ScanPairBatch, strength: float, generator: torch.Generator) -> ScanPairBatch:
    """Skews and bumps every source scan by a random share of `strength` units of the pair's resolution; labels are unchanged."""
    share = torch.rand(2, len(batch), generator=generator).to(batch.source)
    amount = strength * share * resolution(batch)
    source = skew(batch.source, batch.source_mask, amount[0], generator)
    return replace(batch, source=bump(source, amount[1], generator))
