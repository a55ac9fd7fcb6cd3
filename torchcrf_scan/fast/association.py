"""The association chain of one pair: potentials with the weights applied on the fly, and an exact pass over the chain.

The potentials are those of `features.association` and `features.extension`.
"""

from __future__ import annotations

import math

import numpy as np

from torchcrf_scan.fast.boosting import add_margins, margin
from torchcrf_scan.fast.limit import Limit, log_within, sigmoid
from torchcrf_scan.fast.robust import robust_square
from torchcrf_scan.fast.static_features import AssociationModel, AssociationPair, Workspace, update_static
from torchcrf_scan.features.association import ANOTHER_PLACE
from torchcrf_scan.features.extension import FARTHEST_EXCESS
from torchcrf_scan.features.scales import GATE_WIDTH, KAPPA
from torchcrf_scan.loops.jit import Array, Booleans, Integers, kernel
from torchcrf_scan.loops.messages import log_softmax, max_marginals
from torchcrf_scan.loops.rigid import transform, transform_of
from torchcrf_scan.names import ASSOCIATION_WEIGHTS, LOCAL_CHANNELS, STATIC_CHANNELS

REGISTERED = STATIC_CHANNELS  # L12
BEST_MARGIN, LEAD = len(LOCAL_CHANNELS), len(LOCAL_CHANNELS) + 1  # inputs of the outlier booster
DATA_BOOSTING, OUTLIER_BOOSTING, EXCESS, GATE, OUTLIER_BIAS, SEEN_THROUGH, HIDDEN, SEQUENCE, SWITCH, STRETCH, SHIFT = (
    ASSOCIATION_WEIGHTS.index(name)
    for name in (
        *("data_boosting", "outlier_boosting", "excess", "gate", "outlier_bias", "outlier_seen_through", "outlier_hidden"),
        *("sequence", "pairwise_outlier", "pairwise_distance", "pairwise_translation"),
    )
)


@kernel
def distances(pair: AssociationPair, work: Workspace, moved: Array) -> tuple[Array, Array]:
    """(N K,) metres to the candidates after the points' own motion, inf for those that are not real, and (N,) the least."""
    N, K = work.candidates.shape
    distance, nearest = np.empty(N * K), np.empty(N)
    for i in range(N):
        x, y, least = moved[i, 0], moved[i, 1], np.inf
        for k in range(K):
            j = work.candidates[i, k] if work.mask[i, k] else -1
            dx, dy = (x - pair.target[j, 0], y - pair.target[j, 1]) if j >= 0 else (np.inf, 0.0)
            distance[i * K + k] = math.sqrt(dx * dx + dy * dy)
            least = min(least, distance[i * K + k])
        nearest[i] = least
    return distance, nearest


@kernel
def outlier_margin(model: AssociationModel, work: Workspace, i: int, registered: float, margin_of: Array) -> float:
    """The outlier booster of source point i. registered: the best L12; margin_of: (K,) data booster."""
    K = work.candidates.shape[1]
    best, place = -np.inf, -1
    for k in range(K):
        if work.mask[i, k] and margin_of[k] > best:
            best, place = margin_of[k], k
    second = -np.inf
    for k in range(K if place >= 0 else 0):
        if work.mask[i, k] and abs(work.candidates[i, k] - work.candidates[i, place]) >= ANOTHER_PLACE:
            second = max(second, margin_of[k])
    lead = best - second if second > -np.inf else 0.0
    if place < 0:
        registered, best, lead = -KAPPA, 0.0, 0.0
    boosted = work.outlier_margin[i] + margin(model.outlier, REGISTERED, registered)
    return boosted + margin(model.outlier, BEST_MARGIN, best) + margin(model.outlier, LEAD, lead)


