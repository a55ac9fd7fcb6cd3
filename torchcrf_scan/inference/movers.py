"""The start of the moving objects (InitialiseRT, second half): many hypothesised motions, the few that explain what the background cannot."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from torchcrf_scan.geometry import se2
from torchcrf_scan.inference.background import unit_length
from torchcrf_scan.inference.registration import nearest_points, register
from torchcrf_scan.inference.surface import Surface, carry_back, look_along

TRUNCATION = 3.0  # a residual of three units is as bad as any
CONTRADICTION = 3.0  # more units for a point that the other scan sees through
HIDDEN = 1.0  # at most this many units where the other scan could not have seen the point
UNMEASURED = 2.0  # and where its beams returned nothing, though a surface once seen there should be seen again
MIN_POINTS = 3
FASTEST = 45.0  # metres per second; no road vehicle moves more per second
FARTHEST = 0.6  # nor across more than this share of its range


def explain(moved: Tensor, other: Surface) -> Tensor:
    """(H, P) units that every point leaves unexplained when carried to (H, P, 2) in the frame of `other`."""
    distance, index = nearest_points(moved, other.points)
    unit = other.spacing[index] / 2 + 2 * other.noise
    residual = (distance / unit).clamp(max=TRUNCATION)
    sight = look_along(moved, other)
    residual = torch.where(sight.occluded, residual.clamp(max=HIDDEN), residual)
    residual = torch.where(sight.unmeasured, residual.clamp(max=UNMEASURED), residual)
    return residual + CONTRADICTION * (sight.seen_through & (residual >= TRUNCATION))


@dataclass(frozen=True, slots=True)
class Hypotheses:
    """H motions of source segments.

    Attributes:
        motions: (H, 3) `T_target_source`.
        members: (H, P) bool, the segment's points.
    """

    motions: Tensor
    members: Tensor


def hypothesise(
    source: Surface, target: Surface, background: Tensor, open_source: Tensor, open_target: Tensor, dt: float
) -> Hypotheses:
    """Aligns every segment holding unexplained points with every such segment of the other scan.

    By centroid and by both ends (a car is seen to another length in every scan), then by robust registration.

    Args:
        background: (3,). open_source: (P,), open_target: (M,) bool, unexplained by the background. dt: seconds.
    """
    of_source, of_target = _open_segments(source, open_source), _open_segments(target, open_target)
    carried = se2.apply(background, source.points)
    marks_source, marks_target = _landmarks(carried, of_source), _landmarks(target.points, of_target)  # (S, 3, 2), (T, 3, 2)
    shift = marks_target[None] - marks_source[:, None]  # (S, T, 3, 2)
    stay = torch.zeros_like(shift[:, :1, :1])
    shift = torch.cat([shift.flatten(1, 2), stay.flatten(1, 2)], dim=1)  # (S, 3T+1, 2)
    ranges = torch.linalg.vector_norm(marks_source[:, :1], dim=-1)  # (S, 1)
    reach = torch.minimum(ranges * FARTHEST, ranges.new_tensor(FASTEST * dt))
    which, start = (torch.linalg.vector_norm(shift, dim=-1) <= reach).nonzero(as_tuple=True)
    added = torch.cat([torch.zeros_like(shift[which, start, :1]), shift[which, start]], dim=-1)
    motions = se2.compose(added, background.expand_as(added))
    members = of_source[which]
    unit = float(unit_length(source, target))
    gates = [unit * g for g in (4.0, 3.0, 2.0, 2.0, 1.5, 1.5)]
    motions = register(source.points, members.to(source.points), target, motions, gates, [1.0, 1.0, 0.5, 0.5, 0.2, 0.2])
    return Hypotheses(motions, members)


def _open_segments(surface: Surface, is_open: Tensor) -> Tensor:
    """(S, P) bool: members of every segment with enough unexplained points, alone and joined with the next such segment."""
    count = int(surface.segment.max()) + 1
    members = surface.segment[None] == torch.arange(count, device=surface.segment.device)[:, None]
    enough = (members & is_open).any(-1)
    members = members[enough & (members.sum(-1) >= MIN_POINTS)]
    parts = members & is_open  # an object before a wall may share its segment: its open part is tried alone, too
    partial = (parts.sum(-1) >= MIN_POINTS) & (parts.sum(-1) < 0.7 * members.sum(-1))
    return torch.cat([members, parts[partial]])


def _landmarks(points: Tensor, members: Tensor) -> Tensor:
    """(S, 3, 2): centroid, first and last point of every segment."""
    weights = members.to(points)
    centroid = weights @ points / weights.sum(-1, keepdim=True).clamp(min=1)
    order = torch.arange(len(points), device=points.device)
    first = torch.where(members, order, len(points)).amin(-1).clamp(max=len(points) - 1)
    last = torch.where(members, order, 0).amax(-1)
    return torch.stack([centroid, points[first], points[last]], dim=1)


def select(
    hypotheses: Hypotheses, source: Surface, target: Surface, background: Tensor, most: int, price: float, price_per_unit: float
) -> Tensor:
    """Greedy choice: the motion that explains most of what is still open, both ways, until none is worth its price.

    Args:
        most: movers at most. price: units that a mover must explain at least. price_per_unit: more for every unit it moved.

    Returns:
        (G, 3) motions of the accepted movers.
    """
    motions, members = hypotheses.motions, hypotheses.members
    open_forward = explain(se2.apply(background, source.points)[None], target)[0]  # (P,)
    open_backward = explain(carry_back(background[None], target.points), source)[0]  # (M,)
    if not len(motions):
        return motions
    moved = se2.apply(motions, source.points)  # (H, P, 2)
    forward = torch.where(members, explain(moved, target), torch.inf)
    backward = _covered(moved, members, target)
    centroid = _landmarks(se2.apply(background, source.points), members)[:, :1]
    undone = se2.compose(motions, se2.inverse(background).expand_as(motions))
    travel = torch.linalg.vector_norm(se2.apply(undone, centroid) - centroid, dim=-1)[:, 0]
    cost = price + price_per_unit * travel / unit_length(source, target)
    accepted: list[int] = []
    while len(accepted) < most:
        gain = (open_forward - forward).clamp(min=0).sum(-1) + (open_backward - backward).clamp(min=0).sum(-1)
        gain = gain - (forward - open_forward).masked_fill(~members, 0).clamp(min=0).sum(-1) - cost
        best = int(gain.argmax())
        if float(gain[best]) <= 0:
            break
        accepted.append(best)
        open_forward, open_backward = torch.minimum(open_forward, forward[best]), torch.minimum(open_backward, backward[best])
    return motions[accepted]


def _covered(moved: Tensor, members: Tensor, target: Surface) -> Tensor:
    """(H, M) residual of every target point to the nearest member, in units; inf where it is no nearer than the truncation."""
    dx = target.points[:, 0] - moved[..., None, 0]
    dy = target.points[:, 1] - moved[..., None, 1]  # (H, P, M)
    distance = (dx * dx + dy * dy).masked_fill(~members[..., None], torch.inf).amin(1).sqrt()
    residual = distance / (target.spacing / 2 + 2 * target.noise)
    return torch.where(residual < TRUNCATION, residual, torch.inf)
