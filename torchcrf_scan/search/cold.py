"""Matching by shape alone, without a guess of the motion: candidates, an exact chain, two-point RANSAC.

The matrix of scores of all pairs of points is never stored: rows are computed one by one, and only the best candidates kept.
"""

from __future__ import annotations

import math
from functools import cache

import numpy as np
import torch

from torchcrf_scan.features.potentials import REFERENCE_UNIT
from torchcrf_scan.features.scales import KAPPA, Scales
from torchcrf_scan.loops.jit import Array, Integers, entry, kernel
from torchcrf_scan.loops.kabsch import kabsch
from torchcrf_scan.loops.rigid import transform, transform_of
from torchcrf_scan.loops.shape import Shape, describe, resolution
from torchcrf_scan.names import SHAPE_CHANNELS
from torchcrf_scan.search.surface import Surface

CANDIDATES = 32
SAMPLES = 256
OUTLIER_SCORE = -3.0  # mean channel value below which the outlier is better
SEQUENCE, SWITCHING, DISTANCE = 2.0, -1.0, 0.5  # weights of the pairwise features; translation is not invariant

LENGTHS, ANGLES = 12, 3  # rows of `_rows_of`: two distances and two geodesics of three orders, then the angles
BINS = 256  # of the histogram of scores

_scales = Scales()
SCALES = _scales.local[:SHAPE_CHANNELS].double().numpy()
PAIR_SCALE = float(_scales.pairwise[0])
OUTLIER_DISTANCE = float(_scales.pairwise_outlier[0])
SWITCH, STAY = SWITCHING + DISTANCE * OUTLIER_DISTANCE, DISTANCE * OUTLIER_DISTANCE


# Candidates.


@kernel
def _rows_of(shape: Shape) -> Array:
    """(15, P) descriptors in units of their scales: lengths, then angles. P: points."""
    rows = np.empty((LENGTHS + ANGLES, len(shape.radius)))
    for i in range(len(shape.radius)):
        for order in range(3):
            for side in range(2):
                rows[2 * order + side, i] = shape.distance[i, order, side] / SCALES[order]
                rows[6 + 2 * order + side, i] = shape.geodesic[i, order, side] / SCALES[6 + order]
            rows[LENGTHS + order, i] = shape.angle[i, order] / SCALES[3 + order]
    return rows


@kernel
def _score_row(source: Array, i: int, target: Array, error: Array) -> None:
    """Writes (M,) shape differences of source point i and all target points: minus nine times the score."""
    error[:] = 0.0
    for c in range(0, LENGTHS, 4):  # four at once, to read and write the sums less often
        a, b, d, e = source[c, i], source[c + 1, i], source[c + 2, i], source[c + 3, i]
        one, two, three, four = target[c], target[c + 1], target[c + 2], target[c + 3]
        for j in range(len(error)):
            half = min((a - one[j]) ** 2, KAPPA) + min((b - two[j]) ** 2, KAPPA)
            error[j] += (half + min((d - three[j]) ** 2, KAPPA) + min((e - four[j]) ** 2, KAPPA)) / 2
    for order in range(ANGLES):
        a, row, turn = source[LENGTHS + order, i], target[LENGTHS + order], 2 * math.pi / SCALES[3 + order]
        for j in range(len(error)):
            apart = abs(a - row[j])
            error[j] += min(min(apart, turn - apart) ** 2, KAPPA)


@kernel
def _threshold(error: Array, count: int, bins: Integers, edge: Array) -> float:
    """The count-th smallest of (M,) errors; bins: (BINS,) and edge: (M,) are scratch space."""
    per_error = BINS / (SHAPE_CHANNELS * KAPPA * (1 + 1e-9))
    bins[:] = 0
    for j in range(len(error)):
        bins[int(error[j] * per_error)] += 1
    place, before = 0, 0
    while before + bins[place] < count:
        before += bins[place]
        place += 1
    size = 0
    for j in range(len(error)):
        if int(error[j] * per_error) == place:
            k = size
            while k > 0 and edge[k - 1] > error[j]:
                edge[k] = edge[k - 1]
                k -= 1
            edge[k] = error[j]
            size += 1
    return float(edge[count - before - 1])


