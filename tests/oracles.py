"""Slow and obvious twins of what the package computes: plain float64 loops that share no code with it.

Chains are enumerated labelling by labelling, features are double loops over i and j. Points are sequences of (x, y), motions of
(theta, tx, ty); states count from 0 and the outlier is the last.
"""

import itertools
import math
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
import scipy.optimize
import scipy.sparse

KAPPA = 9.0
ORDERS = (1, 3, 5)


# Chains. unary: (N, S), pairwise: (N-1, S, S), row = state of node i, column = state of node i + 1.


def labellings(unary: np.ndarray) -> Iterator[tuple[int, ...]]:
    nodes, states = unary.shape
    return itertools.product(range(states), repeat=nodes)


def score(unary: np.ndarray, pairwise: np.ndarray, labels: Sequence[int]) -> float:
    total = 0.0
    for i, state in enumerate(labels):
        total += float(unary[i, state])
        if i > 0:
            total += float(pairwise[i - 1, labels[i - 1], state])
    return total


def log_sum_exp(values: Sequence[float]) -> float:
    peak = max(values)
    if peak == -math.inf:
        return -math.inf
    return peak + math.log(sum(math.exp(value - peak) for value in values))


def log_partition(unary: np.ndarray, pairwise: np.ndarray, temperature: float = 1.0) -> float:
    scores = [score(unary, pairwise, labels) for labels in labellings(unary)]
    return max(scores) if temperature == 0 else temperature * log_sum_exp([s / temperature for s in scores])


def log_marginals(unary: np.ndarray, pairwise: np.ndarray, temperature: float = 1.0) -> np.ndarray:
    """(N, S): log probability of every state; at temperature 0 the max-marginals, normalised the same way."""
    out = np.empty(unary.shape)
    for i, state in np.ndindex(*unary.shape):
        scores = [score(unary, pairwise, labels) for labels in labellings(unary) if labels[i] == state]
        out[i, state] = max(scores) if temperature == 0 else log_sum_exp([s / temperature for s in scores])
    return np.array([[value - log_sum_exp(list(row)) for value in row] for row in out])


def best_labelling(unary: np.ndarray, pairwise: np.ndarray) -> tuple[int, ...]:
    return max(labellings(unary), key=lambda labels: score(unary, pairwise, labels))


def relaxed_best(unary: Sequence[np.ndarray], edges: dict[tuple[int, int], np.ndarray]) -> float:
    """The largest score over the local polytope: the linear programming relaxation of the best labelling, on any graph.

    unary: (S_i,) of every node; edges: (i, j) -> (S_i, S_j). An impossible state has no mass.
    """
    sizes = [len(of) for of in unary] + [table.size for table in edges.values()]
    first = np.concatenate([[0], np.cumsum(sizes)])
    gain = np.concatenate([*unary, *(table.ravel() for table in edges.values())])
    rows = [(np.arange(first[i], first[i + 1]), np.ones(len(of)), 1.0) for i, of in enumerate(unary)]  # a node's mass is 1
    for e, (ends, table) in enumerate(edges.items()):
        cells = first[len(unary) + e] + np.arange(table.size).reshape(table.shape)
        for node, lines in zip(ends, (cells, cells.T), strict=True):  # the mass of an edge sums to that of its ends
            rows += [(np.append(line, first[node] + s), np.append(np.ones(len(line)), -1.0), 0.0) for s, line in enumerate(lines)]
    counts = [len(where) for where, _, _ in rows]
    places = np.repeat(np.arange(len(rows)), counts), np.concatenate([where for where, _, _ in rows])
    sums = scipy.sparse.csr_array((np.concatenate([values for _, values, _ in rows]), places), shape=(len(rows), len(gain)))
    possible = np.isfinite(gain)
    most = np.stack([np.zeros(len(gain)), np.where(possible, np.inf, 0.0)], axis=1)
    found = scipy.optimize.linprog(-np.where(possible, gain, 0.0), A_eq=sums, b_eq=[total for _, _, total in rows], bounds=most)
    assert found.success, found.message
    return -float(found.fun)


def chain_edges(pairwise: np.ndarray) -> dict[tuple[int, int], np.ndarray]:
    """The edges of `relaxed_best` of a chain."""
    return {(i, i + 1): table for i, table in enumerate(pairwise)}


# Geometry.


