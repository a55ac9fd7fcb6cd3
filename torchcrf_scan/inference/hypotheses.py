"""Hypothesised motions of movers: an over-complete pool that nearly always holds the true ones (design finding 14).

The background leaves points of both scans unexplained. Every segment of the first scan that holds some is carried to every such
segment of the second and registered there.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from torchcrf_scan.geometry import se2
from torchcrf_scan.inference.background import unit_length
from torchcrf_scan.inference.registration import nearest_points, register
from torchcrf_scan.inference.surface import Sight, Surface, look_along

TRUNCATION = 3.0  # a residual of three units is as bad as any
OPEN = 1.5  # units from which a point is not explained
MIN_POINTS = 3
PIECE_GAP = 2.5  # beam spacings from which two neighbours on a segment may be two objects
LIFTED = 0.9  # units, mean residual from which a piece may have moved although none of its points is open
SEGMENT_GAP = 8.0  # two unexplained segments this many spacings apart may be one object, seen with a beam missing
FASTEST = 45.0  # metres per second; no road vehicle moves more per second
FARTHEST = 1.0  # nor farther than this share of its range
SCREEN_POINTS = 8  # of a segment, to compare starts
STARTS = 5  # of a segment, to register
REGISTER_POINTS = 16
USUAL_TURN = 0.1  # radians, standard deviation of a mover's turn between two scans
PART = 0.7  # of a segment: its unexplained points, if they are fewer, may be an object before a wall
SETTLE_GATES = (4.0, 3.0, 2.0, 2.0, 1.5, 1.5)  # units, one per iteration,
SETTLE_ALONG = (1.0, 1.0, 0.5, 0.5, 0.2, 0.2)  # and how much of the residual along the surface counts


@dataclass(frozen=True, slots=True)
class Leftover:
    """What a background motion leaves unexplained.

    Attributes:
        source: (P,), target: (M,) residual in units, at most `TRUNCATION`.
        source_sight: what the target's beams say of the source's points, target_sight: the reverse.
    """

    source: Tensor
    target: Tensor
    source_sight: Sight
    target_sight: Sight

    @classmethod
    def of(cls, source: Surface, target: Surface, background: Tensor) -> Leftover:
        """background: (3,)."""
        forward, backward = se2.apply(background, source.points), se2.apply(se2.inverse(background), target.points)
        ahead, back = look_along(forward, target), look_along(backward, source)
        return cls(residual_units(forward, target), residual_units(backward, source), ahead, back)


def point_units(surface: Surface) -> Tensor:
    """(P,) metres: how far from a point of the surface a well registered point of another scan may lie."""
    return surface.spacing / 2 + 2 * surface.noise


def residual_units(moved: Tensor, other: Surface) -> Tensor:
    """(...,) distance to the other scan in its local units, truncated. moved: (..., 2) in its frame."""
    distance, index = nearest_points(moved, other)
    return (distance / point_units(other)[index]).clamp(max=TRUNCATION)


@dataclass(frozen=True, slots=True)
class Hypotheses:
    """H motions of source segments.

    Attributes:
        motions: (H, 3) `T_target_source`.
        members: (H, P) bool, the segment's points.
    """

    motions: Tensor
    members: Tensor

    def __len__(self) -> int:
        return len(self.motions)


def hypothesise(source: Surface, target: Surface, background: Tensor, dt: float) -> Hypotheses:
    """Aligns every segment holding unexplained points with every such segment of the other scan.

    By centroid and by both ends (a car is seen to another length in every scan); the best starts are registered.

    Args:
        background: (3,).
        dt: seconds between the scans.
    """
    if min(len(source), len(target)) < MIN_POINTS:
        return Hypotheses(background.new_zeros(0, 3), torch.zeros(0, len(source), dtype=torch.bool, device=background.device))
    leftover = Leftover.of(source, target, background)
    groups, landing = _groups(source, leftover.source), _groups(target, leftover.target)
    if not len(groups):
        return Hypotheses(background.new_zeros(0, 3), groups)
    shift = _shifts(se2.apply(background, source.points), groups, target, landing, dt)  # (S, A, 2)
    shift = _screen(shift, source, groups, target, background)  # (S, K, 2)
    added = torch.cat([torch.zeros_like(shift[..., :1]), shift], dim=-1)
    motions = se2.compose(added, background.expand_as(added))  # (S, K, 3)
    which, start = shift.isfinite().all(-1).nonzero(as_tuple=True)
    return Hypotheses(_settle(motions[which, start], groups[which], source, target, background), groups[which])


def _groups(surface: Surface, residual: Tensor) -> Tensor:
    """(S, P) bool: what may be one object: segments and pieces, alone and two neighbours at a time, and unexplained parts and runs.

    residual: (P,) units that the background leaves.
    """
    is_open = residual >= OPEN
    segments, runs = _holding(surface.segment, is_open), _holding(_number(_are_joined(surface, is_open)), is_open)
    piece = pieces(surface)
    usual = torch.zeros_like(residual).scatter_reduce(0, piece, residual, "mean", include_self=False)
    whole = _holding(piece, is_open | (usual >= LIFTED)[piece])
    parts = segments & is_open  # an object before a wall may share its segment
    is_part = parts.sum(-1) < PART * segments.sum(-1)
    groups = torch.cat([segments, whole, parts[is_part], runs, _neighbours(surface, segments), _neighbours(surface, whole)])
    groups = groups[groups.sum(-1) >= MIN_POINTS]
    return groups.unique(dim=0) if len(groups) else groups


def _holding(number: Tensor, is_open: Tensor) -> Tensor:
    """(S, P) bool: the segments that hold a point of a kind. number: (P,) segment of every point."""
    return number == number[is_open].unique()[:, None]


def pieces(surface: Surface) -> Tensor:
    """(P,) number of every point's piece: segments, cut where neighbours lie far apart for a surface met at no flat angle.

    Far away, the gap that a segment may have is as wide as a car's distance from the wall behind it.
    """
    gap = torch.linalg.vector_norm(surface.points.roll(-1, 0) - surface.points, dim=-1)
    return _number(_are_joined(surface) & (gap <= PIECE_GAP * surface.ranges * surface.step + 6 * surface.noise))


def _are_joined(surface: Surface, kind: Tensor | None = None) -> Tensor:
    """(P,) bool: a point and the next one lie on one segment and are of one kind (P,)."""
    joined = surface.segment == surface.segment.roll(-1)
    if kind is not None:
        joined &= kind == kind.roll(-1)
    joined[-1] &= surface.is_closed
    return joined


def _number(joined: Tensor) -> Tensor:
    """(P,) numbers from 0; joined[i] says that points i and i + 1 have the same."""
    number = torch.cat([joined.new_zeros(1, dtype=torch.int64), (~joined[:-1]).long().cumsum(0)])
    return torch.where(number == number[-1], 0, number) if bool(joined[-1]) else number


def _neighbours(surface: Surface, members: Tensor) -> Tensor:
    """(S', P) bool: every listed segment together with the next one, where they are near."""
    return (members | members.roll(-1, 0))[_are_near(surface, members)]


def _are_near(surface: Surface, members: Tensor) -> Tensor:
    """(S,) bool: a segment's end lies near the start of the next listed one."""
    if len(members) < 2:
        return members.new_zeros(len(members))
    marks = landmarks(surface.points, members)
    gap = torch.linalg.vector_norm(marks[:, 2] - marks.roll(-1, 0)[:, 1], dim=-1)
    footprint = torch.linalg.vector_norm(marks[:, 2], dim=-1) * surface.step
    is_last = torch.arange(len(members), device=gap.device) == len(members) - 1
    is_counted = is_last & (len(members) == 2)  # with the first, already
    return (gap < SEGMENT_GAP * footprint + 6 * surface.noise) & ~is_counted


def landmarks(points: Tensor, members: Tensor) -> Tensor:
    """(S, 3, 2): centroid, first and last point of every segment, also of one that leads round the seam of a closed scan."""
    weights = members.to(points)
    centroid = weights @ points / weights.sum(-1, keepdim=True).clamp(min=1)
    first, last = ends(members)
    return torch.stack([centroid, points[first], points[last]], dim=1)


def ends(members: Tensor) -> tuple[Tensor, Tensor]:
    """(S,) index of the first and of the last member, also of a set that leads round the seam of a closed scan. members: (S, P)."""
    count = members.shape[-1]
    order = torch.arange(count, device=members.device)
    is_round = (members[:, 0] & members[:, -1])[:, None]
    order = torch.where(is_round, (order + count // 2) % count, order)  # (S, P)
    return torch.where(members, order, count).argmin(-1), torch.where(members, order, -1).argmax(-1)


def _shifts(carried: Tensor, groups: Tensor, target: Surface, landing: Tensor, dt: float) -> Tensor:
    """(S, A, 2) translations of every group after the background's motion; NaN where none could move so far."""
    marks, goals = landmarks(carried, groups), landmarks(target.points, landing)
    shift = (goals[None] - marks[:, None]).flatten(1, 2)  # (S, 3T, 2)
    shift = torch.cat([torch.zeros_like(marks[:, :1]), shift], dim=1)
    reach = (torch.linalg.vector_norm(marks[:, :1], dim=-1) * FARTHEST).clamp(max=FASTEST * dt)
    return shift.masked_fill((torch.linalg.vector_norm(shift, dim=-1) > reach)[..., None], torch.nan)


def pick_members(groups: Tensor, most: int) -> tuple[Tensor, Tensor]:
    """Index (S, L) of at most `most` members of every group, evenly spread, and (S, L) whether it is one."""
    size = groups.sum(-1)
    first = size.cumsum(0) - size
    longest = int(size.clamp(max=most).max())
    place = torch.arange(longest, device=groups.device)[None]
    rank = torch.where(size[:, None] > most, place * size[:, None] // longest, place)
    is_member = rank < size[:, None]
    flat = first[:, None] + torch.minimum(rank, size[:, None] - 1)  # the rest repeats the last one
    return groups.nonzero()[:, 1][flat], is_member


def _screen(shift: Tensor, source: Surface, groups: Tensor, target: Surface, background: Tensor) -> Tensor:
    """(S, K, 2) starts whose residual is least and which differ; NaN where a group has fewer."""
    index, is_member = pick_members(groups, SCREEN_POINTS)
    points = se2.apply(background, source.points)[index]  # (S, L, 2)
    units = residual_units(points[:, None] + shift.nan_to_num()[:, :, None], target)  # (S, A, L)
    cost = (units * is_member[:, None]).sum(-1) / is_member.sum(-1)[:, None]
    cost = cost.masked_fill(shift.isnan().any(-1), torch.inf)
    near = 2 * unit_length(source, target)
    kept = []
    for _ in range(min(STARTS, shift.shape[1])):
        least, best = cost.min(-1)
        chosen = shift.gather(1, best[:, None, None].expand(-1, 1, 2))  # (S, 1, 2)
        cost = cost.masked_fill(torch.linalg.vector_norm(shift - chosen, dim=-1) < near, torch.inf)
        kept.append(chosen.masked_fill(least.isinf()[:, None, None], torch.nan))
    return torch.cat(kept, dim=1)


def _settle(motions: Tensor, members: Tensor, source: Surface, target: Surface, background: Tensor) -> Tensor:
    """(H, 3) registers every start; few points say little of a turn."""
    index, is_member = pick_members(members, REGISTER_POINTS)
    points, weights = source.points[index], is_member.to(source.points)
    unit = float(unit_length(source, target))
    motions = register(points, weights, target, motions, [unit * gate for gate in SETTLE_GATES], SETTLE_ALONG)
    return _steady(motions, points, weights, background, unit_length(source, target))


def _steady(motions: Tensor, points: Tensor, weights: Tensor, background: Tensor, unit: Tensor) -> Tensor:
    """Turns every motion back towards the background's heading about its points' centre, as far as they cannot tell.

    Args:
        motions: (H, 3). points: (H, L, 2), weights: (H, L). unit: () metres, the error of a point.
    """
    moved = se2.apply(motions, points)
    centre = (weights[..., None] * moved).sum(1) / weights.sum(-1, keepdim=True)
    told = (weights * ((moved - centre[:, None]) ** 2).sum(-1)).sum(-1) / unit**2  # 1 / variance of the heading
    turn = -se2.wrap(motions[:, 0] - background[0]) / (1 + told * USUAL_TURN**2)
    back = torch.cat([turn[:, None], centre - se2.rotate(turn, centre)], dim=-1)
    return se2.compose(back, motions)
