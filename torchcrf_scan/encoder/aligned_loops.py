"""Input channels of the encoder as loops, one scan at a time; same as `encoder.aligned` without batches."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from torch import Tensor

from torchcrf_scan.encoder.channels import BESIDE, CHANNELS, FARTHEST, LARGEST_TURN, LONGEST_CHORD, NEAR, NOWHERE, PROFILE, WINDOW
from torchcrf_scan.fast.free_space import Sweep, beam_after, look, sweep_of
from torchcrf_scan.loops.circle import turn_between
from torchcrf_scan.loops.jit import Array, entry, kernel
from torchcrf_scan.loops.median import lower_median
from torchcrf_scan.loops.pair import Pair, PairStart, padded
from torchcrf_scan.loops.rigid import inverse, transform, transform_of
from torchcrf_scan.loops.threads import for_each

WIDTH = len(CHANNELS)
OWN, CROSS = len(BESIDE) + 4, 2 * PROFILE + 4


@kernel
def along_scan(sweep: Sweep, place: int) -> int:
    """The point at an index along a scan, wrapped round a closed one; -1 if there is none."""
    count = len(sweep.ranges)
    if sweep.is_closed and count > 0:
        return place % count
    return place if 0 <= place < count else -1


@kernel
def fill_own(sweep: Sweep, i: int, unit: float, usual: float, channels: Array) -> None:
    """Writes the channels of point i that its own scan determines. channels: (F,)."""
    f = 0
    for k in BESIDE:
        beside = along_scan(sweep, i + k)
        channels[f] = math.asinh((sweep.ranges[beside] - sweep.ranges[i]) / unit) / 2 if beside >= 0 else NOWHERE
        f += 1
    for k in (-1, 1):
        beside, turn = along_scan(sweep, i + k), LARGEST_TURN
        if beside >= 0:
            low, high = (beside, i) if k < 0 else (i, beside)
            turn = min(max(turn_between(sweep.bearings[low], sweep.bearings[high]) / sweep.step - 1, 0.0), LARGEST_TURN)
        channels[f] = math.log1p(turn)
        f += 1
    channels[f] = min(math.log(unit / max(sweep.noise, 1e-9)), 8.0) / 2 - 1
    channels[f + 1] = min(max(math.log(max(sweep.ranges[i], 1e-9) / max(usual, 1e-9)), -3.0), 3.0)


@kernel
def nearest_about(sweep: Sweep, points: Array, x: float, y: float, after: int, unit: float) -> float:
    """Units to the nearest point among the beams about a place. points: (Q, 2) of that scan."""
    nearest = FARTHEST
    for k in range(-WINDOW, WINDOW):
        j = along_scan(sweep, after + k)
        if j >= 0:
            dx, dy = points[j, 0] - x, points[j, 1] - y
            nearest = min(nearest, math.sqrt(dx * dx + dy * dy) / unit)
    return nearest


@kernel
def surface_about(sweep: Sweep, points: Array, x: float, y: float, after: int, unit: float) -> float:
    """Units to the nearest chord between neighbouring points about a place."""
    nearest = FARTHEST
    for k in range(-WINDOW, WINDOW - 1):
        i, j = along_scan(sweep, after + k), along_scan(sweep, after + k + 1)
        if i < 0 or j < 0:
            continue
        ax, ay = points[i, 0] - x, points[i, 1] - y
        cx, cy = points[j, 0] - points[i, 0], points[j, 1] - points[i, 1]
        squared = cx * cx + cy * cy
        if not math.sqrt(squared) < LONGEST_CHORD * unit:
            continue
        share = min(max(-(ax * cx + ay * cy) / max(squared, 1e-12), 0.0), 1.0)
        gx, gy = ax + share * cx, ay + share * cy
        nearest = min(nearest, math.sqrt(gx * gx + gy * gy) / unit)
    return nearest


@kernel
def fill_cross(sweep: Sweep, points: Array, x: float, y: float, unit: float, channels: Array) -> float:
    """Writes the channels of a point in the other scan's frame; returns the units to the nearest point there. channels: (F,)."""
    dx, dy = x - sweep.origin[0], y - sweep.origin[1]
    bearing, after = beam_after(sweep, dx, dy)
    reach = math.sqrt(dx * dx + dy * dy)
    for k in range(-PROFILE, PROFILE):
        j = along_scan(sweep, after + k)
        channels[OWN + PROFILE + k] = math.asinh((sweep.ranges[j] - reach) / unit) / 2 if j >= 0 else NOWHERE
    left, right = along_scan(sweep, after - 1), along_scan(sweep, after)
    f = OWN + 2 * PROFILE
    before = turn_between(sweep.bearings[left], bearing) / sweep.step if left >= 0 else LARGEST_TURN
    behind = turn_between(bearing, sweep.bearings[right]) / sweep.step if right >= 0 else LARGEST_TURN
    nearest = nearest_about(sweep, points, x, y, after, unit)
    surface = min(surface_about(sweep, points, x, y, after, unit), nearest)
    channels[f], channels[f + 1] = math.log1p(min(before, LARGEST_TURN)), math.log1p(min(behind, LARGEST_TURN))
    channels[f + 2], channels[f + 3] = math.log1p(nearest), math.log1p(surface)
    return nearest