def move(motion: Sequence[float], point: Sequence[float]) -> tuple[float, float]:
    theta, tx, ty = motion
    x, y = point
    return math.cos(theta) * x - math.sin(theta) * y + tx, math.sin(theta) * x + math.cos(theta) * y + ty


def wrap(angle: float) -> float:
    while angle > math.pi:
        angle -= 2 * math.pi
    while angle <= -math.pi:
        angle += 2 * math.pi
    return angle


def fit_cost(motion: Sequence[float], source: np.ndarray, target: np.ndarray, weights: Sequence[float]) -> float:
    """Weighted sum of squared distances that the best rigid motion makes smallest."""
    return sum(w * math.dist(move(motion, p), q) ** 2 for w, p, q in zip(weights, source, target, strict=True))


# Features.


def robust(error: float, scale: float) -> float:
    return -min((error / scale) ** 2, KAPPA)


def neighbour(i: int, offset: int, count: int, closed: bool) -> int:
    return (i + offset) % count if closed else min(max(i + offset, 0), count - 1)


def distance_to(points: np.ndarray, i: int, offset: int, closed: bool) -> float:
    return math.dist(points[neighbour(i, offset, len(points), closed)], points[i])


def geodesic_to(points: np.ndarray, i: int, offset: int, closed: bool) -> float:
    sign = 1 if offset > 0 else -1
    walk = [points[neighbour(i, sign * step, len(points), closed)] for step in range(abs(offset) + 1)]
    return sum(math.dist(a, b) for a, b in itertools.pairwise(walk))


def angle_between(points: np.ndarray, i: int, k: int, closed: bool) -> float:
    before, after = (points[neighbour(i, offset, len(points), closed)] for offset in (-k, k))
    u = (before[0] - points[i][0], before[1] - points[i][1])
    v = (after[0] - points[i][0], after[1] - points[i][1])
    if math.hypot(*u) < 1e-6 or math.hypot(*v) < 1e-6:
        return math.pi
    angle = math.atan2(u[0] * v[1] - u[1] * v[0], u[0] * v[0] + u[1] * v[1])
    return angle if angle >= 0 else angle + 2 * math.pi


def local_association(
    source: np.ndarray,
    target: np.ndarray,
    scales: Sequence[float],
    initial_motion: Sequence[float],
    moved: np.ndarray,
    source_closed: bool = False,
    target_closed: bool = False,
) -> np.ndarray:
    """L1..L12: (N, M, 12). `moved` are the source points under the motion of their own cluster."""
    out = np.empty((len(source), len(target), 12))
    for i, j in np.ndindex(len(source), len(target)):
        for c, k in enumerate(ORDERS):
            for channel, measure in ((c, distance_to), (6 + c, geodesic_to)):
                errors = [measure(source, i, s * k, source_closed) - measure(target, j, s * k, target_closed) for s in (1, -1)]
                out[i, j, channel] = sum(robust(error, scales[channel]) for error in errors) / 2
            turn = angle_between(source, i, k, source_closed) - angle_between(target, j, k, target_closed)
            out[i, j, 3 + c] = robust(wrap(turn), scales[3 + c])
        out[i, j, 9] = robust(math.hypot(*source[i]) - math.hypot(*target[j]), scales[9])
        out[i, j, 10] = robust(math.dist(move(initial_motion, source[i]), target[j]), scales[10])
        out[i, j, 11] = robust(math.dist(moved[i], target[j]), scales[11])
    return out


def pairwise_association(source: np.ndarray, target: np.ndarray, scales: Sequence[float], outlier: Sequence[float]) -> np.ndarray:
    """P1..P4: (N-1, M+1, M+1, 4). `outlier` holds P3 and P4 where a state is the outlier."""
    M = len(target)
    out = np.zeros((len(source) - 1, M + 1, M + 1, 4))
    for i, m, n in np.ndindex(len(source) - 1, M + 1, M + 1):
        if m == M or n == M:
            out[i, m, n] = (0, m != n, *outlier)
            continue
        v1, v2 = source[i + 1] - source[i], target[n] - target[m]
        out[i, m, n, 0] = n == m + 1
        out[i, m, n, 2] = robust(math.hypot(*v1) - math.hypot(*v2), scales[0])
        out[i, m, n, 3] = robust(math.hypot(*(v1 - v2)), scales[1])
    return out


def partner(motion: Sequence[float], point: np.ndarray, target: np.ndarray, association: int) -> np.ndarray:
    """The associated target point, or the nearest under the motion where the point is an outlier."""
    if association >= 0:
        return target[association]
    moved = move(motion, point)
    return min(target, key=lambda q: math.dist(moved, q))


