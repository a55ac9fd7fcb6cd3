"""The way back through the association chain: slopes of weights, motions and learned potentials from slopes of its beliefs."""

from __future__ import annotations

import math

import numpy as np

from torchcrf_scan.adjoint.motion import add_moved
from torchcrf_scan.fast.arrays import Scene, State
from torchcrf_scan.fast.association import (
    DATA_BOOSTING,
    EXCESS,
    GATE,
    HIDDEN,
    OUTLIER_BIAS,
    OUTLIER_BOOSTING,
    REGISTERED,
    SEEN_THROUGH,
    SEQUENCE,
    SHIFT,
    STRETCH,
    SWITCH,
    best_clusters,
    distances,
    log_pairwise_of,
    log_unary_of,
    outlier_margin,
)
from torchcrf_scan.fast.boosting import add_margins
from torchcrf_scan.fast.free_space import look_slope
from torchcrf_scan.fast.limit import Limit, sigmoid, slope_within
from torchcrf_scan.fast.robust import robust_slope, robust_square
from torchcrf_scan.fast.static_features import (
    AssociationModel,
    AssociationPair,
    Workspace,
    differences,
    static_channels,
    update_static,
)
from torchcrf_scan.features.extension import FARTHEST_EXCESS
from torchcrf_scan.features.scales import GATE_WIDTH
from torchcrf_scan.loops.jit import Array, Booleans, Integers, kernel
from torchcrf_scan.loops.pull_messages import pull_max_marginals
from torchcrf_scan.names import STATIC_CHANNELS

TOGETHER = 32  # source points whose channels are computed at once


@kernel
def pull_static(model: AssociationModel, pair: AssociationPair, work: Workspace, slopes: Array, weights: Array) -> None:
    """Adds the slopes of the weights of the channels L1..L11. slopes: (N, K+1) of the potentials of nodes."""
    N, K = work.candidates.shape
    for begin in range(0, N, TOGETHER):
        points = np.arange(begin, min(begin + TOGETHER, N))
        channels = static_channels(differences(pair, work, points), model.per_local)
        for c in range(STATIC_CHANNELS):
            channel, total = channels[c], 0.0
            for r in range(len(points)):
                for k in range(K):
                    total += slopes[begin + r, k] * channel[r * K + k]
            weights[c] += total


@kernel
def pull_outlier(
    model: AssociationModel,
    work: Workspace,
    i: int,
    nearest: float,
    margins: Array,
    slope: float,
    seen_through: float,
    hidden: float,
    weights: Array,
) -> None:
    """Adds the slopes of the outlier's weights at source point i. nearest: distance of its nearest candidate; margins: (K,)."""
    for c in range(STATIC_CHANNELS + 1):
        weights[c] += slope * model.local_outlier[c]
    best = robust_square(nearest, model.per_local[REGISTERED])
    weights[OUTLIER_BOOSTING] += slope * outlier_margin(model, work, i, best, margins)
    weights[OUTLIER_BIAS] += slope
    weights[SEEN_THROUGH] += slope * seen_through
    weights[HIDDEN] += slope * hidden


@kernel
def pull_distances(
    model: AssociationModel,
    work: Workspace,
    limit: Limit,
    i: int,
    distance: Array,
    nearest: float,
    margins: Array,
    slopes: Array,
    weights: Array,
) -> Array:
    """(K,) slopes of the distances of source point i to its candidates; adds those of the weights. slopes: (K+1,)."""
    K = len(distance)
    w, to_distance, to_nearest, closest = model.weights, np.zeros(K), 0.0, 0
    for k in range(K):
        if not work.mask[i, k]:
            continue
        if distance[k] < distance[closest]:
            closest = k
        slope, gap = slopes[k], (distance[k] - nearest) / model.cluster_distance
        beyond = sigmoid((distance[k] / model.gate - 1) / GATE_WIDTH)
        weights[REGISTERED] += slope * robust_square(distance[k], model.per_local[REGISTERED])
        weights[DATA_BOOSTING] += slope * margins[k]
        weights[EXCESS] -= slope * min(gap, FARTHEST_EXCESS)
        weights[GATE] -= slope * beyond
        to_distance[k] = slope * w[REGISTERED] * robust_slope(distance[k], model.per_local[REGISTERED])
        to_distance[k] -= slope * w[GATE] * beyond * (1 - beyond) / (model.gate * GATE_WIDTH)
        if limit.distance > 0:
            to_distance[k] += slope * slope_within(limit, distance[k])
        if gap <= FARTHEST_EXCESS:
            to_distance[k] -= slope * w[EXCESS] / model.cluster_distance
            to_nearest += slope * w[EXCESS] / model.cluster_distance
    to_distance[closest] += to_nearest
    return to_distance


