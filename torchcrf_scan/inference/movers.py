"""The start of the moving objects (InitialiseRT, second half): many hypothesised motions, and a learned score of which to accept.

The background leaves points of both scans unexplained. Every segment of the first scan that holds some is carried to every such
segment of the second and registered there; that pool nearly always holds the movers' motions, and a hundred wrong ones. A
log-linear score of features in units of local spacing tells them apart (design finding 14).
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn

from torchcrf_scan.geometry import se2
from torchcrf_scan.inference.background import unit_length
from torchcrf_scan.inference.registration import nearest_points, register
from torchcrf_scan.inference.surface import Sight, Surface, look_along

TRUNCATION = 3.0  # a residual of three units is as bad as any
OPEN = 1.5  # units from which a point is not explained
EXPLAINED = 1.0  # units up to which it is explained well
MIN_POINTS = 3
SEGMENT_GAP = 8.0  # two unexplained segments this many spacings apart may be one object, seen with a beam missing
FASTEST = 45.0  # metres per second; no road vehicle moves more per second
FARTHEST = 1.0  # nor farther than this share of its range
SCREEN_POINTS = 8  # of a segment, to compare starts
STARTS = 6  # of a segment, to register
REGISTER_POINTS = 24
FEATURE_POINTS = 40
REACH = 6.0  # units, and the extent: how far from the members unexplained points of the target are asked for
AROUND = 15  # beams
USUAL_TURN = 0.1  # radians, standard deviation of a mover's turn between two scans
AS_WELL = 0.5  # units; a motion that fits this much worse at most explains the points as well
LARGEST = 4.0  # standard deviations; what lies beyond tells no more
SHARED = 0.4  # share of points in common from which two hypotheses compete

# Feature: its mean, its scale, and the weights of the standardised feature and of its square; fitted on 110 simulated pairs.
STREETS_AND_ROOMS = {
    "size": (2.468, 0.986, -0.409, 0.037),
    "share_of_segment": (0.79, 0.341, 0.264, -0.236),
    "extent": (2.085, 0.832, -0.095, 0.165),
    "linearity": (0.802, 0.177, -0.285, -0.163),
    "range": (0.179, 0.655, -0.595, -0.007),
    "residual": (1.03, 0.564, 0.071, -0.064),
    "gain": (0.555, 0.961, 0.561, 0.154),
    "total_gain": (1.492, 1.16, 0.107, -0.029),
    "explained": (0.631, 0.276, 0.069, 0.077),
    "open_before": (0.529, 0.391, 0.264, -0.333),
    "occluded_before": (0.111, 0.232, 0.102, -0.092),
    "seen_through_before": (0.053, 0.173, 0.405, -0.05),
    "seen_through": (0.079, 0.16, -0.423, -0.157),
    "occluded": (0.08, 0.149, -0.59, -0.022),
    "distinct": (0.555, 0.278, 0.144, -0.116),
    "landing_open": (0.311, 0.327, -0.04, -0.14),
    "landing_seen_through_before": (0.055, 0.175, 0.572, -0.08),
    "target_open": (1.808, 0.852, -0.386, -0.266),
    "target_residual": (1.846, 0.871, 0.006, 0.027),
    "target_gain": (0.324, 0.874, 0.387, 0.144),
    "target_total_gain": (0.882, 1.008, 0.223, 0.002),
    "target_cover": (0.404, 0.364, -0.005, -0.012),
    "displacement": (2.251, 1.195, -0.2, -0.23),
    "displacement_in_spacings": (2.461, 1.255, -0.013, -0.385),
    "displacement_in_range": (0.308, 0.32, -0.483, 0.095),
    "displacement_in_extent": (1.117, 1.019, -0.694, -1.016),
    "along_surface": (0.703, 0.215, -0.289, 0.063),
    "rotation": (0.531, 0.608, -0.571, -0.235),
    "gain_both_ways": (1.873, 1.128, 0.275, 0.232),
    "residual_to_best": (0.517, 0.525, -0.245, 0.151),
    "total_gain_to_best": (-0.843, 0.934, 0.275, 0.014),
    "target_total_gain_to_best": (-0.966, 0.893, 0.049, 0.224),
    "units_around": (1.061, 0.356, 0.188, 0.068),
    "scene_open": (0.203, 0.097, -0.168, -0.051),
}
BIAS, THRESHOLD = -4.902, 0.35
FEATURES = tuple(STREETS_AND_ROOMS)


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
    groups, landing = _groups(source, leftover.source >= OPEN), _groups(target, leftover.target >= OPEN)
    if not len(groups):
        return Hypotheses(background.new_zeros(0, 3), groups)
    shift = _shifts(se2.apply(background, source.points), groups, target, landing, dt)  # (S, A, 2)
    shift = _screen(shift, source, groups, target, background)  # (S, K, 2)
    added = torch.cat([torch.zeros_like(shift[..., :1]), shift], dim=-1)
    motions = se2.compose(added, background.expand_as(added))  # (S, K, 3)
    which, start = shift.isfinite().all(-1).nonzero(as_tuple=True)
    return _settle(motions[which, start], groups[which], source, target, background)


def _groups(surface: Surface, is_open: Tensor) -> Tensor:
    """(S, P) bool: segments with unexplained points, the unexplained part of each, and neighbours joined."""
    count = int(surface.segment.max()) + 1
    members = surface.segment[None] == torch.arange(count, device=is_open.device)[:, None]
    members = members[(members & is_open).any(-1)]
    parts = members & is_open  # an object before a wall may share its segment
    is_part = (parts.sum(-1) >= MIN_POINTS) & (parts.sum(-1) < 0.7 * members.sum(-1))
    pairs = members | members.roll(-1, 0)
    pairs = pairs[_are_near(surface, members)]
    groups = torch.cat([members, parts[is_part], pairs])
    return groups[groups.sum(-1) >= MIN_POINTS]


def _are_near(surface: Surface, members: Tensor) -> Tensor:
    """(S,) bool: a segment's end lies near the start of the next listed one."""
    if len(members) < 2:
        return members.new_zeros(len(members))
    marks = _landmarks(surface.points, members)
    gap = torch.linalg.vector_norm(marks[:, 2] - marks.roll(-1, 0)[:, 1], dim=-1)
    footprint = torch.linalg.vector_norm(marks[:, 2], dim=-1) * surface.step
    is_last = torch.arange(len(members), device=gap.device) == len(members) - 1
    is_counted = is_last & (len(members) == 2)  # with the first, already
    return (gap < SEGMENT_GAP * footprint + 6 * surface.noise) & ~is_counted