def local_clustering(
    source: np.ndarray,
    target: np.ndarray,
    motions: np.ndarray,
    active: Sequence[bool],
    association: Sequence[int],
    cluster_distance: float,
    outlier_threshold: float,
) -> np.ndarray:
    """C1..C4: (N, D, 4)."""
    C = len(motions)
    out = np.zeros((len(source), C + 1, 4))
    for i, p in enumerate(source):
        residual = [math.dist(move(g, p), partner(g, p, target, association[i])) for g in motions]
        is_inlier = association[i] >= 0
        for k in range(C):
            out[i, k] = (robust(residual[k], cluster_distance), 0, is_inlier, 0)
        best = min((residual[k] for k in range(C) if active[k]), default=math.inf)
        out[i, C] = (0, best > outlier_threshold, 0, not is_inlier)
    return out


def pairwise_clustering(
    source: np.ndarray,
    target: np.ndarray,
    motions: np.ndarray,
    association: Sequence[int],
    neighbour_weight: float,
    neighbour_distance: float,
) -> np.ndarray:
    """Q1..Q8: (N-1, D, D, 8)."""
    C = len(motions)
    out = np.zeros((len(source) - 1, C + 1, C + 1, 8))
    for i in range(len(source) - 1):
        d1 = math.dist(source[i], source[i + 1])
        near = math.exp(-(d1**2) / neighbour_weight**2)
        has_both = association[i] >= 0 and association[i + 1] >= 0
        d2 = math.dist(target[association[i]], target[association[i + 1]]) if has_both else math.nan
        stiff = math.exp(-((d2 - d1) ** 2) / neighbour_distance**2)
        for k, m in np.ndindex(C + 1, C + 1):
            entry = out[i, k, m]
            entry[0] = k == m
            entry[7] = (k == C) != (m == C)
            if k == C or m == C:
                continue
            if k == m:
                entry[1] = near
                if has_both:
                    entry[3] = stiff
                    entry[5] = robust(d2 - d1, neighbour_distance)
            else:
                entry[2] = 1 - near
                if has_both:
                    entry[4] = 1 - stiff
                parted = math.dist(move(motions[k], source[i]), move(motions[m], source[i + 1]))
                entry[6] = robust(parted - d1, neighbour_distance)
    return out


# Extensions. A scan is (points in beam order, origin, closed, noise).


Scan = tuple[Sequence[Sequence[float]], Sequence[float], bool, float]


