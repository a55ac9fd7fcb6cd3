"""Features that separate right from wrong motions of movers, one hypothesis at a time."""

from __future__ import annotations

import math

import numpy as np

from torchcrf_scan.loops.jit import Array, Integers, entry, kernel
from torchcrf_scan.loops.median import lower_median
from torchcrf_scan.loops.rigid import rotate_back, transform_of, wrap
from torchcrf_scan.search.feature_points import (
    AT,
    PIECE_SIZE,
    RANGE,
    RESIDUAL,
    SEGMENT_SIZE,
    SIGHT,
    TANGENT_X,
    TANGENT_Y,
    UNIT,
    Points,
    points_of,
    stands_out,
)
from torchcrf_scan.search.groups import ends
from torchcrf_scan.search.hypotheses import USUAL_TURN, Hypotheses
from torchcrf_scan.search.landing import EXPLAINED, Sample, empty_sample, land, take_members
from torchcrf_scan.search.leftover import OPEN, Leftover
from torchcrf_scan.search.score import FEATURES
from torchcrf_scan.search.surface import OCCLUDED, SEEN_THROUGH, UNMEASURED
from torchcrf_scan.search.target_features import target_features, target_scan_of

AROUND = 15  # beams
RIVALS = 0.7  # share of common points above which two hypotheses are rivals
USUAL_UNITS, USUAL_COUNT = 2.0, 3.0  # units in all, and number of points, added to those around: a prior against few points


@entry
def hypothesis_features(leftover: Leftover, hypotheses: Hypotheses) -> Array:
    """(H, F) features of the hypotheses, in the order of `FEATURES`: shares, logarithms and local units only."""
    (start, index), motions, group = hypotheses.groups, hypotheses.motions, hypotheses.group
    surface, landing, carried, background = leftover.source.grid.scan, leftover.target.grid, leftover.carried, leftover.background
    features = np.empty((len(motions), len(FEATURES)))
    source = points_of(leftover.source, np.ones(len(carried), np.bool_))
    target = points_of(leftover.target, leftover.target.residual >= OPEN)
    summed, usual_range = _sums(leftover.source.residual), lower_median(surface.ranges)
    open_points = (leftover.source.residual >= OPEN).sum()
    sample, around = empty_sample(), target_scan_of(target, landing.scan.boxes.small)
    L, long = 0, 0.0
    for h in range(len(features)):
        s, row = group[h], features[h]
        size = start[s + 1] - start[s]
        if h == 0 or s != group[h - 1]:
            members = index[start[s] : start[s + 1]]
            L = take_members(members, sample.member)
            long = _group_features(source, members, sample.member[:L], usual_range, row)
            _scene_features(source.values, summed, open_points, members, row)
        else:
            row[:] = features[h - 1]
        land(surface.points, landing, leftover.target.units, motions[h], sample, L)
        _source_features(source, target, sample, L, size, row)
        _motion_features(source.values, surface.step, carried, background, motions[h], sample, L, long, row)
        target_features(around, sample, L, size, long, h, row)
    _rival_features(hypotheses, features)
    return features


@kernel
def _sums(residual: Array) -> Array:
    """(P + 1,) running sums of residuals (P,), beginning with 0."""
    summed = np.zeros(len(residual) + 1)
    for i in range(len(residual)):
        summed[i + 1] = summed[i] + residual[i]
    return summed


# --- features of the members alone --------------------------------------------------------------------------------------------