@kernel
def shape_candidates(source: Array, target: Array, count: int) -> tuple[Integers, Array]:
    """(N, K) target points, ascending, most similar in shape to every source point, and their scores; K = `count` or all.

    source: (15, N), target: (15, M) rows. Costs N M.
    """
    N, M = source.shape[1], target.shape[1]
    K = min(count, M)
    index, score = np.empty((N, K), np.int64), np.empty((N, K))
    error, edge, bins = np.empty(M), np.empty(M), np.empty(BINS, np.int64)
    for i in range(N):
        _score_row(source, i, target, error)
        worst = _threshold(error, K, bins, edge)
        ties = K
        for j in range(M):
            ties -= 1 if error[j] < worst else 0
        k = 0
        for j in range(M):
            if error[j] < worst or (error[j] == worst and ties > 0):
                ties -= 1 if error[j] == worst else 0
                index[i, k], score[i, k] = j, -error[j] / SHAPE_CHANNELS
                k += 1
    return index, score


# The chain.


@kernel
def _advance(total: Array, x: Array, y: Array, next_x: Array, next_y: Array, gap: float, best: Array) -> None:
    """Writes the largest sum of a node's K + 1 totals and the edge from it, for all states of the next node; without `SEQUENCE`."""
    K = len(x)
    unlikely = -np.inf
    for j in range(K):
        best[j] = total[K] + SWITCH
    for i in range(K):
        unlikely = max(unlikely, total[i])
        at_x, at_y, so_far = x[i], y[i], total[i]
        for j in range(K):
            dx, dy = next_x[j] - at_x, next_y[j] - at_y
            error = (gap - math.sqrt(dx * dx + dy * dy)) / PAIR_SCALE
            best[j] = max(best[j], so_far - DISTANCE * min(error * error, KAPPA))
    best[K] = max(unlikely + SWITCH, total[K] + STAY)


@kernel
def _edge(i: int, j: int, here: Integers, there: Integers, x: Array, y: Array, next_x: Array, next_y: Array, gap: float) -> float:
    """The log potential between state i of a node and state j of the next; the last state is the outlier."""
    K = len(here)
    if i == K or j == K:
        return STAY if i == j else SWITCH
    error = (gap - math.sqrt((next_x[j] - x[i]) ** 2 + (next_y[j] - y[i]) ** 2)) / PAIR_SCALE
    return (SEQUENCE if there[j] - here[i] == 1 else 0.0) - DISTANCE * min(error * error, KAPPA)


@kernel
def best_labels(source: Array, target: Array, index: Integers, score: Array) -> Integers:
    """(N,) target points, -1 outlier, of the best labelling of a chain (Viterbi: forward totals, then backtracking).

    If unique, it is also the labelling of the largest max-marginals.

    Args:
        source: (N, 2), target: (M, 2) points. index, score: (N, K) candidates.
    """
    N, K = index.shape
    total, best = np.empty((N, K + 1)), np.empty(K + 1)
    xs, ys, gaps = np.empty((N, K)), np.empty((N, K)), np.zeros(N)
    for i in range(N):
        for k in range(K):
            xs[i, k], ys[i, k] = target[index[i, k], 0], target[index[i, k], 1]
        if i > 0:
            gaps[i] = math.sqrt((source[i, 0] - source[i - 1, 0]) ** 2 + (source[i, 1] - source[i - 1, 1]) ** 2)
            _advance(total[i - 1], xs[i - 1], ys[i - 1], xs[i], ys[i], gaps[i], best)
            k = 0
            for j in range(K):  # a reward for the next target point, so that the larger of the two is right
                while k < K and index[i - 1, k] < index[i, j] - 1:
                    k += 1
                if k < K and index[i - 1, k] == index[i, j] - 1:
                    edge = _edge(k, j, index[i - 1], index[i], xs[i - 1], ys[i - 1], xs[i], ys[i], gaps[i])
                    best[j] = max(best[j], total[i - 1, k] + edge)
        else:
            best[:] = 0.0
        for k in range(K):
            total[i, k] = best[k] + score[i, k]
        total[i, K] = best[K] + OUTLIER_SCORE
    labels = np.empty(N, np.int64)
    state = int(np.argmax(total[N - 1])) if N > 0 else 0
    for i in range(N - 1, -1, -1):
        labels[i] = index[i, state] if state < K else -1
        if i > 0:
            largest, chosen = -np.inf, 0
            for k in range(K + 1):
                edge = _edge(k, state, index[i - 1], index[i], xs[i - 1], ys[i - 1], xs[i], ys[i], gaps[i])
                if total[i - 1, k] + edge > largest:
                    largest, chosen = total[i - 1, k] + edge, k
            state = chosen
    return labels