@kernel
def log_unary_of(
    model: AssociationModel, pair: AssociationPair, work: Workspace, limit: Limit, moved: Array, seen_through: Array, hidden: Array
) -> Array:
    """(N, K+1) log potentials of the workspace's candidates and, last, of the outlier.

    limit: of outliers. moved: (N, 2) source points under their own motion; seen_through, hidden: (N,) their free-space tests in the
    target.
    """
    N, K = work.candidates.shape
    weights = model.weights
    distance, nearest = distances(pair, work, moved)
    registered, values, boosted = np.empty(N * K), np.zeros(N * K), np.zeros(N * K)
    for p in range(N * K):  # long loops without branches, several pairs at once
        registered[p] = robust_square(distance[p], model.per_local[REGISTERED])
    add_margins(model.data, REGISTERED, registered, boosted)
    if weights[GATE] != 0:
        for p in range(N * K):
            values[p] -= weights[GATE] * sigmoid((distance[p] / model.gate - 1) / GATE_WIDTH)
    if limit.distance > 0:
        for p in range(N * K):
            values[p] += log_within(limit, distance[p])
    constant = weights[OUTLIER_BIAS]
    for c in range(len(LOCAL_CHANNELS)):
        constant += weights[c] * model.local_outlier[c]
    log_unary = np.empty((N, K + 1))
    for i in range(N):
        margins = boosted[i * K : (i + 1) * K]
        for k in range(K):
            p = i * K + k
            margins[k] += work.margin[i, k]
            if not work.mask[i, k]:
                log_unary[i, k] = -np.inf
                continue
            excess = min((distance[p] - nearest[i]) / model.cluster_distance, FARTHEST_EXCESS)
            value = values[p] + work.score[i, k] + weights[REGISTERED] * registered[p] + weights[DATA_BOOSTING] * margins[k]
            log_unary[i, k] = value - weights[EXCESS] * excess
        value = constant + weights[SEEN_THROUGH] * seen_through[i] + weights[HIDDEN] * hidden[i]
        if weights[OUTLIER_BOOSTING] != 0:
            best = robust_square(nearest[i], model.per_local[REGISTERED])
            value += weights[OUTLIER_BOOSTING] * outlier_margin(model, work, i, best, margins)
        log_unary[i, K] = value
    return log_unary


@kernel
def _touching_outlier(model: AssociationModel) -> tuple[float, float]:
    """Log potential of an edge with one outlier, and with two."""
    weights = model.weights
    stay = weights[STRETCH] * model.pairwise_outlier[0] + weights[SHIFT] * model.pairwise_outlier[1]
    return stay + weights[SWITCH], stay


@kernel
def log_pairwise_of(model: AssociationModel, pair: AssociationPair, index: Integers) -> Array:
    """(N-1, K+1, K+1) log potentials of every edge (i, i+1). index: (N, K)."""
    N, K = index.shape
    weights, source, target = model.weights, pair.source, pair.target
    switch, stay = _touching_outlier(model)
    is_long = weights[STRETCH] != 0 or weights[SHIFT] != 0
    log_pairwise = np.empty((max(N - 1, 0), K + 1, K + 1))
    for i in range(N - 1):
        ux, uy = source[i + 1, 0] - source[i, 0], source[i + 1, 1] - source[i, 1]
        length = math.sqrt(ux * ux + uy * uy)
        edge = log_pairwise[i]
        for s in range(K):
            a = index[i, s]
            for t in range(K):
                b = index[i + 1, t]
                value = weights[SEQUENCE] if b - a == 1 else 0.0
                if is_long:
                    vx, vy = target[b, 0] - target[a, 0], target[b, 1] - target[a, 1]
                    stretch = length - math.sqrt(vx * vx + vy * vy)
                    shift = math.sqrt((ux - vx) ** 2 + (uy - vy) ** 2)
                    value += weights[STRETCH] * robust_square(stretch, model.per_pairwise[0])
                    value += weights[SHIFT] * robust_square(shift, model.per_pairwise[1])
                edge[s, t] = value
            edge[s, K] = edge[K, s] = switch
        edge[K, K] = stay
    return log_pairwise


@kernel
def _in_sequence(index: Integers) -> tuple[Integers, Integers]:
    """(N-1, K) the state of node i before every state of node i + 1 in the target scan, and the state of i + 1 after; else -1."""
    N, K = index.shape
    before, after = np.full((max(N - 1, 0), K), -1), np.full((max(N - 1, 0), K), -1)
    for i in range(N - 1):
        s = t = 0
        while s < K and t < K:
            step = index[i + 1, t] - index[i, s]
            if step == 1:
                before[i, t], after[i, s] = s, t
            if step <= 1:
                t += 1
            if step >= 1:
                s += 1
    return before, after


