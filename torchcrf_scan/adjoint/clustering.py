"""The way back through the clustering chain: slopes of weights, motions and learned potentials from slopes of its beliefs."""

from __future__ import annotations

import math

import numpy as np

from torchcrf_scan.adjoint.motion import add_moved
from torchcrf_scan.fast.arrays import Scene, State
from torchcrf_scan.fast.clustering import (
    ClusteringModel,
    Tables,
    distance,
    nearest_to_all,
    node_potentials,
    transition_potentials,
)
from torchcrf_scan.fast.free_space import look, look_slope
from torchcrf_scan.fast.limit import slope_within
from torchcrf_scan.fast.robust import robust_slope, robust_square
from torchcrf_scan.features.scales import GATE_WIDTH
from torchcrf_scan.loops.jit import Array, Integers, kernel
from torchcrf_scan.loops.pull_messages import pull_max_marginals
from torchcrf_scan.loops.rigid import inverse, rotate, transform, transform_of
from torchcrf_scan.names import CLUSTERING_DECISIONS, CLUSTERING_EDGE, CLUSTERING_FREE_SPACE, CLUSTERING_WEIGHTS, PAPERS_CLUSTER

DISTANCE, OUTLIER, INLIER_IN, INLIER_OUT = (CLUSTERING_WEIGHTS.index(name) for name in PAPERS_CLUSTER)
GATE, OUTLIER_BIAS = (CLUSTERING_WEIGHTS.index(name) for name in CLUSTERING_DECISIONS)
SEEN_THROUGH, SEEN_THROUGH_BACK, HIDDEN, HIDDEN_BACK, OUTLIER_SEEN_THROUGH, OUTLIER_HIDDEN = (
    CLUSTERING_WEIGHTS.index(name) for name in CLUSTERING_FREE_SPACE
)
REACH = CLUSTERING_WEIGHTS.index("reach")
SEQUENCE, WEIGHT_SAME, WEIGHT_DIFFERENT, STIFFNESS_SAME, STIFFNESS_DIFFERENT, DISTANCE_SAME, DISTANCE_DIFFERENT, SWITCH = (
    CLUSTERING_WEIGHTS.index(name) for name in CLUSTERING_EDGE
)


@kernel
def pull_outlier(state: State, tables: Tables, states: Integers, limit: float, slopes: Array, weights: Array) -> None:
    """Adds the slopes of the outlier's weights. slopes: (N,) of its potentials; limit: residual that no motion explains."""
    for i in range(len(slopes)):
        least = np.inf
        for s in range(len(states)):
            least = min(least, tables.residual[states[s], i])
        weights[OUTLIER] += slopes[i] if least > limit else 0.0
        weights[OUTLIER_BIAS] += slopes[i]
        weights[INLIER_OUT] += slopes[i] if state.association[i] < 0 else 0.0


@kernel
def pull_residual(
    scene: Scene, state: State, tables: Tables, nearest: Integers, c: int, model: ClusteringModel, slopes: Array, weights: Array
) -> Array:
    """(N, 2) slopes of the points moved by cluster c through their residuals; adds those of the weights.

    nearest: (N,) nearest target point of a point without a partner. slopes: (N,) of the cluster's potentials.
    """
    w, to_moved = model.weights, np.zeros((len(slopes), 2))
    for i in range(len(slopes)):
        if slopes[i] == 0:
            continue
        residual = tables.residual[c, i]
        beyond = 1 / (1 + math.exp(-(residual / model.gate - 1) / GATE_WIDTH))
        weights[DISTANCE] += slopes[i] * robust_square(residual, 1 / model.cluster_distance)
        weights[GATE] -= slopes[i] * beyond
        weights[REACH] += slopes[i] * robust_square(scene.reach[i, c], 1.0)
        weights[INLIER_IN] += slopes[i] if state.association[i] >= 0 else 0.0
        slope = w.cluster_distance * robust_slope(residual, 1 / model.cluster_distance)
        slope -= w.gate * beyond * (1 - beyond) / (model.gate * GATE_WIDTH)
        if residual > 0:
            j = state.association[i] if state.association[i] >= 0 else nearest[i]
            share = slopes[i] * slope / residual
            to_moved[i, 0] = share * (tables.moved[c, i, 0] - scene.target[j, 0])
            to_moved[i, 1] = share * (tables.moved[c, i, 1] - scene.target[j, 1])
    return to_moved