@kernel
def channels_of(
    points: Array, sweep: Sweep, other: Array, other_sweep: Sweep, motions: Array, log_odds: Array, reach: Array
) -> Array:
    """(P, F) the channels of one scan's points.

    points: (P, 2), other: (Q, 2). motions: (C, 3) into the other's frame. log_odds: (C,).
    reach: (P, C) of `Start`, or (0, C): by distance.
    """
    P, C = len(points), len(motions)
    channels = np.zeros((P, WIDTH))
    usual = lower_median(sweep.ranges.copy()) if P > 0 else 1.0
    transforms = [transform_of(motions[c]) for c in range(C)]
    for i in range(P):
        unit = max(sweep.noise + sweep.ranges[i] * sweep.step, 1e-9)
        fill_own(sweep, i, unit, usual, channels[i])
        background, best, sure = FARTHEST, FARTHEST, 0.0
        for c in range(C):
            is_there = log_odds[c] > -np.inf and (c == 0 or len(reach) == 0 or reach[i, c] <= 0)
            if c > 0 and not is_there:
                continue
            x, y = transform(transforms[c], points[i, 0], points[i, 1])
            if c == 0:
                background = fill_cross(other_sweep, other, x, y, unit, channels[i])
                channels[i, OWN + CROSS], channels[i, OWN + CROSS + 1] = look(other_sweep, x, y)
                continue
            after = beam_after(other_sweep, x - other_sweep.origin[0], y - other_sweep.origin[1])[1]
            distance = nearest_about(other_sweep, other, x, y, after, unit)
            if len(reach) > 0 or distance < NEAR:
                best = min(best, distance)
                sure = max(sure, math.exp(-distance / 2) / (1 + math.exp(-log_odds[c])))
        f = OWN + CROSS + 2
        channels[i, f], channels[i, f + 1] = math.log1p(best), sure
        channels[i, f + 2], channels[i, f + 3] = math.log1p(background) - math.log1p(best), 1.0
    return channels


@entry
def channels_of_side(pair: Pair, motions: Array, log_odds: Array, reach: Array, is_target: bool) -> Array:
    """(N, F) of the source, or (M, F) of the target. motions: (C, 3); log_odds: (C,); reach: (N, C)."""
    source = sweep_of(pair.source, pair.noise, pair.source_closed, np.zeros(2))
    target = sweep_of(pair.target, pair.noise, pair.target_closed, pair.target_origin)
    if is_target:
        back = np.empty_like(motions)
        for c in range(len(motions)):
            back[c] = inverse(motions[c])
        return channels_of(pair.target, target, pair.source, source, back, log_odds, reach[:0])
    return channels_of(pair.source, source, pair.target, target, motions, log_odds, reach)


def aligned_inputs_of_pairs(
    pairs: Sequence[Pair], starts: Sequence[PairStart], lengths: tuple[int, int], *, both: bool = True
) -> tuple[Tensor, ...]:
    """`encoder.aligned.aligned_inputs` of some pairs, in double precision, padded to the given numbers of points."""

    def channels_of_pair(b: int) -> list[Array]:
        pair, start = pairs[b], starts[b]
        log_odds = start.log_odds if len(start.log_odds) else np.where(start.active, np.inf, -np.inf)
        sides = (False, True) if both else (False,)
        return [channels_of_side(pair, start.motions, log_odds, start.reach, is_target) for is_target in sides]

    found = for_each(channels_of_pair, range(len(pairs)))
    return tuple(padded([of[k] for of in found], (lengths[k], WIDTH), 0.0) for k in range(1 + both))