@kernel
def _group_features(source: Points, members: Integers, index: Integers, usual_range: float, row: Array) -> float:
    """Writes the features common to all hypotheses of a set to `row`; returns its extent, metres. index: (L,) of the sample."""
    values, labels, is_closed = source
    size, L = len(members), len(index)
    long, across = _extent(values, index)
    unit = ranges = 0.0
    open_before = occluded = seen_through = unexcused = 0
    for i in index:
        unit += values[i, UNIT] / L
        ranges += values[i, RANGE] / L
        is_open, sight = values[i, RESIDUAL] >= OPEN, labels[i, SIGHT]
        open_before += is_open
        occluded += sight == OCCLUDED
        seen_through += sight == SEEN_THROUGH
        unexcused += is_open and sight != OCCLUDED and sight != UNMEASURED
    in_segments = in_pieces = 0.0
    for i in members:
        in_segments += values[i, SEGMENT_SIZE]
        in_pieces += values[i, PIECE_SIZE]
    first, last = ends(members, len(values))
    row[AT.size] = math.log(size)
    row[AT.share_of_segment] = min(size * size / in_segments, 1.0)
    row[AT.share_of_piece] = min(size * size / in_pieces, 1.0)
    row[AT.extent] = math.log1p(long / unit)
    row[AT.linearity] = 1 - across / max(long, 1e-6)
    row[AT.range] = math.log(ranges / usual_range)
    row[AT.open_before] = open_before / L
    row[AT.occluded_before] = occluded / L
    row[AT.seen_through_before] = seen_through / L
    row[AT.unexcused] = unexcused / L
    row[AT.stands_out] = stands_out(values, is_closed, first, last)
    return long


@kernel
def _extent(points: Array, index: Integers) -> tuple[float, float]:
    """Standard deviations of the points (L,) along and across their main direction, metres."""
    L = len(index)
    x = y = xx = yy = xy = 0.0
    for i in index:
        x, y = x + points[i, 0] / L, y + points[i, 1] / L
    for i in index:
        dx, dy = points[i, 0] - x, points[i, 1] - y
        xx, yy, xy = xx + dx * dx / L, yy + dy * dy / L, xy + dx * dy / L
    spread, middle = math.sqrt(((xx - yy) / 2) ** 2 + xy**2), (xx + yy) / 2
    return math.sqrt(max(middle + spread, 0.0)), math.sqrt(max(middle - spread, 0.0))


@kernel
def _scene_features(source: Array, summed: Array, open_points: int, members: Integers, row: Array) -> None:
    """Writes the background's residual on the neighbouring beams, and its open share of the rest. source: (P, 9)."""
    P, size = len(source), len(members)
    total = inside = 0.0
    upto = wide = open_members = 0
    for i in members:
        low, high = max(i - AROUND, upto), min(i + AROUND + 1, P)
        if high > low:
            total, wide, upto = total + summed[high] - summed[low], wide + high - low, high
        inside += source[i, RESIDUAL]
        open_members += source[i, RESIDUAL] >= OPEN
    row[AT.units_around] = (total - inside + USUAL_UNITS) / (wide - size + USUAL_COUNT)
    row[AT.scene_open] = (open_points - open_members) / max(P - size, 1)


# --- features of a motion --------------------------------------------------------------------------------------------------------


@kernel
def _source_features(source: Points, target: Points, sample: Sample, L: int, size: int, row: Array) -> None:
    """Writes the residuals and gains of the members, and shares of the points on which they land. size: of the group."""
    residual = gain = fair = 0.0
    explained = seen_through = occluded = 0
    landing_open = landing_through = landing_occluded = landing_unexcused = 0
    for k in range(L):
        i, j, sight = sample.member[k], sample.nearest[k], sample.sight[k]
        before, units = source.values[i, RESIDUAL], sample.units[k]
        is_excused = source.labels[i, SIGHT] == OCCLUDED or source.labels[i, SIGHT] == UNMEASURED
        fair += (min(before, EXPLAINED) if is_excused else before) - units
        if sight == OCCLUDED:
            units = min(units, OPEN)
            occluded += 1
        if sight == SEEN_THROUGH:
            seen_through += 1
        residual, gain = residual + units, gain + before - units
        if units < EXPLAINED:
            explained += 1
        is_open, there = target.values[j, RESIDUAL] >= OPEN, target.labels[j, SIGHT]
        landing_open += is_open
        landing_through += there == SEEN_THROUGH
        landing_occluded += there == OCCLUDED
        landing_unexcused += is_open and there != OCCLUDED and there != UNMEASURED
    row[AT.residual] = residual / L
    row[AT.gain] = gain / L
    row[AT.total_gain] = math.log1p(max(gain / L, 0.0) * size)
    row[AT.explained] = explained / L
    row[AT.seen_through] = seen_through / L
    row[AT.occluded] = occluded / L
    row[AT.landing_open] = landing_open / L
    row[AT.landing_seen_through_before] = landing_through / L
    row[AT.landing_occluded_before] = landing_occluded / L
    row[AT.landing_unexcused] = landing_unexcused / L
    row[AT.unexcused_both] = math.sqrt(row[AT.unexcused] * row[AT.landing_unexcused])
    row[AT.fair_gain] = math.log1p(max(fair / L * size, 0.0))


