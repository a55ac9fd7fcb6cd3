"""One scan seen as pieces of surface: spacing, tangents, segments, and what its beams say of free space.

Everything here is in units that the scan itself gives (bearing steps, ranges, noise), so one setting serves any scanner.
Functions take one scan, unpadded: the start of a pair is looked for pair by pair.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from torchcrf_scan.features.free_space import SLACK_SHARE, SLACK_STEPS, WIDEST_GAP, rising_turn
from torchcrf_scan.geometry import se2

if TYPE_CHECKING:
    from scipy.spatial import cKDTree

GRAZING = math.radians(10.0)  # a surface met at a flatter angle looks like a depth jump (adaptive breakpoint detector)
WIDEST_TURN = GRAZING * (1 - 1e-4)  # between neighbours on a surface; beams are whole steps apart, and just `GRAZING` is too far


@dataclass(frozen=True, slots=True)
class Surface:
    """A scan of P points with its geometry.

    Attributes:
        points: (P, 2).
        origin: (2,) where the sensor stood, in the frame of the points.
        ranges: (P,), bearings: (P,) of the points, as seen from there.
        spacing: (P,) metres to the next point of the same surface; what a beam step covers where there is none.
        tangent: (P, 2) unit vector along the surface, 0 for a lonely point.
        length: (P,) metres of surface that the point stands for.
        segment: (P,) int64, numbered 0.. in beam order; a closed scan's last segment may be its first.
        step: () usual bearing step, radians.
        noise: () standard deviation of a return, metres.
        is_closed: the scan covers the whole circle.
        tree: the points in a k-d tree, for nearest neighbours.
    """

    points: Tensor
    origin: Tensor
    ranges: Tensor
    bearings: Tensor
    spacing: Tensor
    tangent: Tensor
    length: Tensor
    segment: Tensor
    step: Tensor
    noise: Tensor
    is_closed: bool
    tree: cKDTree

    @classmethod
    def of(cls, points: Tensor, noise: Tensor, is_closed: bool, origin: Tensor | None = None) -> Surface:
        """points: (P, 2) in beam order, P >= 1; noise: () metres; origin: (2,) of the sensor, None: the origin of the frame."""
        from scipy.spatial import cKDTree

        origin = torch.zeros_like(points[0]) if origin is None else origin
        ranges, bearings = _look_from(origin, points)
        bearings = torch.cat([bearings[:1], rising_turn(bearings.diff())]).cumsum(0)  # rising through the scan
        following = points.roll(-1, 0) - points  # (P, 2), the last one leads round
        gap = torch.linalg.vector_norm(following, dim=-1)
        turn = rising_turn(bearings.roll(-1, 0) - bearings)
        step = turn[:-1].median() if len(points) > 1 else turn.new_tensor(math.radians(0.5))
        joined = gap <= _largest_gap(torch.minimum(ranges, ranges.roll(-1, 0)), turn, noise)
        joined &= turn < WIDEST_TURN
        if not is_closed:
            joined[-1] = False
        before = joined.roll(1, 0)
        footprint = ranges * step
        spacing = torch.where(joined, gap, torch.inf).minimum(torch.where(before, gap.roll(1, 0), torch.inf))
        spacing = torch.where(spacing < torch.inf, spacing, footprint)
        arm = following * joined[:, None] + following.roll(1, 0) * before[:, None]
        arm_length = torch.linalg.vector_norm(arm, dim=-1, keepdim=True)
        return cls(
            points=points,
            origin=origin,
            ranges=ranges,
            bearings=bearings,
            spacing=spacing,
            tangent=arm / arm_length.clamp(min=1e-9),
            length=(gap * joined + gap.roll(1, 0) * before) / 2 + footprint / 2 * ((~joined).to(gap) + (~before).to(gap)),
            segment=_number_segments(joined),
            step=step,
            noise=noise,
            is_closed=is_closed,
            tree=cKDTree(points.detach().cpu().numpy()),
        )

    def __len__(self) -> int:
        return len(self.points)


def _look_from(origin: Tensor, points: Tensor) -> tuple[Tensor, Tensor]:
    """(...,) ranges and bearings of (..., 2) points as seen from (2,)."""
    ray = points - origin
    return torch.linalg.vector_norm(ray, dim=-1), torch.atan2(ray[..., 1], ray[..., 0])


def _largest_gap(ranges: Tensor, turn: Tensor, noise: Tensor) -> Tensor:
    """(P,) farthest that two neighbouring returns of one surface can be apart."""
    return ranges * torch.sin(turn) / torch.sin((GRAZING - turn).clamp(min=1e-3)) + 6 * noise


def _number_segments(joined: Tensor) -> Tensor:
    """(P,) segment numbers; joined[i] says that points i and i + 1 are one surface."""
    number = torch.cat([joined.new_zeros(1, dtype=torch.int64), (~joined[:-1]).long().cumsum(0)])
    return torch.where(number == number[-1], 0, number) if bool(joined[-1]) else number


@dataclass(frozen=True, slots=True)
class Sight:
    """What the other scan's beams say of points carried into it; no flag: they agree.

    Attributes:
        seen_through: (..., P) bool, the beam went on past the point: it cannot be there.
        occluded: (..., P) bool, the beam stopped before the point, or the sensor does not look there: no statement.
        unmeasured: (..., P) bool, the beams around returned nothing: hardly a statement.
    """

    seen_through: Tensor
    occluded: Tensor
    unmeasured: Tensor


def look_along(moved: Tensor, scan: Surface, margin: float = SLACK_STEPS) -> Sight:
    """Free-space test (design finding 13) of points carried into the frame of `scan`.

    Args:
        moved: (..., P, 2).
        margin: slack in units of spacing and noise.
    """
    ranges, bearings = _look_from(scan.origin, moved)
    first, half_step = scan.bearings[0], scan.step / 2
    bearings = first + (bearings - first + half_step) % (2 * math.pi) - half_step
    after = torch.searchsorted(scan.bearings, bearings.contiguous())
    M = len(scan)
    inside = bearings <= scan.bearings[-1] + half_step
    if scan.is_closed:
        left, right = (after - 1) % M, after % M
    else:
        left, right = (after - 1).clamp(min=0), after.clamp(max=M - 1)
    apart = torch.maximum(rising_turn(bearings - scan.bearings[left]), rising_turn(scan.bearings[right] - bearings)).minimum(
        torch.where(left == right, half_step, torch.inf)
    )
    measured = (inside | scan.is_closed) & (apart < WIDEST_GAP * scan.step)
    slack = margin * (scan.noise + ranges * scan.step) + SLACK_SHARE * ranges
    near = torch.minimum(scan.ranges[left], scan.ranges[right])
    far = torch.maximum(scan.ranges[left], scan.ranges[right])
    outside = ~inside & (not scan.is_closed)
    return Sight(
        seen_through=measured & (ranges + slack < near),
        occluded=outside | (measured & (ranges > far + slack)),
        unmeasured=~measured & ~outside,
    )


def carry_back(motions: Tensor, points: Tensor) -> Tensor:
    """Target points in the source frame under every motion: (H, 3), (M, 2) -> (H, M, 2)."""
    return se2.apply(se2.inverse(motions), points)