def _landmarks(points: Tensor, members: Tensor) -> Tensor:
    """(S, 3, 2): centroid, first and last point of every segment, also of one that leads round the seam of a closed scan."""
    weights = members.to(points)
    centroid = weights @ points / weights.sum(-1, keepdim=True).clamp(min=1)
    order = torch.arange(len(points), device=points.device)
    is_round = (members[:, 0] & members[:, -1])[:, None]
    order = torch.where(is_round, (order + len(points) // 2) % len(points), order)  # (S, P)
    first = torch.where(members, order, len(points)).argmin(-1)
    last = torch.where(members, order, -1).argmax(-1)
    return torch.stack([centroid, points[first], points[last]], dim=1)


def _shifts(carried: Tensor, groups: Tensor, target: Surface, landing: Tensor, dt: float) -> Tensor:
    """(S, A, 2) translations of every group after the background's motion; NaN where none could move so far."""
    marks, goals = _landmarks(carried, groups), _landmarks(target.points, landing)
    shift = (goals[None] - marks[:, None]).flatten(1, 2)  # (S, 3T, 2)
    shift = torch.cat([torch.zeros_like(marks[:, :1]), shift], dim=1)
    reach = (torch.linalg.vector_norm(marks[:, :1], dim=-1) * FARTHEST).clamp(max=FASTEST * dt)
    return shift.masked_fill((torch.linalg.vector_norm(shift, dim=-1) > reach)[..., None], torch.nan)


def _pick(groups: Tensor, most: int) -> tuple[Tensor, Tensor]:
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
    index, is_member = _pick(groups, SCREEN_POINTS)
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


def _settle(motions: Tensor, members: Tensor, source: Surface, target: Surface, background: Tensor) -> Hypotheses:
    """Registers every start; few points say little of a turn."""
    index, is_member = _pick(members, REGISTER_POINTS)
    points, weights = source.points[index], is_member.to(source.points)
    unit = float(unit_length(source, target))
    gates, along = [unit * gate for gate in (4.0, 3.0, 2.0, 2.0, 1.5, 1.5)], [1.0, 1.0, 0.5, 0.5, 0.2, 0.2]
    motions = register(points, weights, target, motions, gates, along)
    return Hypotheses(_steady(motions, points, weights, background, unit_length(source, target)), members)


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


@dataclass(frozen=True, slots=True)
class _Landing:
    """Where every hypothesis carries its members: index (H, L) of these, is_member (H, L), and how they lie in the target.

    Attributes:
        moved: (H, L, 2).
        units: (H, L) truncated residual. nearest: (H, L) target point.
        target_units: (H, M) residual of every target point to the nearest member, not truncated.
    """

    index: Tensor
    is_member: Tensor
    moved: Tensor
    units: Tensor
    nearest: Tensor
    target_units: Tensor

    @classmethod
    def of(cls, hypotheses: Hypotheses, source: Surface, target: Surface) -> _Landing:
        index, is_member = _pick(hypotheses.members, FEATURE_POINTS)
        moved = se2.apply(hypotheses.motions, source.points[index])
        distance = torch.cdist(moved.flatten(0, 1), target.points, compute_mode="donot_use_mm_for_euclid_dist")
        distance = distance.view(*index.shape, -1)  # (H, L, M)
        least, nearest = distance.min(-1)
        unit = point_units(target)
        back = distance.masked_fill_(~is_member[..., None], torch.inf).amin(1)
        return cls(index, is_member, moved, (least / unit[nearest]).clamp(max=TRUNCATION), nearest, back / unit)

    def mean(self, values: Tensor) -> Tensor:
        """(H,) mean over the members. values: (H, L)."""
        return (values.to(self.units) * self.is_member).sum(-1) / self.is_member.sum(-1)


def hypothesis_features(hypotheses: Hypotheses, source: Surface, target: Surface, background: Tensor) -> Tensor:
    """(H, F) what tells a mover's motion from a wrong one, in the order of `FEATURES`; shares, logarithms and local units only.

    Gains are over the background (3,); `before` and `open` mean under the background.
    """
    if not len(hypotheses):
        return background.new_zeros(0, len(FEATURES))
    leftover = Leftover.of(source, target, background)
    landing = _Landing.of(hypotheses, source, target)
    columns = _shape_features(hypotheses, landing, source)
    columns |= _source_features(hypotheses, landing, leftover, target)
    columns |= _target_features(landing, leftover, source, target)
    columns |= _motion_features(hypotheses, landing, source, background)
    columns |= _rival_features(hypotheses, columns)
    columns |= _scene_features(hypotheses, leftover)
    return torch.stack([columns[name] for name in FEATURES], dim=-1)


def _extent(landing: _Landing, source: Surface) -> tuple[Tensor, Tensor]:
    """(H,) standard deviations of the members along and across their main direction, metres."""
    points = source.points[landing.index]
    centred = points - torch.stack([landing.mean(points[..., 0]), landing.mean(points[..., 1])], dim=-1)[:, None]
    xx, yy = landing.mean(centred[..., 0] ** 2), landing.mean(centred[..., 1] ** 2)
    xy = landing.mean(centred[..., 0] * centred[..., 1])
    spread = (((xx - yy) / 2) ** 2 + xy**2).sqrt()
    middle = (xx + yy) / 2
    return (middle + spread).clamp(min=0).sqrt(), (middle - spread).clamp(min=0).sqrt()


def _shape_features(hypotheses: Hypotheses, landing: _Landing, source: Surface) -> dict[str, Tensor]:
    size = hypotheses.members.sum(-1).to(source.points)
    segment_size = torch.bincount(source.segment).to(size)[source.segment]
    whole = (hypotheses.members * segment_size).sum(-1) / size
    long, across = _extent(landing, source)
    unit = landing.mean(point_units(source)[landing.index])
    return {
        "size": size.log(),
        "share_of_segment": (size / whole).clamp(max=1.0),
        "extent": (long / unit).log1p(),
        "linearity": 1 - across / long.clamp(min=1e-6),
        "range": (landing.mean(source.ranges[landing.index]) / source.ranges.median()).log(),
    }


def _source_features(hypotheses: Hypotheses, landing: _Landing, leftover: Leftover, target: Surface) -> dict[str, Tensor]:
    sight = look_along(landing.moved, target)
    units = torch.where(sight.occluded, landing.units.clamp(max=OPEN), landing.units)
    before = leftover.source[landing.index]
    gain = landing.mean(before - units)
    size = hypotheses.members.sum(-1)
    return {
        "residual": landing.mean(units),
        "gain": gain,
        "total_gain": (gain.clamp(min=0) * size).log1p(),
        "explained": landing.mean(units < EXPLAINED),
        "open_before": landing.mean(before >= OPEN),
        "occluded_before": landing.mean(leftover.source_sight.occluded[landing.index]),
        "seen_through_before": landing.mean(leftover.source_sight.seen_through[landing.index]),
        "seen_through": landing.mean(sight.seen_through),
        "occluded": landing.mean(sight.occluded),
        "distinct": ((landing.target_units < OPEN).sum(-1) / size).log1p(),
        "landing_open": landing.mean(leftover.target[landing.nearest] >= OPEN),
        "landing_seen_through_before": landing.mean(leftover.target_sight.seen_through[landing.nearest]),
    }


def _target_features(landing: _Landing, leftover: Leftover, source: Surface, target: Surface) -> dict[str, Tensor]:
    is_open = leftover.target >= OPEN
    reach = REACH + _extent(landing, source)[0][:, None] / point_units(target)  # (H, M) units
    is_near = is_open & (landing.target_units < reach)
    count = is_near.sum(-1)
    units = landing.target_units.clamp(max=TRUNCATION)
    gain = ((leftover.target - units) * is_near).sum(-1)
    landed = torch.zeros(len(count), int(target.segment.max()) + 1, dtype=torch.bool, device=count.device)
    landed.scatter_(1, target.segment[landing.nearest], True)
    there = landed[:, target.segment] & is_open  # (H, M) unexplained points of the segments that the members land on
    return {
        "target_open": count.to(gain).log1p(),
        "target_residual": (units * is_near).sum(-1) / count.clamp(min=1),
        "target_gain": gain / count.clamp(min=1),
        "target_total_gain": gain.clamp(min=0).log1p(),
        "target_cover": (there & (units < OPEN)).sum(-1) / there.sum(-1).clamp(min=1),
    }


def _motion_features(hypotheses: Hypotheses, landing: _Landing, source: Surface, background: Tensor) -> dict[str, Tensor]:
    points = source.points[landing.index]
    step = landing.moved - se2.apply(background, points)  # (H, L, 2)
    shift = torch.stack([landing.mean(step[..., 0]), landing.mean(step[..., 1])], dim=-1)
    length = torch.linalg.vector_norm(shift, dim=-1).clamp(min=1e-6)
    tangent = se2.rotate(background[0], source.tangent[landing.index])
    ranges = landing.mean(source.ranges[landing.index])
    return {
        "displacement": (length / landing.mean(point_units(source)[landing.index])).log1p(),
        "displacement_in_spacings": (length / (ranges * source.step)).log1p(),
        "displacement_in_range": length / ranges,
        "displacement_in_extent": (length / _extent(landing, source)[0].clamp(min=1e-6)).log1p(),
        "along_surface": landing.mean((tangent * shift[:, None]).sum(-1).abs()) / length,
        "rotation": (se2.wrap(hypotheses.motions[:, 0] - background[0]).abs() / USUAL_TURN).log1p(),
    }


def _rival_features(hypotheses: Hypotheses, columns: dict[str, Tensor]) -> dict[str, Tensor]:
    """How much worse a hypothesis is than the best that moves nearly the same points."""
    is_rival = _share_in_common(hypotheses.members) > 0.7

    def short_of_best(values: Tensor) -> Tensor:
        return values - torch.where(is_rival, values, -torch.inf).amax(-1)

    return {
        "gain_both_ways": (columns["total_gain"].expm1() + columns["target_total_gain"].expm1()).log1p(),
        "residual_to_best": -short_of_best(-columns["residual"]),
        "total_gain_to_best": short_of_best(columns["total_gain"]),
        "target_total_gain_to_best": short_of_best(columns["target_total_gain"]),
    }


def _scene_features(hypotheses: Hypotheses, leftover: Leftover) -> dict[str, Tensor]:
    """How well the background fits the beams beside the members, and the rest of the scan."""
    members = hypotheses.members.to(leftover.source)
    wide = nn.functional.max_pool1d(members[None], 2 * AROUND + 1, 1, AROUND)[0]
    beside, rest = wide - members, 1 - members
    is_open = (leftover.source >= OPEN).to(members)
    return {
        "units_around": (beside @ leftover.source + 2) / (beside.sum(-1) + 3),  # as if 3 more points had 2 units in all
        "scene_open": rest @ is_open / rest.sum(-1).clamp(min=1),
    }


class HypothesisScore(nn.Module):
    """Probability that a hypothesis is a mover's motion: logistic in the standardised features and their squares.

    It starts with weights fitted on simulated streets, model cars and rooms; `learning.hypothesis_fit` fits others.

    Attributes:
        mean, scale: (F,). weight: (2F,) of the standardised features, then of their squares. bias: ().
        threshold: () probability from which a hypothesis is accepted.
    """

    mean: Tensor
    scale: Tensor
    weight: Tensor
    bias: Tensor
    threshold: Tensor

    def __init__(self) -> None:
        super().__init__()
        mean, scale, weight, of_square = torch.tensor(list(STREETS_AND_ROOMS.values())).unbind(-1)
        self.register_buffer("mean", mean.clone())
        self.register_buffer("scale", scale.clone())
        self.register_buffer("weight", torch.cat([weight, of_square]))
        self.register_buffer("bias", torch.tensor(BIAS))
        self.register_buffer("threshold", torch.tensor(THRESHOLD))

    def terms(self, features: Tensor) -> Tensor:
        """(..., F) features of `hypothesis_features` -> (..., 2F) the terms that the weights belong to."""
        standard = ((features - self.mean) / self.scale).clamp(-LARGEST, LARGEST)
        return torch.cat([standard, standard**2], dim=-1)

    def forward(self, features: Tensor) -> Tensor:
        """(..., F) features of `hypothesis_features` -> (...) probabilities."""
        return (self.terms(features) @ self.weight + self.bias).sigmoid()


@dataclass(frozen=True, slots=True)
class Movers:
    """G accepted movers, the surest first.

    Attributes:
        motions: (G, 3) `T_target_source`.
        probabilities: (G,).
        members: (G, P) bool, the source segment that each was found by.
    """

    motions: Tensor
    probabilities: Tensor
    members: Tensor


def select(
    hypotheses: Hypotheses, probabilities: Tensor, source: Surface, target: Surface, *, threshold: float, most: int
) -> Movers:
    """Accepts the surest hypothesis, drops what competes with it, and so on: non-maximum suppression.

    Two compete when they move the same points, explain the same points of the second scan, or when the accepted motion explains
    the other's points as well.

    Args:
        probabilities: (H,).
        threshold: least probability. most: movers at most.
    """
    likely = (probabilities >= threshold).nonzero()[:, 0]
    likely = likely[probabilities[likely].argsort(descending=True)]
    if not len(likely) or not most:
        return Movers(hypotheses.motions[:0], probabilities[:0], hypotheses.members[:0])
    pool = Hypotheses(hypotheses.motions[likely], hypotheses.members[likely])
    rivals = _rivals(pool, source, target)
    accepted: list[int] = []
    for row, beside in enumerate(rivals.tolist()):
        if len(accepted) < most and not any(beside[k] for k in accepted):
            accepted.append(row)
    chosen = likely[accepted]
    return Movers(hypotheses.motions[chosen], probabilities[chosen], hypotheses.members[chosen])


def _rivals(pool: Hypotheses, source: Surface, target: Surface) -> Tensor:
    """(H, H) bool: hypothesis h competes with g, once g is accepted."""
    landing = _Landing.of(pool, source, target)
    same_points = _share_in_common(pool.members) > SHARED
    same_goal = _share_in_common(landing.target_units < EXPLAINED) > SHARED
    by_other = residual_units(se2.apply(pool.motions[:, None], source.points[landing.index]), target)  # (g, h, L)
    count = landing.is_member.sum(-1)
    by_other = (by_other * landing.is_member).sum(-1) / count
    return same_points | same_goal | (by_other.T - landing.mean(landing.units)[:, None] < AS_WELL)


def _share_in_common(sets: Tensor) -> Tensor:
    """(H, H) size of the intersections as a share of the smaller set. sets: (H, P) bool."""
    counted = sets.float()
    size = counted.sum(-1).clamp(min=1)
    return counted @ counted.T / torch.minimum(size[:, None], size)


def find_movers(
    source: Surface, target: Surface, background: Tensor, dt: float, score: HypothesisScore, *, most: int = 6
) -> Movers:
    """The moving objects that the background motion (3,) leaves to be explained; dt: seconds between the scans."""
    hypotheses = hypothesise(source, target, background, dt)
    probabilities = score(hypothesis_features(hypotheses, source, target, background))
    return select(hypotheses, probabilities, source, target, threshold=float(score.threshold), most=most)