def beams_about(scan: Scan, point: Sequence[float], step: float | None = None) -> tuple[float, float, bool, float] | None:
    """Nearer and farther range of the beams beside a point, whether they are close enough to tell, and the slack; None: outside.

    step: radians between beams; None: the lower median of all turns.
    """
    points, origin, closed, noise = scan
    arms = [(p[0] - origin[0], p[1] - origin[1]) for p in points]
    ranges, bearings = [math.hypot(*arm) for arm in arms], [math.atan2(arm[1], arm[0]) for arm in arms]
    turns = [(after - before) % (2 * math.pi) for before, after in itertools.pairwise(bearings)]
    if step is None:
        step = sorted(turns)[(len(turns) - 1) // 2] if turns else math.radians(0.5)
    arm = (point[0] - origin[0], point[1] - origin[1])
    mine = math.hypot(*arm)
    onward = (math.atan2(arm[1], arm[0]) - bearings[0]) % (2 * math.pi)  # from the first beam
    span, is_measured = sum(turns), True
    if closed or onward < span:
        begin, beams = 0.0, [*range(len(points)), 0]
        for left, right in itertools.pairwise(beams if closed else beams[:-1]):
            width = turns[left] if right else 2 * math.pi - span
            if begin <= onward <= begin + width:
                break
            begin += width
        is_measured = max(onward - begin, begin + width - onward) < 2.5 * step
    elif min(onward - span, 2 * math.pi - onward) > step / 2:
        return None
    else:
        left = right = 0 if 2 * math.pi - onward < step / 2 else len(points) - 1
    slack = 3 * (noise + mine * step) + 0.02 * mine
    return min(ranges[left], ranges[right]), max(ranges[left], ranges[right]), is_measured, slack


def look(scan: Scan, point: Sequence[float]) -> tuple[float, float]:
    """How far a scan sees through a point and how far it hides it."""
    if len(scan[0]) == 0:
        return 0.0, 0.0
    about = beams_about(scan, point)
    if about is None:
        return 0.0, 1.0
    near, far, is_measured, slack = about
    if not is_measured:
        return 0.0, 0.0
    mine = math.dist(point, scan[1])
    seen, hidden = (min(max(beyond / max(slack, 1e-6) - 1, 0.0), 1.0) for beyond in (near - mine, mine - far))
    return seen, hidden


def past_gate(distance: float, gate: float) -> float:
    return 1 / (1 + math.exp(-(distance / gate - 1) / 0.05))


def association_extension(
    distances: Sequence[float], real: Sequence[bool], sight: Sequence[float], cluster_distance: float, gate: float
) -> np.ndarray:
    """(K+1, 5) of one point: excess, gate, outlier bias, outlier seen through, outlier hidden."""
    nearest = min([d for d, is_real in zip(distances, real, strict=True) if is_real], default=math.inf)
    rows = [[-min(max((d - nearest) / cluster_distance, 0.0), 3.0), -past_gate(d, gate), 0, 0, 0] for d in distances]
    return np.array([*rows, [0, 0, 1, *sight]], dtype=float)


def clustering_extension(
    residuals: Sequence[float],
    ahead: Sequence[Sequence[float]],
    back: Sequence[Sequence[float]],
    gate: float,
    is_inlier: bool,
    reaches: Sequence[float],
) -> np.ndarray:
    """(D, 9) of one point: gate, outlier bias, seen through, so back, hidden, so back, outlier seen through, so hidden, reach."""
    rows = []
    for residual, (seen, hidden), (seen_back, hidden_back), reach in zip(residuals, ahead, back, reaches, strict=True):
        of_partner = (seen_back, hidden_back) if is_inlier else (0.0, 0.0)
        rows.append([-past_gate(residual, gate), 0, -seen, -of_partner[0], -hidden, -of_partner[1], 0, 0, -min(reach**2, 9)])
    return np.array([*rows, [0, 1, 0, 0, 0, 0, *ahead[0], 0]], dtype=float)


def invert(motion: Sequence[float], point: Sequence[float]) -> tuple[float, float]:
    """Where the point came from."""
    theta, tx, ty = motion
    return move((-theta, 0.0, 0.0), (point[0] - tx, point[1] - ty))


def lattice_extension(
    source: np.ndarray,
    target: np.ndarray,
    motions: np.ndarray,
    possible: np.ndarray,
    scales: dict[str, Any],
    noise: float,
    reach: np.ndarray,
) -> np.ndarray:
    """(N, A D, 14) extensions of every super-node, the association's before the clustering's; open scans seen from 0.

    possible: (N, C). reach: (N, C), the feature's.
    """
    N, M, C = len(source), len(target), len(motions)
    before, after = (source, (0.0, 0.0), False, noise), (target, (0.0, 0.0), False, noise)
    out = np.zeros((N, M + 1, C + 1, 14))
    for i in range(N):
        moved = [move(g, source[i]) for g in motions]
        apart = [[math.dist(p, q) for q in target] for p in moved]
        ahead = [look(after, p) for p in moved]
        best = [min(apart[k][j] for k in range(C) if possible[i, k]) for j in range(M)]
        for k in range(C + 1):
            own, sight = (apart[k], ahead[k]) if k < C else (best, ahead[0])
            out[i, :, k, :5] = association_extension(own, [True] * M, sight, scales["cluster_distance"], scales["gate"])
        for j in range(M + 1):
            residuals = [row[j] if j < M else min(row) for row in apart]
            back = [look(before, invert(g, target[j % M])) for g in motions]
            out[i, j, :, 5:] = clustering_extension(residuals, ahead, back, scales["gate"], j < M, reach[i])
    return out.reshape(N, -1, 14)


def stump_sum(
    phi: Sequence[float], feature: Sequence[int], threshold: Sequence[float], left: Sequence[float], right: Sequence[float]
) -> float:
    """Margin of an ensemble of decision stumps, one after the other."""
    total = 0.0
    for f, limit, low, high in zip(feature, threshold, left, right, strict=True):
        total += low if phi[f] <= limit else high
    return total


# The lattice: states (j, k) of one chain, numbered j * D + k; j = M and k = C are the outliers.


def lattice_tables(unary: np.ndarray, association: np.ndarray, cluster: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(N, A D) and (N-1, A D, A D) from factors (N, A, D), (N-1, A, A, 3) for one cluster, two, the outlier's, and (N-1, D, D)."""
    N, A, D = unary.shape
    nodes, edges = np.empty((N, A * D)), np.empty((N - 1, A * D, A * D))
    for i, j, k in np.ndindex(N, A, D):
        nodes[i, j * D + k] = unary[i, j, k]
    for i, j, k, j2, k2 in np.ndindex(N - 1, A, D, A, D):
        kind = 2 if D - 1 in (k, k2) else int(k != k2)
        edges[i, j * D + k, j2 * D + k2] = association[i, j, j2, kind] + cluster[i, k, k2]
    return nodes, edges


def lattice_local(
    source: np.ndarray,
    target: np.ndarray,
    motions: np.ndarray,
    possible: np.ndarray,
    scales: dict[str, Any],
    initial_motion: Sequence[float],
    data: Sequence[Sequence[float]],
    outlier: Sequence[Sequence[float]],
) -> np.ndarray:
    """(N, A D, 30) features of every super-node, the pairwise ones 0. possible: (N, C); scales: the buffers of `Scales`."""
    N, M, C = len(source), len(target), len(motions)
    under = [np.array([move(g, p) for p in source]) for g in motions]
    channels = [local_association(source, target, scales["local"], initial_motion, moved) for moved in under]
    out = np.zeros((N, (M + 1) * (C + 1), 30))
    for i in range(N):
        mine = [k for k in range(C) if possible[i, k]]
        best = channels[0][i].copy()
        best[:, 11] = [max(channels[k][i, j, 11] for k in mine) for j in range(M)]
        margins = [stump_sum(row, *data) for row in best]
        top = max(range(M), key=lambda j: margins[j])
        others = [margins[j] for j in range(M) if abs(j - top) >= 3]
        gap = margins[top] - max(others) if others else 0.0
        outlier_margin = stump_sum([*best.max(axis=0), margins[top], gap], *outlier)
        nearest = min(math.dist(under[k][i], q) for k in mine for q in target)
        for j, k in np.ndindex(M + 1, C + 1):
            row = out[i, j * (C + 1) + k]
            if j == M:
                row[:12], row[13] = scales["local_outlier"], outlier_margin
            else:
                row[:12] = best[j] if k == C else channels[k][i, j]
                row[12] = stump_sum(row[:12], *data)
            if k < C and j < M:
                row[18] = robust(math.dist(under[k][i], target[j]), scales["cluster_distance"])
            row[19] = k == C and nearest > scales["outlier_threshold"]
            row[20] = k < C and j < M
            row[21] = k == C and j == M
    return out


def lattice_pairwise(source: np.ndarray, target: np.ndarray, motions: np.ndarray, scales: dict[str, Any]) -> np.ndarray:
    """(N-1, A D, A D, 30) features of every transition, the local ones 0: both chains' with the associations at j and j'."""
    N, M, C = len(source), len(target), len(motions)
    D = C + 1
    of_association = pairwise_association(source, target, scales["pairwise"], scales["pairwise_outlier"])
    out = np.zeros((N - 1, (M + 1) * D, (M + 1) * D, 30))
    for i, j, j2 in np.ndindex(N - 1, M + 1, M + 1):
        labels = [j if j < M else -1, j2 if j2 < M else -1]
        ends = source[i : i + 2]
        of_cluster = pairwise_clustering(ends, target, motions, labels, scales["neighbour_weight"], scales["neighbour_distance"])
        for k, k2 in np.ndindex(D, D):
            out[i, j * D + k, j2 * D + k2, 14:18] = of_association[i, j, j2]
            out[i, j * D + k, j2 * D + k2, 22:] = of_cluster[0, k, k2]
    return out


def conditionals(unary: np.ndarray, pairwise: np.ndarray, labels: Sequence[int], weights: np.ndarray) -> list[float]:
    """log p(label of i | labels of i - 1 and i + 1), a node after the other. unary: (N, S, F), pairwise: (N-1, S, S, F)."""
    out = []
    for i, label in enumerate(labels):
        scores = []
        for state in range(unary.shape[1]):
            total = float(unary[i, state] @ weights)
            if i > 0:
                total += float(pairwise[i - 1, labels[i - 1], state] @ weights)
            if i + 1 < len(labels):
                total += float(pairwise[i, state, labels[i + 1]] @ weights)
            scores.append(total)
        out.append(scores[label] - log_sum_exp(scores))
    return out