@kernel
def pull_limit(scene: Scene, moved: Array, nearest: Integers, slopes: Array, to_moved: Array) -> None:
    """Adds the slopes of (N, 2) points moved by a cluster through the limit of outliers.

    nearest: (N,) their nearest target points. slopes: (N,) of the cluster's potentials.
    """
    for i in range(len(slopes)):
        dx, dy = moved[i, 0] - scene.target[nearest[i], 0], moved[i, 1] - scene.target[nearest[i], 1]
        gap = distance(dx, dy)
        if slopes[i] != 0 and gap > 0:
            share = slopes[i] * slope_within(scene.limit, gap) / gap
            to_moved[i, 0] += share * dx
            to_moved[i, 1] += share * dy


@kernel
def pull_ahead(
    scene: Scene, moved: Array, model: ClusteringModel, slopes: Array, of_outlier: Array, to_moved: Array, weights: Array
) -> None:
    """Adds the slopes through the free-space tests of (N, 2) moved points in the target.

    slopes: (N,) of the cluster's potentials; of_outlier: (N,) of the outlier's, for the background, (0,) for movers.
    """
    w, is_background = model.weights, len(of_outlier) > 0
    for i in range(len(moved)):
        outlier = of_outlier[i] if is_background else 0.0
        if slopes[i] == 0 and outlier == 0:
            continue
        seen_through, hidden = look(scene.target_sweep, moved[i, 0], moved[i, 1])
        if seen_through == 0 and hidden == 0:
            continue
        weights[SEEN_THROUGH] -= slopes[i] * seen_through
        weights[HIDDEN] -= slopes[i] * hidden
        weights[OUTLIER_SEEN_THROUGH] += outlier * seen_through
        weights[OUTLIER_HIDDEN] += outlier * hidden
        to_seen = outlier * w.outlier_seen_through - slopes[i] * w.seen_through
        to_hidden = outlier * w.outlier_hidden - slopes[i] * w.hidden
        gx, gy = look_slope(scene.target_sweep, moved[i, 0], moved[i, 1], to_seen, to_hidden)
        to_moved[i, 0] += gx
        to_moved[i, 1] += gy


@kernel
def pull_back(scene: Scene, state: State, c: int, model: ClusteringModel, slopes: Array, weights: Array, to_motion: Array) -> None:
    """Adds the slopes through the free-space tests of the points' partners in the source. slopes: (N,); to_motion: (3,)."""
    w, motion = model.weights, state.motions[c]
    by, forth = transform_of(inverse(motion)), transform_of(motion)
    for i in range(len(slopes)):
        j = state.association[i]
        if j < 0 or slopes[i] == 0:
            continue
        x, y = transform(by, scene.target[j, 0], scene.target[j, 1])
        seen_through, hidden = look(scene.source_sweep, x, y)
        if seen_through == 0 and hidden == 0:
            continue
        weights[SEEN_THROUGH_BACK] -= slopes[i] * seen_through
        weights[HIDDEN_BACK] -= slopes[i] * hidden
        to_seen, to_hidden = -slopes[i] * w.seen_through_back, -slopes[i] * w.hidden_back
        gx, gy = look_slope(scene.source_sweep, x, y, to_seen, to_hidden)
        fx, fy = rotate(forth, gx, gy)
        to_motion[0] += gx * y - gy * x
        to_motion[1] -= fx
        to_motion[2] -= fy


@kernel
def pull_edges(
    scene: Scene,
    state: State,
    tables: Tables,
    states: Integers,
    model: ClusteringModel,
    slopes: Array,
    weights: Array,
    to_motions: Array,
) -> None:
    """Adds the slopes through the edges. slopes: (N-1, P+1, P+1), states: (P,) clusters of the chain; to_motions: (C, 3)."""
    P, w = len(states), model.weights
    for i in range(len(tables.length)):
        slope, length = slopes[i], tables.length[i]
        same = different = 0.0
        for s in range(P):
            for t in range(P):
                if s == t:
                    same += slope[s, s]
                elif slope[s, t] != 0:
                    different += slope[s, t]
                    a, b = states[s], states[t]
                    dx, dy = tables.moved[b, i + 1, 0] - tables.moved[a, i, 0], tables.moved[b, i + 1, 1] - tables.moved[a, i, 1]
                    gap = distance(dx, dy)
                    weights[DISTANCE_DIFFERENT] += slope[s, t] * robust_square(gap - length, 1 / model.neighbour_distance)
                    to_gap = robust_slope(gap - length, 1 / model.neighbour_distance) * slope[s, t] * w.neighbour_distance_different
                    gx, gy = (to_gap * dx / gap, to_gap * dy / gap) if gap > 0 else (0.0, 0.0)
                    add_moved(to_motions[b], state.motions[b], tables.moved[b, i + 1, 0], tables.moved[b, i + 1, 1], gx, gy)
                    add_moved(to_motions[a], state.motions[a], tables.moved[a, i, 0], tables.moved[a, i, 1], -gx, -gy)
            weights[SWITCH] += slope[s, P] + slope[P, s]
        weights[SEQUENCE] += same + slope[P, P]
        pull_stretch(scene, state, i, length, model, same, different, weights)