@kernel
def _motion_features(
    source: Array, step: float, carried: Array, background: Array, motion: Array, sample: Sample, L: int, long: float, row: Array
) -> None:
    """Writes the motion's displacement and rotation relative to the background's.

    Args:
        source: (P, 9). step: radians. carried: (P, 2) points under the background's motion (3,). motion: (3,).
        long: metres, extent of the members.
    """
    x = y = ranges = unit = 0.0
    for k in range(L):
        i = sample.member[k]
        x, y = x + (sample.moved[0, k] - carried[i, 0]) / L, y + (sample.moved[1, k] - carried[i, 1]) / L
        ranges, unit = ranges + source[i, RANGE] / L, unit + source[i, UNIT] / L
    length = max(math.sqrt(x * x + y * y), 1e-6)
    back_x, back_y = rotate_back(transform_of(background), x, y)  # rotates the shift back, instead of every tangent ahead
    along = 0.0
    for k in range(L):
        i = sample.member[k]
        along += abs(source[i, TANGENT_X] * back_x + source[i, TANGENT_Y] * back_y)
    row[AT.displacement] = math.log1p(length / unit)
    row[AT.displacement_in_spacings] = math.log1p(length / (ranges * step))
    row[AT.displacement_in_range] = length / ranges
    row[AT.displacement_in_extent] = math.log1p(length / max(long, 1e-6))
    row[AT.along_surface] = along / L / length
    row[AT.rotation] = math.log1p(abs(wrap(motion[0] - background[0])) / USUAL_TURN)


# --- comparison with rivals ------------------------------------------------------------------------------------------------------


@kernel
def _rival_features(hypotheses: Hypotheses, features: Array) -> None:
    """Writes the deficit of every hypothesis to the best one that moves nearly the same points. features: (H, F)."""
    start, index = hypotheses.groups
    S = len(start) - 1
    best = np.full((S, 3), -np.inf)  # of every group
    for h in range(len(features)):
        row, of_group = features[h], best[hypotheses.group[h]]
        of_group[0] = max(of_group[0], -row[AT.residual])
        of_group[1] = max(of_group[1], row[AT.total_gain])
        of_group[2] = max(of_group[2], row[AT.target_total_gain])
    of_rivals = best.copy()
    for s in range(S):
        for r in range(s):
            if share_in_common(index[start[s] : start[s + 1]], index[start[r] : start[r + 1]]) > RIVALS:
                for k in range(3):
                    of_rivals[s, k] = max(of_rivals[s, k], best[r, k])
                    of_rivals[r, k] = max(of_rivals[r, k], best[s, k])
    for h in range(len(features)):
        row, of_group = features[h], of_rivals[hypotheses.group[h]]
        row[AT.gain_both_ways] = math.log1p(math.expm1(row[AT.total_gain]) + math.expm1(row[AT.target_total_gain]))
        row[AT.residual_to_best] = row[AT.residual] + of_group[0]
        row[AT.total_gain_to_best] = row[AT.total_gain] - of_group[1]
        row[AT.target_total_gain_to_best] = row[AT.target_total_gain] - of_group[2]


@kernel
def share_in_common(one: Integers, other: Integers) -> float:
    """Size of the intersection as a share of the smaller set, 0 where one is empty. one, other: ascending."""
    smaller = min(len(one), len(other))
    if smaller == 0 or one[0] > other[-1] or other[0] > one[-1]:
        return 0.0
    i = j = count = 0
    while i < len(one) and j < len(other):
        if one[i] == other[j]:
            i, j, count = i + 1, j + 1, count + 1
        elif one[i] < other[j]:
            i += 1
        else:
            j += 1
    return count / smaller