@kernel
def pull_edges(model: AssociationModel, pair: AssociationPair, index: Integers, slopes: Array, weights: Array) -> None:
    """Adds the slopes of the weights of edges. slopes: (N-1, K+1, K+1)."""
    K, source, target = index.shape[1], pair.source, pair.target
    for i in range(len(slopes)):
        ux, uy = source[i + 1, 0] - source[i, 0], source[i + 1, 1] - source[i, 1]
        length, to_outlier = math.sqrt(ux * ux + uy * uy), slopes[i, K, K]
        for s in range(K):
            to_outlier += slopes[i, s, K] + slopes[i, K, s]
            weights[SWITCH] += slopes[i, s, K] + slopes[i, K, s]
            a = index[i, s]
            for t in range(K):
                slope, b = slopes[i, s, t], index[i + 1, t]
                if slope == 0:
                    continue
                vx, vy = target[b, 0] - target[a, 0], target[b, 1] - target[a, 1]
                stretch, shift = length - math.sqrt(vx * vx + vy * vy), math.sqrt((ux - vx) ** 2 + (uy - vy) ** 2)
                weights[SEQUENCE] += slope if b - a == 1 else 0.0
                weights[STRETCH] += slope * robust_square(stretch, model.per_pairwise[0])
                weights[SHIFT] += slope * robust_square(shift, model.per_pairwise[1])
        weights[STRETCH] += to_outlier * model.pairwise_outlier[0]
        weights[SHIFT] += to_outlier * model.pairwise_outlier[1]


@kernel
def pull_nodes(
    scene: Scene,
    model: AssociationModel,
    work: Workspace,
    moved: Array,
    seen_through: Array,
    hidden: Array,
    slopes: Array,
    weights: Array,
) -> Array:
    """(N, 2) slopes of the moved points through the potentials of nodes; adds those of the weights. slopes: (N, K+1)."""
    N, K = work.candidates.shape
    distance, nearest = distances(scene.descriptors, work, moved)
    registered, boosted, to_moved = np.empty(N * K), np.zeros(N * K), np.zeros((N, 2))
    for p in range(N * K):
        registered[p] = robust_square(distance[p], model.per_local[REGISTERED])
    add_margins(model.data, REGISTERED, registered, boosted)
    w = model.weights
    pull_static(model, scene.descriptors, work, slopes, weights)
    for i in range(N):
        margins, gaps = boosted[i * K : (i + 1) * K] + work.margin[i], distance[i * K : (i + 1) * K]
        pull_outlier(model, work, i, nearest[i], margins, slopes[i, K], seen_through[i], hidden[i], weights)
        to_distance = pull_distances(model, work, scene.limit, i, gaps, nearest[i], margins, slopes[i], weights)
        to_seen, to_hidden = slopes[i, K] * w[SEEN_THROUGH], slopes[i, K] * w[HIDDEN]
        to_moved[i, 0], to_moved[i, 1] = look_slope(scene.target_sweep, moved[i, 0], moved[i, 1], to_seen, to_hidden)
        for k in range(K):
            if work.mask[i, k] and gaps[k] > 0:
                j, share = work.candidates[i, k], to_distance[k] / gaps[k]
                to_moved[i, 0] += share * (moved[i, 0] - scene.target[j, 0])
                to_moved[i, 1] += share * (moved[i, 1] - scene.target[j, 1])
    return to_moved


@kernel
def pull_associate(
    scene: Scene,
    after: State,
    between: Array,
    active: Booleans,
    moved: Array,
    seen_through: Array,
    hidden: Array,
    model: AssociationModel,
    work: Workspace,
    slopes: Array,
    weights: Array,
    outlier: Array,
    to_motions: Array,
) -> None:
    """Adds the slopes through an exact pass over the chain, `fast.association.associate`.

    Args:
        after: state after the pass. between: (C, 3) motions, active: (C,) bool, at which it was made.
        moved: (N, 2) points under their own motions. seen_through, hidden: (N,) their free-space tests.
        slopes: (N, K+1) of the beliefs.
        weights: (23,), outlier: (N,), to_motions: (C, 3), slopes added to.
    """
    mask = np.full(after.candidates.shape, True)
    update_static(model, scene.descriptors, work, after.candidates, mask)
    log_unary = log_unary_of(model, scene.descriptors, work, scene.limit, moved, seen_through, hidden)
    for i in range(len(log_unary)):
        log_unary[i, -1] += scene.outlier[i]
    log_pairwise = log_pairwise_of(model, scene.descriptors, after.candidates)
    nodes, edges = pull_max_marginals(log_unary, log_pairwise, after.log_association, slopes)
    pull_edges(model, scene.descriptors, after.candidates, edges, weights)
    to_moved = pull_nodes(scene, model, work, moved, seen_through, hidden, nodes, weights)
    best = best_clusters(active, after.log_cluster)
    for i in range(len(moved)):
        outlier[i] += nodes[i, -1]
        add_moved(to_motions[best[i]], between[best[i]], moved[i, 0], moved[i, 1], to_moved[i, 0], to_moved[i, 1])
