"""What the beams of a scan say of points carried into it.

A point in front of what a beam hit contradicts that beam, which went through it; one behind it is hidden from it: the consistency
test that tells movers from static outliers (Wang and Thorpe, the paper's [24]; design finding 13).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import pad

SLACK_STEPS = 3.0  # beam spacings and noises that a range may differ by,
SLACK_SHARE = 0.02  # and share of the range: calibration, tilt
BACKWARDS = 1e-4  # radians; a step back by so little is no turn
WIDEST_GAP = 2.5  # beam steps between two returns from which on nothing is known between them


@dataclass(frozen=True, slots=True)
class Sweep:
    """B scans as their sensor sees them.

    Attributes:
        origin: (B, 2) where the sensor stands.
        ranges: (B, N), bearings: (B, N) rising through the scan, inf in the padding.
        count: (B,) real points. closed: (B,) bool.
        step: (B,) usual bearing step, radians. noise: (B,) of a range, in the unit of the points.
    """

    origin: Tensor
    ranges: Tensor
    bearings: Tensor
    count: Tensor
    closed: Tensor
    step: Tensor
    noise: Tensor

    @classmethod
    @torch.no_grad()
    def of(cls, points: Tensor, mask: Tensor, closed: Tensor, noise: Tensor, origin: Tensor) -> Sweep:
        """points: (B, N, 2) in beam order; mask: (B, N); closed, noise: (B,); origin: (B, 2)."""
        arms = points - origin[:, None]
        ranges = torch.linalg.vector_norm(arms, dim=-1)
        count = mask.sum(-1)
        turns = rising_turn(torch.atan2(arms[..., 1], arms[..., 0]).diff(dim=1)).masked_fill(~mask[:, 1:], 0.0)  # (B, N-1)
        first = torch.atan2(arms[:, :1, 1], arms[:, :1, 0])
        bearings = torch.cat([first, first + turns.cumsum(1)], dim=1).masked_fill(~mask, torch.inf)
        known = pad(turns.masked_fill(~mask[:, 1:], torch.nan), (0, 1), value=torch.nan)  # one point has no turn
        step = known.nanmedian(1).values.nan_to_num(nan=math.radians(0.5))
        return cls(origin, ranges, bearings, count, closed, step, noise)


def rising_turn(difference: Tensor) -> Tensor:
    """Counter-clockwise angle in [0, 2 pi); a step back by rounding is no turn."""
    return ((difference + BACKWARDS) % (2 * math.pi) - BACKWARDS).clamp(min=0)


def bearing_in(scan: Sweep, arms: Tensor) -> Tensor:
    """(B, P) directions of arms (B, P, 2) from the sensor, as numbers on the scale of the scan's rising bearings."""
    first, half = scan.bearings[:, :1].nan_to_num(posinf=0.0), scan.step[:, None] / 2
    return first + (torch.atan2(arms[..., 1], arms[..., 0]) - first + half) % (2 * math.pi) - half


@dataclass(frozen=True, slots=True)
class FreeSpace:
    """How far beams contradict points and hide them, each from 0 (not) to 1 (clearly).

    Attributes:
        seen_through: (B, ...) the beams on both sides went on past the point: it cannot be there.
        hidden: (B, ...) they stopped before it, or the sensor does not look there.
    """

    seen_through: Tensor
    hidden: Tensor


def look(scan: Sweep, points: Tensor) -> FreeSpace:
    """What a scan's beams say of points in its frame. points: (B, ..., 2). Differentiable in the points but for the kinks."""
    shape = points.shape[:-1]
    arms = points.flatten(1, -2) - scan.origin[:, None]  # (B, P, 2)
    ranges = torch.linalg.vector_norm(arms, dim=-1)
    with torch.no_grad():
        step, half = scan.step[:, None], scan.step[:, None] / 2
        bearing = bearing_in(scan, arms)
        last = (scan.count[:, None] - 1).clamp(min=0)
        after = torch.searchsorted(scan.bearings, bearing.contiguous())
        is_closed = scan.closed[:, None]
        left = torch.where(is_closed, (after - 1) % (last + 1), (after - 1).clamp(min=0))
        right = torch.where(is_closed, after % (last + 1), torch.minimum(after, last))
        left = torch.minimum(left, last)
        inside = is_closed | (bearing <= scan.bearings.gather(1, last) + half)
        beside = torch.maximum(
            rising_turn(bearing - scan.bearings.gather(1, left)), rising_turn(scan.bearings.gather(1, right) - bearing)
        )
        beside = beside.nan_to_num(nan=torch.inf)
        measured = inside & ((beside < WIDEST_GAP * step) | (left == right)) & (scan.count[:, None] > 0)
        near = torch.minimum(scan.ranges.gather(1, left), scan.ranges.gather(1, right))
        far = torch.maximum(scan.ranges.gather(1, left), scan.ranges.gather(1, right))
    slack = SLACK_STEPS * (scan.noise[:, None] + ranges * step) + SLACK_SHARE * ranges
    slack = slack.clamp(min=1e-6)
    seen_through = ((near - ranges) / slack - 1).clamp(0, 1) * measured
    hidden = torch.where(inside, ((ranges - far) / slack - 1).clamp(0, 1) * measured, torch.ones_like(ranges))
    return FreeSpace(seen_through.view(shape), hidden.view(shape))
