"""What tells a mover's motion from a wrong one: shares, logarithms and local units only, so one score serves any scanner."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn

from torchcrf_scan.geometry import se2
from torchcrf_scan.inference.hypotheses import (
    OPEN,
    TRUNCATION,
    USUAL_TURN,
    Hypotheses,
    Leftover,
    ends,
    pick_members,
    pieces,
    point_units,
)
from torchcrf_scan.inference.surface import Surface, look_along

EXPLAINED = 1.0  # units up to which it is explained well
FEATURE_POINTS = 24
REACH = 6.0  # units, and the extent: how far from the members unexplained points of the target are asked for
AROUND = 15  # beams
RIVALS = 0.7  # share of points in common from which two hypotheses move nearly the same
USUAL_UNITS, USUAL_COUNT = 2.0, 3.0  # units in all, and of how many points, that are added to those around: few say little
JUMP = 4.0  # units of range that the beams beside an object go on, when it surely stands before them

FEATURES = (
    "size",
    "share_of_segment",
    "extent",
    "linearity",
    "range",
    "residual",
    "gain",
    "total_gain",
    "explained",
    "open_before",
    "occluded_before",
    "seen_through_before",
    "seen_through",
    "occluded",
    "distinct",
    "landing_open",
    "landing_seen_through_before",
    "target_open",
    "target_residual",
    "target_gain",
    "target_total_gain",
    "target_cover",
    "displacement",
    "displacement_in_spacings",
    "displacement_in_range",
    "displacement_in_extent",
    "along_surface",
    "rotation",
    "gain_both_ways",
    "residual_to_best",
    "total_gain_to_best",
    "target_total_gain_to_best",
    "units_around",
    "scene_open",
    "unexcused",
    "landing_unexcused",
    "unexcused_both",
    "landing_occluded_before",
    "fair_gain",
    "share_of_piece",
    "landing_piece_cover",
    "stands_out",
    "landing_stands_out",
)


@dataclass(frozen=True, slots=True)
class Landing:
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
    def of(cls, hypotheses: Hypotheses, source: Surface, target: Surface) -> Landing:
        """Carries the members over and looks for the nearest points both ways."""
        index, is_member = pick_members(hypotheses.members, FEATURE_POINTS)
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
    landing = Landing.of(hypotheses, source, target)
    columns = _shape_features(hypotheses, landing, source)
    columns |= _source_features(hypotheses, landing, leftover, target)
    columns |= _target_features(landing, leftover, source, target)
    columns |= _motion_features(hypotheses, landing, source, background)
    columns |= _rival_features(hypotheses, columns)
    columns |= _scene_features(hypotheses, leftover)
    columns |= _excuse_features(hypotheses, landing, leftover)
    columns |= _piece_features(hypotheses, landing, source, target)
    return torch.stack([columns[name] for name in FEATURES], dim=-1)


def _extent(landing: Landing, source: Surface) -> tuple[Tensor, Tensor]:
    """(H,) standard deviations of the members along and across their main direction, metres."""
    points = source.points[landing.index]
    centred = points - torch.stack([landing.mean(points[..., 0]), landing.mean(points[..., 1])], dim=-1)[:, None]
    xx, yy = landing.mean(centred[..., 0] ** 2), landing.mean(centred[..., 1] ** 2)
    xy = landing.mean(centred[..., 0] * centred[..., 1])
    spread = (((xx - yy) / 2) ** 2 + xy**2).sqrt()
    middle = (xx + yy) / 2
    return (middle + spread).clamp(min=0).sqrt(), (middle - spread).clamp(min=0).sqrt()


def _shape_features(hypotheses: Hypotheses, landing: Landing, source: Surface) -> dict[str, Tensor]:
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


def _source_features(hypotheses: Hypotheses, landing: Landing, leftover: Leftover, target: Surface) -> dict[str, Tensor]:
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


def _target_features(landing: Landing, leftover: Leftover, source: Surface, target: Surface) -> dict[str, Tensor]:
    is_open = leftover.target >= OPEN
    reach = REACH + _extent(landing, source)[0][:, None] / point_units(target)  # (H, M) units
    is_near = is_open & (landing.target_units < reach)
    count = is_near.sum(-1)
    units = landing.target_units.clamp(max=TRUNCATION)
    gain = ((leftover.target - units) * is_near).sum(-1)
    landed = torch.zeros_like(is_near).scatter_(1, landing.nearest, True)
    there = _spread_over(landed, target.segment) & is_open  # (H, M) unexplained points of the segments that the members land on
    return {
        "target_open": count.to(gain).log1p(),
        "target_residual": (units * is_near).sum(-1) / count.clamp(min=1),
        "target_gain": gain / count.clamp(min=1),
        "target_total_gain": gain.clamp(min=0).log1p(),
        "target_cover": (there & (units < OPEN)).sum(-1) / there.sum(-1).clamp(min=1),
    }


def _motion_features(hypotheses: Hypotheses, landing: Landing, source: Surface, background: Tensor) -> dict[str, Tensor]:
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
    is_rival = share_in_common(hypotheses.members) > RIVALS

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
        "units_around": (beside @ leftover.source + USUAL_UNITS) / (beside.sum(-1) + USUAL_COUNT),
        "scene_open": rest @ is_open / rest.sum(-1).clamp(min=1),
    }


def _excuse_features(hypotheses: Hypotheses, landing: Landing, leftover: Leftover) -> dict[str, Tensor]:
    """How much is left unexplained although the other scan looks there: what is out of its sight needs no mover."""
    before = leftover.source[landing.index]
    excused = (leftover.source_sight.occluded | leftover.source_sight.unmeasured)[landing.index]
    landing_excused = (leftover.target_sight.occluded | leftover.target_sight.unmeasured)[landing.nearest]
    unexcused = landing.mean((before >= OPEN) & ~excused)
    landing_unexcused = landing.mean((leftover.target[landing.nearest] >= OPEN) & ~landing_excused)
    gain = landing.mean(torch.where(excused, before.clamp(max=EXPLAINED), before) - landing.units)
    return {
        "unexcused": unexcused,
        "landing_unexcused": landing_unexcused,
        "unexcused_both": (unexcused * landing_unexcused).sqrt(),
        "landing_occluded_before": landing.mean(leftover.target_sight.occluded[landing.nearest]),
        "fair_gain": (gain * hypotheses.members.sum(-1)).clamp(min=0).log1p(),
    }


def _piece_features(hypotheses: Hypotheses, landing: Landing, source: Surface, target: Surface) -> dict[str, Tensor]:
    """Whether the members, and what they land on, are whole pieces of surface that stand before what surrounds them."""
    size = hypotheses.members.sum(-1)
    piece, target_piece = pieces(source), pieces(target)
    whole = (hypotheses.members * torch.bincount(piece)[piece]).sum(-1) / size
    landed = torch.zeros_like(landing.target_units, dtype=torch.bool).scatter_(1, landing.nearest, True)
    is_covered = landing.target_units < OPEN
    there = _spread_over(landed, target_piece)
    return {
        "share_of_piece": (size / whole).clamp(max=1.0),
        "landing_piece_cover": (there & is_covered).sum(-1) / there.sum(-1),
        "stands_out": _stands_out(source, hypotheses.members),
        "landing_stands_out": _stands_out(target, landed | is_covered),
    }


def _spread_over(sets: Tensor, number: Tensor) -> Tensor:
    """(H, P) bool: all points of the segments that a point of the set is on. sets: (H, P) bool; number: (P,) of the segments."""
    touched = torch.zeros(len(sets), int(number.max()) + 1, dtype=torch.int64, device=sets.device)
    return touched.scatter_add_(1, number.expand(len(sets), -1), sets.long())[:, number] > 0


def _stands_out(surface: Surface, members: Tensor) -> Tensor:
    """(H,) -1 to 1: whether the returns beside both ends of the members lie behind them, or before. members: (H, P) bool."""
    first, last = ends(members)
    unit = JUMP * point_units(surface)
    sides = []
    for end, beside in ((first, first - 1), (last, last + 1)):
        is_inside = (beside >= 0) & (beside < len(surface)) | surface.is_closed
        jump = (surface.ranges[beside % len(surface)] - surface.ranges[end]) / unit[end]
        sides.append(jump.clamp(-1, 1) * is_inside)
    return torch.stack(sides).mean(0)


def share_in_common(sets: Tensor) -> Tensor:
    """(H, H) size of the intersections as a share of the smaller set. sets: (H, P) bool."""
    counted = sets.float()
    size = counted.sum(-1).clamp(min=1)
    return counted @ counted.T / torch.minimum(size[:, None], size)
