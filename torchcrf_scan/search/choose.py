"""Choice of the start of one pair from its survey: background, movers, reach and first associations."""

from __future__ import annotations

import math

import numpy as np

from torchcrf_scan.inference.start import ASSOCIATION_GATE, FARTHEST, FOOTPRINT, REACH_EXTENT, REACH_UNITS, SHORTEST
from torchcrf_scan.loops.jit import Array, Booleans, Integers, entry, kernel
from torchcrf_scan.loops.nearest import box_distance
from torchcrf_scan.loops.pair import PairStart
from torchcrf_scan.loops.rigid import apply_to_rows, parting, transform_of
from torchcrf_scan.search.accept import Score, box_round, probabilities_of, select
from torchcrf_scan.search.grid import ScanGrid, locate
from torchcrf_scan.search.groups import Groups
from torchcrf_scan.search.hypotheses import Hypotheses
from torchcrf_scan.search.leftover import OPEN, Leftover
from torchcrf_scan.search.sides import Sides

CONSIDERED = 0.1  # least probability of a mover that the model considers; the score alone accepts from its own threshold
OF_SIDE = 0.95  # probability of the motion of a side that slides; on simulated worlds, all but a few of them are right
FEWEST_POINTS = 3  # a scan with fewer does not determine a motion
CERTAIN = 1e-6  # probabilities are clipped to this distance from 0 and 1


@entry
def choose_movers(
    leftover: Leftover,
    hypotheses: Hypotheses,
    features: Array,
    sides: Sides,
    guess: Array,
    score: Score,
    clusters: int,
    resolution: float,
) -> PairStart:
    """The background and up to `clusters` - 1 movers accepted by the score.

    Args:
        features: (H, F) of the hypotheses.
        guess: (3,) the pair's initial motion, used for empty slots and for scans with too few points.
        resolution: metres, `features.potentials.resolution` of the pair.
    """
    source, target, tangent = leftover.source.grid.scan.points, leftover.target.grid, leftover.target.grid.scan.tangent
    noise = leftover.source.grid.scan.noise
    motions, active = np.empty((clusters, 3)), np.zeros(clusters, np.bool_)
    log_odds, reach = np.full(clusters, -np.inf), np.full((len(source), clusters), FARTHEST)
    motions[:] = guess
    active[0], log_odds[0], reach[:, 0] = True, np.inf, 0.0
    if min(len(source), len(tangent)) < FEWEST_POINTS:
        return PairStart(motions, active, _associate(source, target, motions, active, reach, noise), 0 * tangent, reach, log_odds)
    motions[0] = leftover.background
    hypotheses, probabilities = judge(hypotheses, features, sides, score)
    (start, index), group = hypotheses.groups, hypotheses.group
    for c, h in enumerate(select(leftover, hypotheses, probabilities, CONSIDERED, clusters - 1), 1):
        motions[c] = hypotheses.motions[h]
        active[c] = probabilities[h] >= score.threshold
        sure = min(max(probabilities[h], CERTAIN), 1 - CERTAIN)
        log_odds[c] = math.log(sure / (1 - sure))
        _reach(source, index[start[group[h]] : start[group[h] + 1]], resolution, reach[:, c])
    _give_sides(source, sides, motions, log_odds, OPEN * leftover.unit, reach)
    return PairStart(motions, active, _associate(source, target, motions, active, reach, noise), tangent, reach, log_odds)


@entry
def judge(hypotheses: Hypotheses, features: Array, sides: Sides, score: Score) -> tuple[Hypotheses, Array]:
    """The hypotheses and after them the sides' motions, and the probabilities (H + S,) of all. features: (H, F)."""
    H, S, (start, index) = len(hypotheses.motions), len(sides.motions), hypotheses.groups
    G = len(start) - 1
    motions, group, probabilities = np.empty((H + S, 3)), np.empty(H + S, np.int64), np.empty(H + S)
    motions[:H], group[:H], probabilities[:H] = hypotheses.motions, hypotheses.group, probabilities_of(score, features)
    motions[H:], probabilities[H:] = sides.motions, OF_SIDE
    for s in range(S):
        group[H + s] = G + s
    starts = np.concatenate((start, start[G] + sides.groups.start[1:]))
    return Hypotheses(motions, group, Groups(starts, np.concatenate((index, sides.groups.members)))), probabilities


@kernel
def _give_sides(points: Array, sides: Sides, motions: Array, log_odds: Array, near: float, reach: Array) -> None:
    """Puts the sides' points within reach of the movers that move as they do, and out of the background's reach.

    Args:
        points: (N, 2). motions: (C, 3). log_odds: (C,), -inf for empty slots. near: metres up to which two motions are the same to
            a side. reach: (N, C).
    """
    start, index = sides.groups
    for s in range(len(sides.motions)):
        members, own = index[start[s] : start[s + 1]], transform_of(sides.motions[s])
        for c in range(1, len(motions)):
            if log_odds[c] == -np.inf:
                continue
            other, apart = transform_of(motions[c]), 0.0
            for i in members:
                apart += parting(own, other, points[i, 0], points[i, 1])
            if apart <= near * len(members):
                for i in members:
                    reach[i, 0], reach[i, c] = FARTHEST, 0.0


@kernel
def _reach(points: Array, members: Integers, unit: float, beyond: Array) -> None:
    """Writes how far the points are beyond the reach of the members, (N,) in reaches; `inference.start.beyond_reach`.

    beyond: (N,) of `FARTHEST`.
    """
    box = np.empty(4)
    box_round(points, members, box)
    wide, high = box[2] - box[0], box[3] - box[1]
    reach = max(REACH_EXTENT * math.sqrt(wide * wide + high * high) + REACH_UNITS * unit, SHORTEST)
    near, far = reach * reach, ((1 + FARTHEST) * reach) ** 2
    last = 0  # member nearest to the point before
    for i in range(len(points)):
        x, y = points[i, 0], points[i, 1]
        if box_distance(box, x, y) >= far:
            continue
        least, first = far, last
        for k in range(len(members)):
            place = (first + k) % len(members)
            dx, dy = points[members[place], 0] - x, points[members[place], 1] - y
            if dx * dx + dy * dy < least:
                least, last = dx * dx + dy * dy, place
                if least <= near:
                    break
        beyond[i] = 0.0 if least <= near else max(math.sqrt(least) / reach - 1, 1e-15)  # beyond, if only by rounding


@kernel
def _associate(source: Array, target: ScanGrid, motions: Array, active: Booleans, reach: Array, noise: float) -> Integers:
    """(N,) nearest target point under any motion within reach, -1 beyond a few units of footprint and noise."""
    N = len(source)
    association, least = np.full(N, -1, np.int64), np.empty(N)
    for i in range(N):
        gate = ASSOCIATION_GATE * (math.sqrt(source[i, 0] ** 2 + source[i, 1] ** 2) * FOOTPRINT / 2 + 2 * noise)
        least[i] = np.nextafter(gate * gate, np.inf)  # the gate itself is included
    moved, squared, near = np.empty((2, N)), np.empty(N), np.empty(N, np.int64)
    for c in range(len(motions)):
        if not active[c]:
            continue
        apply_to_rows(motions[c], source, moved)
        locate(moved, target, squared, near)
        for i in range(N):
            if reach[i, c] <= 0 and squared[i] < least[i]:
                least[i], association[i] = squared[i], near[i]
    return association
