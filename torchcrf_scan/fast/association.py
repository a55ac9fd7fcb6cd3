"""The association chain of one pair: potentials with the weights put in on the fly, and an exact pass over the chain.

Does what `features.association`, `features.extension` and `inference.joint.update_association` do. What does not depend on the
motions is kept from round to round.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from torchcrf_scan.fast.boosting import Stumps, add_margins, double_array, margin, stumps_of
from torchcrf_scan.fast.robust import robust_square
from torchcrf_scan.features.extension import FARTHEST_EXCESS
from torchcrf_scan.features.scales import ASSOCIATION_WEIGHTS, GATE_WIDTH, KAPPA, LOCAL_CHANNELS, SHAPE_CHANNELS, STATIC_CHANNELS
from torchcrf_scan.inference.state import Parameters
from torchcrf_scan.loops.jit import Array, Booleans, Integers, kernel
from torchcrf_scan.loops.messages import exp_below, log_softmax, max_marginals
from torchcrf_scan.loops.rigid import apply, transform, transform_of
from torchcrf_scan.loops.shape import Shape

REGISTERED, RADIUS = STATIC_CHANNELS, SHAPE_CHANNELS
LENGTHS = 12  # to three neighbours on either side, straight and along the scan
DESCRIPTORS = 18  # numbers kept of a point: the lengths, three angles, the radius, x and y
BEST_MARGIN, LEAD = len(LOCAL_CHANNELS), len(LOCAL_CHANNELS) + 1  # inputs of the outlier booster
TOGETHER = 256  # pairs of points whose features are computed at once: few enough to stay in the fastest cache
ANOTHER_PLACE = 3  # target points away
DATA_BOOSTING, OUTLIER_BOOSTING, EXCESS, GATE, OUTLIER_BIAS, SEEN_THROUGH, HIDDEN, SEQUENCE, SWITCH, STRETCH, SHIFT = (
    ASSOCIATION_WEIGHTS.index(name)
    for name in (
        *("data_boosting", "outlier_boosting", "excess", "gate", "outlier_bias", "outlier_seen_through", "outlier_hidden"),
        *("sequence", "pairwise_outlier", "pairwise_distance", "pairwise_translation"),
    )
)


class AssociationModel(NamedTuple):
    """What was learned of the association chain (`features.scales.Scales`).

    Attributes:
        weights: (23,). per_local: (12,), per_pairwise: (2,) one over the scales. local_outlier: (12,). pairwise_outlier: (2,).
    """

    weights: Array
    per_local: Array
    local_outlier: Array
    per_pairwise: Array
    pairwise_outlier: Array
    cluster_distance: float
    gate: float
    data: Stumps
    outlier: Stumps


def association_model(parameters: Parameters) -> AssociationModel:
    """The parameters as arrays; build it once."""
    scales = parameters.scales
    buffers = (scales.local, scales.local_outlier, scales.pairwise, scales.pairwise_outlier)
    local, local_outlier, pairwise, pairwise_outlier = (double_array(values) for values in buffers)
    weights = double_array(parameters.association)
    data, outlier = stumps_of(parameters.boosters.data), stumps_of(parameters.boosters.outlier)
    arrays = weights, 1 / local, local_outlier, 1 / pairwise, pairwise_outlier
    return AssociationModel(*arrays, float(scales.cluster_distance), float(scales.gate), data, outlier)


class AssociationPair(NamedTuple):
    """Two scans as the chain sees them, in the unit of the features.

    Attributes:
        source: (N, 2), target: (M, 2) points.
        of_source: (N, 18), of_target: (M, 18) what surrounds them: lengths in the order of channels L1..L3 and L7..L9, after and
            before the point in turn, angles, radius, and the position, that of the source under the initial motion.
    """

    source: Array
    target: Array
    of_source: Array
    of_target: Array


class Workspace(NamedTuple):
    """What is kept from round to round, filled in by `associate`; answers do not depend on it.

    Attributes:
        is_known: (N,) whether the rest is there. candidates, mask: (N, K) what it is of.
        score: (N, K) weighted sum of the static channels. margin: (N, K) data booster of them.
        outlier_margin: (N,) outlier booster of the best of every static channel.
    """

    is_known: Booleans
    candidates: Integers
    mask: Booleans
    score: Array
    margin: Array
    outlier_margin: Array


@kernel
def workspace(N: int, K: int) -> Workspace:
    """An empty one for N source points with K candidates each."""
    index, mask = np.empty((N, K), np.int64), np.empty((N, K), np.bool_)
    return Workspace(np.zeros(N, np.bool_), index, mask, np.zeros((N, K)), np.zeros((N, K)), np.empty(N))


@kernel
def _packed(shape: Shape, points: Array) -> Array:
    """(P, 18) descriptors of every point in a row."""
    packed = np.empty((len(points), DESCRIPTORS))
    for i in range(len(points)):
        for order in range(3):
            for side in range(2):
                packed[i, 2 * order + side] = shape.distance[i, order, side]
                packed[i, 6 + 2 * order + side] = shape.geodesic[i, order, side]
            packed[i, LENGTHS + order] = shape.angle[i, order]
        packed[i, LENGTHS + 3] = shape.radius[i]
        packed[i, LENGTHS + 4], packed[i, LENGTHS + 5] = points[i, 0], points[i, 1]
    return packed


@kernel
def association_pair(source: Array, target: Array, of_source: Shape, of_target: Shape, initial_motion: Array) -> AssociationPair:
    """source: (N, 2), target: (M, 2) and their shapes, in the unit of the features; initial_motion: (3,)."""
    return AssociationPair(source, target, _packed(of_source, apply(initial_motion, source)), _packed(of_target, target))


@kernel
def _add_square(errors: Array, per_scale: float, share: float, channel: Array) -> None:
    """Adds a share of the robust squares. errors, channel: (P,)."""
    for p in range(len(errors)):
        channel[p] += share * robust_square(errors[p], per_scale)


@kernel
def _static_channels(errors: Array, per_local: Array) -> Array:
    """(11, P) channels L1..L11 of P pairs of points. errors: (18, P) differences of their descriptors; scratch."""
    channels = np.zeros((STATIC_CHANNELS, errors.shape[1]))
    for side in range(LENGTHS):
        order, is_along = side % 6 // 2, side // 6
        c = order + 6 * is_along
        _add_square(errors[side], per_local[c], 0.5, channels[c])
    for order in range(3):
        turn = errors[LENGTHS + order]
        for p in range(len(turn)):
            turn[p] = min(abs(turn[p]), 2 * math.pi - abs(turn[p]))
        _add_square(turn, per_local[3 + order], 1.0, channels[3 + order])
    _add_square(errors[LENGTHS + 3], per_local[RADIUS], 1.0, channels[RADIUS])
    dx, dy = errors[LENGTHS + 4], errors[LENGTHS + 5]
    for p in range(len(dx)):
        dx[p] = math.sqrt(dx[p] * dx[p] + dy[p] * dy[p])
    _add_square(dx, per_local[RADIUS + 1], 1.0, channels[RADIUS + 1])
    return channels


@kernel
def _differences(pair: AssociationPair, work: Workspace, points: Integers) -> Array:
    """(18, R K) of the descriptors of some source points (R,) and their candidates; 0 for those that are not real."""
    K = work.candidates.shape[1]
    errors = np.zeros((DESCRIPTORS, len(points) * K))
    for r in range(len(points)):
        here = pair.of_source[points[r]]
        for k in range(K):
            if work.mask[points[r], k]:
                there = pair.of_target[work.candidates[points[r], k]]
                for d in range(DESCRIPTORS):
                    errors[d, r * K + k] = here[d] - there[d]
    return errors


@kernel
def _best_of_points(channels: Array, mask: Booleans, points: Integers) -> Array:
    """(11, R) the best of every channel over the real candidates; the worst there is without one. channels: (11, R K)."""
    K = mask.shape[1]
    best = np.full((STATIC_CHANNELS, len(points)), -KAPPA)  # which no channel is below
    for c in range(STATIC_CHANNELS):
        for r in range(len(points)):
            row = channels[c, r * K : (r + 1) * K]
            for k in range(K):
                if mask[points[r], k]:
                    best[c, r] = max(best[c, r], row[k])
    return best


@kernel
def _update_points(model: AssociationModel, pair: AssociationPair, work: Workspace, points: Integers) -> None:
    """Computes what is kept of some source points (R,) from their candidates."""
    K = work.candidates.shape[1]
    channels = _static_channels(_differences(pair, work, points), model.per_local)
    best = _best_of_points(channels, work.mask, points)
    score, boosted, outlier = np.zeros(channels.shape[1]), np.zeros(channels.shape[1]), np.zeros(len(points))
    for c in range(STATIC_CHANNELS):
        weight, channel = model.weights[c], channels[c]
        for p in range(len(score)):
            score[p] += weight * channel[p]
        add_margins(model.data, c, channel, boosted)
        add_margins(model.outlier, c, best[c], outlier)
    for r in range(len(points)):
        i = points[r]
        work.outlier_margin[i] = outlier[r]
        for k in range(K):
            work.score[i, k], work.margin[i, k] = score[r * K + k], boosted[r * K + k]


@kernel
def _has_changed(i: int, index: Integers, mask: Booleans, work: Workspace) -> bool:
    """Whether source point i has other candidates than those of the workspace."""
    is_same = True
    for k in range(index.shape[1]):
        is_same = is_same and index[i, k] == work.candidates[i, k] and mask[i, k] == work.mask[i, k]
    return not is_same


@kernel
def update_static(model: AssociationModel, pair: AssociationPair, work: Workspace, index: Integers, mask: Booleans) -> None:
    """Brings the workspace up to date with the candidates (N, K)."""
    N, K = index.shape
    block = max(TOGETHER // max(K, 1), 1)
    points, R = np.empty(block, np.int64), 0
    for i in range(N):
        if work.is_known[i] and not _has_changed(i, index, mask, work):
            continue
        for k in range(K):
            work.candidates[i, k], work.mask[i, k] = index[i, k], mask[i, k]
        work.is_known[i] = True
        points[R] = i
        R += 1
        if len(points) == R:
            _update_points(model, pair, work, points)
            R = 0
    if R > 0:
        _update_points(model, pair, work, points[:R])


@kernel
def _sigmoid(x: float) -> float:
    below = exp_below(-abs(x))
    return (1.0 if x > 0 else below) / (1 + below)


@kernel
def _distances(pair: AssociationPair, work: Workspace, moved: Array) -> tuple[Array, Array]:
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
def _outlier_margin(model: AssociationModel, work: Workspace, i: int, registered: float, margin_of: Array) -> float:
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
    model: AssociationModel, pair: AssociationPair, work: Workspace, moved: Array, seen_through: Array, hidden: Array
) -> Array:
    """(N, K+1) log potentials of the workspace's candidates and, last, of the outlier.

    moved: (N, 2) source points under their own motion; seen_through, hidden: (N,) what the target's beams say of them.
    """
    N, K = work.candidates.shape
    weights = model.weights
    distance, nearest = _distances(pair, work, moved)
    registered, values, boosted = np.empty(N * K), np.zeros(N * K), np.zeros(N * K)
    for p in range(N * K):  # long loops without branches, several pairs at once
        registered[p] = robust_square(distance[p], model.per_local[REGISTERED])
    add_margins(model.data, REGISTERED, registered, boosted)
    if weights[GATE] != 0:
        for p in range(N * K):
            values[p] -= weights[GATE] * _sigmoid((distance[p] / model.gate - 1) / GATE_WIDTH)
    constant = weights[OUTLIER_BIAS]
    for c in range(len(LOCAL_CHANNELS)):
        constant += weights[c] * model.local_outlier[c]
    log_unary = np.empty((N, K + 1))
    for i in range(N):
        margins = boosted[i * K : (i + 1) * K]
        for k in range(K):
            p = i * K + k
            margins[k] += work.margin[i, k]
            excess = min((distance[p] - nearest[i]) / model.cluster_distance, FARTHEST_EXCESS)
            value = values[p] + work.score[i, k] + weights[REGISTERED] * registered[p] + weights[DATA_BOOSTING] * margins[k]
            log_unary[i, k] = value - weights[EXCESS] * excess if work.mask[i, k] else -np.inf
        value = constant + weights[SEEN_THROUGH] * seen_through[i] + weights[HIDDEN] * hidden[i]
        if weights[OUTLIER_BOOSTING] != 0:
            best = robust_square(nearest[i], model.per_local[REGISTERED])
            value += weights[OUTLIER_BOOSTING] * _outlier_margin(model, work, i, best, margins)
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
    """A message over an edge that asks only for sequence and outliers: time grows with K, not its square.

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
    """(N, K+1) `max_marginals` of a chain whose edges ask only for sequence and outliers. index: (N, K), ascending where real."""
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
    moved: Array,
    seen_through: Array,
    hidden: Array,
    extra: Array,
) -> tuple[Array, Integers]:
    """An exact pass over the chain, every point moved by its cluster's motion (`inference.joint.update_association`).

    Args:
        work: of the same N and K; the same one for all rounds of a pair.
        index, mask: (N, K) candidates, real ones first and ascending.
        moved: (N, 2) source points under their own motion. seen_through, hidden: (N,) what the target's beams say of them.
        extra: (N,) learned log potential of the outlier.

    Returns:
        (N, K+1) log-beliefs, the outlier last, and (N,) labels: target point or -1.
    """
    update_static(model, pair, work, index, mask)
    log_unary = log_unary_of(model, pair, work, moved, seen_through, hidden)
    for i in range(len(extra)):
        log_unary[i, -1] += extra[i]
    if model.weights[STRETCH] == 0 and model.weights[SHIFT] == 0:
        log_association = beliefs_in_sequence(log_unary, index, model.weights[SEQUENCE], *_touching_outlier(model))
    else:
        log_association = max_marginals(log_unary, log_pairwise_of(model, pair, index))
    return log_association, association_labels(log_association, index)


@kernel
def registered_points(source: Array, motions: Array, active: Booleans, log_cluster: Array) -> Array:
    """(N, 2) source points under the best active inlier cluster each (A-12).

    source: (N, 2); motions: (C, 3); active: (C,); log_cluster: (N, D), the outlier last.
    """
    C, moved = len(active), np.empty_like(source)
    transforms = [transform_of(motions[c]) for c in range(C)]
    for i in range(len(source)):
        best, largest = 0, -np.inf
        for c in range(C):
            if active[c] and log_cluster[i, c] > largest:
                best, largest = c, log_cluster[i, c]
        moved[i, 0], moved[i, 1] = transform(transforms[best], source[i, 0], source[i, 1])
    return moved