@kernel
def pull_stretch(
    scene: Scene, state: State, i: int, length: float, model: ClusteringModel, same: float, different: float, weights: Array
) -> None:
    """Adds the slopes of the weights of edge i that no motion changes. same, different: its slopes of one cluster and of two."""
    near = math.exp(-((length / model.neighbour_weight) ** 2))
    weights[WEIGHT_SAME] += same * near
    weights[WEIGHT_DIFFERENT] += different * (1 - near)
    a, b = state.association[i], state.association[i + 1]
    if a >= 0 and b >= 0:
        stretch = distance(scene.target[b, 0] - scene.target[a, 0], scene.target[b, 1] - scene.target[a, 1]) - length
        stiff = math.exp(-((stretch / model.neighbour_distance) ** 2))
        weights[STIFFNESS_SAME] += same * stiff
        weights[STIFFNESS_DIFFERENT] += different * (1 - stiff)
        weights[DISTANCE_SAME] += same * robust_square(stretch, 1 / model.neighbour_distance)


@kernel
def pull_cluster(
    scene: Scene,
    state: State,
    tables: Tables,
    nearest: Integers,
    log_cluster: Array,
    model: ClusteringModel,
    slopes: Array,
    weights: Array,
    outlier: Array,
    moving: Array,
    to_motions: Array,
) -> None:
    """Adds the slopes through an exact pass over the chain, `fast.clustering.cluster`.

    Args:
        state: before the pass. tables: at it. nearest: (N, C) of `nearest_to_outliers`. log_cluster: (N, D) beliefs after the pass.
        slopes: (N, D) of the beliefs.
        weights: (21,), outlier, moving: (N,), to_motions: (C, 3), slopes added to.
    """
    states = np.flatnonzero(state.active)
    N, P = len(log_cluster), len(states)
    beliefs, to_beliefs = np.empty((N, P + 1)), np.empty((N, P + 1))
    for i in range(N):
        for s in range(P + 1):
            c = states[s] if s < P else log_cluster.shape[1] - 1
            beliefs[i, s], to_beliefs[i, s] = log_cluster[i, c], slopes[i, c]
    log_unary = node_potentials(tables, states, model)
    log_pairwise = transition_potentials(tables, states, log_unary, model)
    nodes, edges = pull_max_marginals(log_unary, log_pairwise, beliefs, to_beliefs)
    of_outlier, of_cluster = nodes[:, P].copy(), np.empty(N)
    pull_outlier(state, tables, states, model.outlier_threshold, of_outlier, weights)
    pull_edges(scene, state, tables, states, model, edges, weights, to_motions)
    is_limited = scene.limit.distance > 0
    near = nearest_to_all(scene.boxes, scene.source, state.motions, state.active) if is_limited else nearest
    for s in range(P):
        c = states[s]
        of_cluster[:] = nodes[:, s]
        to_moved = pull_residual(scene, state, tables, nearest[:, c], c, model, of_cluster, weights)
        ahead = of_outlier if c == 0 else of_outlier[:0]
        if is_limited:
            pull_limit(scene, tables.moved[c], near[:, c], of_cluster, to_moved)
        pull_ahead(scene, tables.moved[c], model, of_cluster, ahead, to_moved, weights)
        pull_back(scene, state, c, model, of_cluster, weights, to_motions[c])
        for i in range(N):
            add_moved(to_motions[c], state.motions[c], tables.moved[c, i, 0], tables.moved[c, i, 1], to_moved[i, 0], to_moved[i, 1])
            moving[i] += of_cluster[i] if c > 0 else 0.0
    for i in range(N):
        outlier[i] += of_outlier[i]
