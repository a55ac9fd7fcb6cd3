"""Free space and occlusion: consistency of points with the beams of another scan.

A point in front of a beam's return contradicts that beam, which passed through it; a point behind it is occluded: the consistency
test that separates movers from static outliers (Wang and Thorpe, the paper's [24]; design finding 13).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import pad

from torchcrf_scan.loops.circle import BACKWARDS, LEAST_TURN, USUAL_STEP

SLACK_STEPS = 3.0  # tolerance on a range, in beam spacings and noises,
SLACK_SHARE = 0.02  # and as a share of the range: calibration, tilt
LEAST_SLACK = 1e-6  # in the unit of the points
WIDEST_GAP = 2.5  # beam steps; between returns farther apart the scan holds no information


@dataclass(frozen=True, slots=True)
class Sweep:
    """B scans in polar coordinates about their sensor.

    Attributes:
        origin: (B, 2) position of the sensor.
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
        between = turns.masked_fill(~mask[:, 1:] | (turns < LEAST_TURN), torch.nan)  # several returns of one beam have no step
        step = pad(between, (0, 1), value=torch.nan).nanmedian(1).values.nan_to_num(nan=USUAL_STEP)
        return cls(origin, ranges, bearings, count, closed, step, noise)


def rising_turn(difference: Tensor) -> Tensor:
    """Counter-clockwise angle in [0, 2 pi); steps back within rounding error count as 0."""
    return ((difference + BACKWARDS) % (2 * math.pi) - BACKWARDS).clamp(min=0)


def bearing_in(scan: Sweep, arms: Tensor) -> Tensor:
    """(B, P) bearings of vectors (B, P, 2) from the sensor, unwrapped as the scan's rising bearings."""
    first, half = scan.bearings[:, :1].nan_to_num(posinf=0.0), scan.step[:, None] / 2
    return first + (torch.atan2(arms[..., 1], arms[..., 0]) - first + half) % (2 * math.pi) - half


@dataclass(frozen=True, slots=True)
class FreeSpace:
    """Degrees of contradiction and occlusion of points by beams, each from 0 to 1.

    Attributes:
        seen_through: (B, ...) the beams on both sides passed the point, which therefore cannot be there.
        hidden: (B, ...) the beams stopped before it, or it is outside the field of view.
    """

    seen_through: Tensor
    hidden: Tensor


def look(scan: Sweep, points: Tensor) -> FreeSpace:
    """Free space and occlusion of points (B, ..., 2) in a scan's frame. Differentiable in the points except at kinks."""
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
    slack = slack.clamp(min=LEAST_SLACK)
    seen_through = ((near - ranges) / slack - 1).clamp(0, 1) * measured
    hidden = torch.where(inside, ((ranges - far) / slack - 1).clamp(0, 1) * measured, torch.ones_like(ranges))
    return FreeSpace(seen_through.view(shape), hidden.view(shape))
