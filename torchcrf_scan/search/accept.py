"""Probabilities of hypothesised motions by the learned score, and the greedy choice among them."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from torchcrf_scan.loops.jit import Array, Integers, entry, kernel
from torchcrf_scan.loops.nearest import RUN, Boxes
from torchcrf_scan.loops.rigid import apply_to_some
from torchcrf_scan.search.grid import ScanGrid
from torchcrf_scan.search.hypotheses import Hypotheses
from torchcrf_scan.search.hypothesis_features import share_in_common
from torchcrf_scan.search.landing import (
    EXPLAINED,
    Sample,
    box_of,
    empty_sample,
    gap_squared,
    land,
    nearest_member,
    take_members,
)
from torchcrf_scan.search.leftover import Leftover, residual_at
from torchcrf_scan.search.score import FEATURES, LARGEST, PRODUCTS, HypothesisScore

AS_WELL = 0.5  # units of mean residual up to which a worse motion still explains the same points
APART = 4.0  # units, and half the extent; objects of one motion that are farther apart are two
SHARED = 0.4  # share of common points above which two hypotheses compete

ONE = np.array([FEATURES.index(one) for one, _ in PRODUCTS])
OTHER = np.array([FEATURES.index(other) for _, other in PRODUCTS])


class Score(NamedTuple):
    """The buffers of a `HypothesisScore`: (F,), (F,), (2F + R,) and two numbers."""

    mean: Array
    scale: Array
    weight: Array
    bias: float
    threshold: float


def score_of(module: HypothesisScore) -> Score:
    """The buffers of the module as arrays."""
    mean, scale, weight = (buffer.detach().cpu().double().numpy() for buffer in (module.mean, module.scale, module.weight))
    return Score(mean, scale, weight, float(module.bias), float(module.threshold))


@entry
def probabilities_of(score: Score, features: Array) -> Array:
    """(H,) probabilities that a hypothesis is a mover's motion. features: (H, F)."""
    F = len(score.mean)
    probabilities, standard = np.empty(len(features)), np.empty(F)
    for h in range(len(features)):
        total = score.bias
        for f in range(F):
            value = min(max((features[h, f] - score.mean[f]) / score.scale[f], -LARGEST), LARGEST)
            standard[f] = value
            total += score.weight[f] * value + score.weight[F + f] * value * value
        for r in range(len(ONE)):
            total += score.weight[2 * F + r] * standard[ONE[r]] * standard[OTHER[r]]
        probabilities[h] = 1 / (1 + math.exp(-total))
    return probabilities


class _Accepted(NamedTuple):
    """Up to G accepted hypotheses: bounding box (G, 4) of the members, number (G,) and indices (G, M) of points explained."""

    box: Array
    sizes: Integers
    explained: Integers


@entry
def select(leftover: Leftover, hypotheses: Hypotheses, probabilities: Array, threshold: float, most: int) -> Integers:
    """(G,) numbers of the accepted hypotheses, greedily: the most probable first, without its rivals, and so on.

    Args:
        probabilities: (H,).
        threshold: least probability. most: maximum number of movers.
    """
    source, target, (start, index) = leftover.source.grid.scan.points, leftover.target.grid, hypotheses.groups
    units, motions, group = leftover.target.units, hypotheses.motions, hypotheses.group
    order, accepted = _surest_first(probabilities, threshold), np.empty(max(most, 0), np.int64)
    taken = _Accepted(np.empty((most + 1, 4)), np.zeros(most + 1, np.int64), np.empty((most + 1, len(units)), np.int64))
    sample, G = empty_sample(), 0
    reach = EXPLAINED * units.max() if len(units) else 0.0
    for h in order:
        if most <= G:
            break
        members, is_same = index[start[group[h]] : start[group[h] + 1]], False
        for g in accepted[:G]:
            is_same = is_same or share_in_common(index[start[group[g]] : start[group[g] + 1]], members) > SHARED
        if is_same:
            continue
        L = take_members(members, sample.member)
        land(source, target, units, motions[h], sample, L)
        taken.sizes[G] = _explained(target.scan.boxes, units, reach, sample, L, taken.explained[G])
        box_round(source, members, taken.box[G])
        if _has_rival(taken, source, target, units, motions, accepted[:G], sample, L, leftover.unit):
            continue
        accepted[G] = h
        G += 1
    return accepted[:G].copy()


@kernel
def _surest_first(probabilities: Array, threshold: float) -> Integers:
    """Numbers of the hypotheses with at least the threshold probability (H,), the most probable first."""
    order = np.empty(len(probabilities), np.int64)
    count = 0
    for h in range(len(probabilities)):
        if probabilities[h] >= threshold:
            k = count
            while k > 0 and probabilities[order[k - 1]] < probabilities[h]:
                order[k] = order[k - 1]
                k -= 1
            order[k] = h
            count += 1
    return order[:count].copy()


@kernel
def _has_rival(
    taken: _Accepted,
    source: Array,
    target: ScanGrid,
    units: Array,
    motions: Array,
    accepted: Integers,
    sample: Sample,
    L: int,
    unit: float,
) -> bool:
    """Whether an accepted hypothesis explains the same target points, or explains the members too and is nearby."""
    G = len(accepted)
    for g in range(G):
        if share_in_common(taken.explained[g, : taken.sizes[g]], taken.explained[G, : taken.sizes[G]]) > SHARED:
            return True
    own = 0.0
    for k in range(L):
        own += sample.units[k]
    for g in range(G):
        wide, high = taken.box[g, 2] - taken.box[g, 0], taken.box[g, 3] - taken.box[g, 1]
        reach = math.sqrt(wide * wide + high * high) / 2 + APART * unit
        if math.sqrt(gap_squared(taken.box[g], taken.box[G])) < reach:
            other = _residual(source, target, units, motions[accepted[g]], sample.member[:L])
            if (other - own) / L < AS_WELL:
                return True
    return False


@kernel
def _residual(source: Array, target: ScanGrid, units: Array, motion: Array, index: Integers) -> float:
    """Sum of the residuals of source points (L,) under a motion (3,)."""
    moved, residual, near = np.empty((2, len(index))), np.empty(len(index)), np.empty(len(index), np.int64)
    apply_to_some(motion, source, index, moved)
    residual_at(moved, target, units, residual, near)
    return float(residual.sum())


@kernel
def _explained(boxes: Boxes, units: Array, reach: float, sample: Sample, L: int, explained: Integers) -> int:
    """Writes the target points explained by the moved members to `explained`, ascending; returns their number. reach: metres."""
    around = box_of(sample, L)
    count, last = 0, 0
    for b in range(len(boxes.small)):
        if gap_squared(boxes.small[b], around) > reach * reach:
            continue
        for j in range(b * RUN, min(len(units), (b + 1) * RUN)):
            near = EXPLAINED * units[j]
            squared, last = nearest_member(sample, L, boxes.points[j, 0], boxes.points[j, 1], last, near * near)
            if squared < near * near:
                explained[count] = j
                count += 1
    return count


@kernel
def box_round(points: Array, members: Integers, box: Array) -> None:
    """Writes least x and y, largest x and y of the members to `box` (4,)."""
    box[0] = box[1] = np.inf
    box[2] = box[3] = -np.inf
    for i in members:
        box[0], box[2] = min(box[0], points[i, 0]), max(box[2], points[i, 0])
        box[1], box[3] = min(box[1], points[i, 1]), max(box[3], points[i, 1])