@kernel
def _send(scores: Array, partner: Integers, sequence: float, switch: float, stay: float, message: Array) -> None:
    """Message over an edge that depends on sequence and outliers alone: time grows with K, not its square.

    scores: (K+1,) of the one node. partner: (K,) its state in sequence with every state of the other, or -1. message: (K+1,).
    """
    K = len(partner)
    best, place, second = -np.inf, -1, -np.inf
    for s in range(K):
        if scores[s] > best:
            best, place, second = scores[s], s, best
        else:
            second = max(second, scores[s])
    from_outlier = scores[K] + switch
    for t in range(K):
        s = partner[t]
        value = max(second if s == place else best, from_outlier)
        message[t] = max(value, scores[s] + sequence) if s >= 0 else max(best, from_outlier)
    message[K] = max(best + switch, scores[K] + stay)


@kernel
def beliefs_in_sequence(log_unary: Array, index: Integers, sequence: float, switch: float, stay: float) -> Array:
    """(N, K+1) `max_marginals` of a chain whose edges depend on sequence and outliers alone. index: (N, K), ascending if real."""
    N, S = log_unary.shape
    before, after = _in_sequence(index)
    beliefs, message, scores = np.empty((N, S)), np.zeros(S), np.empty(S)
    for i in range(N):
        if i > 0:
            _send(beliefs[i - 1], before[i - 1], sequence, switch, stay, message)
        for s in range(S):
            beliefs[i, s] = log_unary[i, s] + message[s]
    message[:] = 0.0
    for i in range(N - 2, -1, -1):
        for s in range(S):
            scores[s] = log_unary[i + 1, s] + message[s]
        _send(scores, after[i], sequence, switch, stay, message)
        for s in range(S):
            beliefs[i, s] += message[s]
    for i in range(N):
        log_softmax(beliefs[i])
    return beliefs


@kernel
def association_labels(log_association: Array, index: Integers) -> Integers:
    """(N,) target point of the best state, -1 for the outlier. log_association: (N, K+1); index: (N, K)."""
    N, K = index.shape
    labels = np.empty(N, np.int64)
    for i in range(N):
        best = 0
        for k in range(1, K + 1):
            if log_association[i, k] > log_association[i, best]:
                best = k
        labels[i] = index[i, best] if best < K else -1
    return labels


@kernel
def associate(
    model: AssociationModel,
    pair: AssociationPair,
    work: Workspace,
    index: Integers,
    mask: Booleans,
    limit: Limit,
    moved: Array,
    seen_through: Array,
    hidden: Array,
    extra: Array,
) -> tuple[Array, Integers]:
    """An exact pass over the chain, every point moved by its cluster's motion (`inference.joint.update_association`).

    Args:
        work: of the same N and K; the same one for all rounds of a pair.
        index, mask: (N, K) candidates, real ones first and ascending. limit: of outliers.
        moved: (N, 2) source points under their own motion. seen_through, hidden: (N,) their free-space tests in the target.
        extra: (N,) learned log potential of the outlier.

    Returns:
        (N, K+1) log-beliefs, the outlier last, and (N,) labels: target point or -1.
    """
    update_static(model, pair, work, index, mask)
    log_unary = log_unary_of(model, pair, work, limit, moved, seen_through, hidden)
    for i in range(len(extra)):
        log_unary[i, -1] += extra[i]
    if model.weights[STRETCH] == 0 and model.weights[SHIFT] == 0:
        log_association = beliefs_in_sequence(log_unary, index, model.weights[SEQUENCE], *_touching_outlier(model))
    else:
        log_association = max_marginals(log_unary, log_pairwise_of(model, pair, index))
    return log_association, association_labels(log_association, index)


@kernel
def best_clusters(active: Booleans, log_cluster: Array) -> Integers:
    """(N,) best active inlier cluster of every point. active: (C,); log_cluster: (N, D), the outlier last."""
    labels = np.zeros(len(log_cluster), np.int64)
    for i in range(len(log_cluster)):
        largest = -np.inf
        for c in range(len(active)):
            if active[c] and log_cluster[i, c] > largest:
                labels[i], largest = c, log_cluster[i, c]
    return labels


@kernel
def registered_points(source: Array, motions: Array, active: Booleans, log_cluster: Array) -> Array:
    """(N, 2) source points under the best active inlier cluster each (A-12).

    source: (N, 2); motions: (C, 3); active: (C,); log_cluster: (N, D), the outlier last.
    """
    best, moved = best_clusters(active, log_cluster), np.empty_like(source)
    transforms = [transform_of(motions[c]) for c in range(len(active))]
    for i in range(len(source)):
        moved[i, 0], moved[i, 1] = transform(transforms[best[i]], source[i, 0], source[i, 1])
    return moved