@entry
def shape_association(source: Array, target: Array, noise: float, source_closed: bool, target_closed: bool) -> Integers:
    """(N,) associations, -1 outlier, of a chain on shapes and distances along the scan, without positions.

    Args:
        source: (N, 2), target: (M, 2) points in beam order. noise: metres.
    """
    if len(source) == 0 or len(target) == 0:
        return np.full(len(source), -1, np.int64)
    factor = REFERENCE_UNIT / resolution(source, target, noise)
    source, target = source * factor, target * factor
    index, score = shape_candidates(
        _rows_of(describe(source, source_closed)), _rows_of(describe(target, target_closed)), CANDIDATES
    )
    return best_labels(source, target, index, score)


# RANSAC.


@entry
def sampled_motions(source: Array, target: Array, gate: float, picks: Integers) -> tuple[Array, Integers]:
    """(H, 3) motions of pairs of associations (H, 2), and (H,) number of associations consistent with each.

    Args:
        source, target: (P, 2) associated points. gate: metres.
    """
    motions, agreeing = np.empty((len(picks), 3)), np.zeros(len(picks), np.int64)
    xs, ys = source[:, 0].copy(), source[:, 1].copy()
    us, vs = target[:, 0].copy(), target[:, 1].copy()
    here, there = np.empty((2, 2)), np.empty((2, 2))
    for h in range(len(picks)):
        for k in range(2):
            i = picks[h, k]
            here[k, 0], here[k, 1], there[k, 0], there[k, 1] = xs[i], ys[i], us[i], vs[i]
        motions[h] = kabsch(here, there, np.ones(len(here)))
        by, count = transform_of(motions[h]), 0
        for i in range(len(xs)):
            x, y = transform(by, xs[i], ys[i])
            count += 1 if (x - us[i]) ** 2 + (y - vs[i]) ** 2 < gate * gate else 0
        agreeing[h] = count
    return motions, agreeing


@cache
def _picks(points: int) -> Integers:
    """(SAMPLES, 2) pairs of points, drawn with a fixed seed."""
    return torch.randint(points, (SAMPLES, 2), generator=torch.Generator().manual_seed(0)).numpy()


def ransac_motions(source: Array, target: Array, gate: float, count: int) -> Array:
    """(count, 3) the two-point motions with most consistent associations; none for fewer than two points.

    Args:
        source, target: (P, 2) associated points. gate: metres.
    """
    if len(source) < 2:
        return np.zeros((0, 3))
    motions, agreeing = sampled_motions(source, target, gate, _picks(len(source)))
    best = torch.from_numpy(agreeing).topk(min(count, SAMPLES)).indices  # torch has its own order of ties
    return motions[best.numpy()]


def shape_motions(source: Surface, target: Surface, gate: float, count: int) -> Array:
    """(count, 3) two-point motions consistent with most associations of `shape_association`. gate: metres."""
    match = shape_association(source.points, target.points, source.noise, source.is_closed, target.is_closed)
    return ransac_motions(source.points[match >= 0], target.points[match[match >= 0]], gate, count)
