"""The clustering chain of one pair: potentials without feature tensors, and an exact pass.

The potentials are those of `features.clustering`, `features.extension` and `features.potentials`; the weights are applied on the
fly, and the cost is that of the existing clusters only.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from torchcrf_scan.fast.free_space import Sweep, look
from torchcrf_scan.fast.robust import robust_square
from torchcrf_scan.features.scales import GATE_WIDTH
from torchcrf_scan.loops.jit import Array, Booleans, Integers, kernel
from torchcrf_scan.loops.messages import max_marginals
from torchcrf_scan.loops.nearest import Boxes, nearest
from torchcrf_scan.loops.rigid import inverse, transform, transform_of
from torchcrf_scan.names import CLUSTERING_WEIGHTS

if TYPE_CHECKING:
    from torchcrf_scan.inference.state import Parameters


class ClusteringWeights(NamedTuple):
    """The chain's weights by their names in `CLUSTERING_WEIGHTS`."""

    cluster_distance: float
    outlier: float
    cluster_inlier_in: float
    cluster_inlier_out: float
    gate: float
    outlier_bias: float
    seen_through: float
    seen_through_back: float
    hidden: float
    hidden_back: float
    outlier_seen_through: float
    outlier_hidden: float
    reach: float
    sequence: float
    neighbour_weight_same: float
    neighbour_weight_different: float
    neighbour_stiffness_same: float
    neighbour_stiffness_different: float
    neighbour_distance_same: float
    neighbour_distance_different: float
    pairwise_outlier: float


class ClusteringModel(NamedTuple):
    """Fitted weights and scales of the clustering chain; the scales are those of `features.scales.Scales`."""

    weights: ClusteringWeights
    cluster_distance: float
    outlier_threshold: float
    gate: float
    neighbour_weight: float
    neighbour_distance: float


def clustering_model(parameters: Parameters) -> ClusteringModel:
    """The fitted weights and scales as numbers."""
    weights = dict(zip(CLUSTERING_WEIGHTS, parameters.clustering.detach().double().tolist(), strict=True))
    scales = parameters.scales
    return ClusteringModel(
        ClusteringWeights(**weights),
        float(scales.cluster_distance),
        float(scales.outlier_threshold),
        float(scales.gate),
        float(scales.neighbour_weight),
        float(scales.neighbour_distance),
    )


class Tables(NamedTuple):
    """Potentials of the chain at some motions and associations, before any of the clusters is left out.

    Attributes:
        moved: (C, N, 2) source points under every motion.
        residual: (C, N) distance to the associated target point, or to the nearest for an outlier; inf for inactive clusters.
        log_inlier: (C, N) node potentials of the clusters, -inf where impossible.
        log_outlier: (N,) those of the outlier, without the term for unexplained points (C2).
        length: (N-1,) of the edges. same, different: (N-1,) edge potentials of one cluster and of two, the latter without Q7.
    """

    moved: Array
    residual: Array
    log_inlier: Array
    log_outlier: Array
    length: Array
    same: Array
    different: Array


@kernel
def distance(dx: float, dy: float) -> float:
    """Length of a vector; without the overflow guards of `hypot`, which take several times as long."""
    return math.sqrt(dx * dx + dy * dy)


@kernel
def nearest_to_outliers(boxes: Boxes, source: Array, motions: Array, active: Booleans, association: Integers) -> Integers:
    """(N, C) nearest target point under every active motion, for points without a partner; 0 elsewhere.

    Args:
        boxes: of the target's M >= 1 points. source: (N, 2). motions: (C, 3). active: (C,). association: (N,), -1 outlier.
    """
    index = np.zeros((len(source), len(motions)), np.int64)
    for c in range(len(motions)):
        if not active[c]:
            continue
        by, guess = transform_of(motions[c]), 0
        for i in range(len(source)):
            if association[i] < 0:
                x, y = transform(by, source[i, 0], source[i, 1])
                guess = nearest(boxes, x, y, guess)[1]
                index[i, c] = guess
    return index


@kernel
def nearest_to_all(boxes: Boxes, source: Array, motions: Array, active: Booleans) -> Integers:
    """(N, C) nearest target point of every point under every active motion; 0 elsewhere. See `nearest_to_outliers`."""
    return nearest_to_outliers(boxes, source, motions, active, np.full(len(source), -1))


@kernel
def edge_potentials(source: Array, target: Array, association: Integers, model: ClusteringModel) -> tuple[Array, Array, Array]:
    """`length`, `same` and `different` of `Tables`. source: (N, 2); target: (M, 2); association: (N,)."""
    E = max(len(source) - 1, 0)
    w = model.weights
    length, same, different = np.empty(E), np.empty(E), np.empty(E)
    for i in range(E):
        length[i] = distance(source[i + 1, 0] - source[i, 0], source[i + 1, 1] - source[i, 1])
        near = math.exp(-((length[i] / model.neighbour_weight) ** 2))
        same[i] = w.sequence + w.neighbour_weight_same * near
        different[i] = w.neighbour_weight_different * (1 - near)
        a, b = association[i], association[i + 1]
        if a >= 0 and b >= 0:
            stretch = distance(target[b, 0] - target[a, 0], target[b, 1] - target[a, 1]) - length[i]
            stiff = math.exp(-((stretch / model.neighbour_distance) ** 2))
            same[i] += w.neighbour_stiffness_same * stiff
            same[i] += w.neighbour_distance_same * robust_square(stretch, 1 / model.neighbour_distance)
            different[i] += w.neighbour_stiffness_different * (1 - stiff)
    return length, same, different


@kernel
def fill_residual(
    source: Array,
    target: Array,
    motion: Array,
    association: Integers,
    nearest_target: Integers,
    c: int,
    moved: Array,
    residual: Array,
) -> None:
    """`moved` (N, 2) and `residual` (N,) of cluster c at its motion (3,). Other arguments as in `tabulate`."""
    by = transform_of(motion)
    for i in range(len(source)):
        x, y = transform(by, source[i, 0], source[i, 1])
        j = association[i] if association[i] >= 0 else nearest_target[i, c]
        moved[i, 0], moved[i, 1], residual[i] = x, y, distance(x - target[j, 0], y - target[j, 1])


@kernel
def fill_agreement(
    moved: Array, residual: Array, association: Integers, reach: Array, c: int, model: ClusteringModel, log_inlier: Array
) -> None:
    """Writes the potentials (N,) of cluster c without free-space tests, -inf where ruled out. See `tabulate` for the arguments."""
    w = model.weights
    for i in range(len(moved)):
        if reach[i, c] == np.inf:
            log_inlier[i] = -np.inf
            continue
        total = w.cluster_distance * robust_square(residual[i], 1 / model.cluster_distance)
        if w.gate != 0:
            total -= w.gate / (1 + math.exp(-(residual[i] / model.gate - 1) / GATE_WIDTH))
        if w.reach != 0:
            total += w.reach * robust_square(reach[i, c], 1.0)
        log_inlier[i] = total + (w.cluster_inlier_in if association[i] >= 0 else 0.0)


@kernel
def subtract_ahead(sweep: Sweep, moved: Array, model: ClusteringModel, log_inlier: Array, log_outlier: Array) -> None:
    """Subtracts the free-space penalties of (N, 2) moved points in the target, where they may be in the cluster.

    log_inlier: (N,). log_outlier: (N,), of the outlier, which gains by the background's penalties; (0,) for movers.
    """
    w = model.weights
    is_background = len(log_outlier) > 0
    if w.seen_through == 0 and w.hidden == 0 and not (is_background and (w.outlier_seen_through != 0 or w.outlier_hidden != 0)):
        return
    for i in range(len(moved)):
        if is_background or log_inlier[i] > -np.inf:
            seen_through, hidden = look(sweep, moved[i, 0], moved[i, 1])
            log_inlier[i] -= w.seen_through * seen_through + w.hidden * hidden
            if is_background:
                log_outlier[i] += w.outlier_seen_through * seen_through + w.outlier_hidden * hidden


@kernel
def subtract_back(
    sweep: Sweep, target: Array, motion: Array, association: Integers, model: ClusteringModel, log_inlier: Array
) -> None:
    """Subtracts the free-space penalties of the points' partners in the source. motion: (3,) of the cluster; log_inlier: (N,)."""
    w = model.weights
    if w.seen_through_back == 0 and w.hidden_back == 0:
        return
    by = transform_of(inverse(motion))
    for i in range(len(association)):
        j = association[i]
        if j >= 0 and log_inlier[i] > -np.inf:
            x, y = transform(by, target[j, 0], target[j, 1])
            seen_through, hidden = look(sweep, x, y)
            log_inlier[i] -= w.seen_through_back * seen_through + w.hidden_back * hidden


@kernel
def tabulate(
    source: Array,
    target: Array,
    source_sweep: Sweep,
    target_sweep: Sweep,
    motions: Array,
    active: Booleans,
    reach: Array,
    association: Integers,
    nearest_target: Integers,
    model: ClusteringModel,
) -> Tables:
    """All potentials at given motions and associations.

    Args:
        source: (N, 2); target: (M, 2), and their sweeps.
        motions: (C, 3). active: (C,) clusters that exist, the background among them.
        reach: (N, C) as in `fast.arrays.Scene`.
        association: (N,), -1 outlier. nearest_target: (N, C) nearest target point, of outliers at least.
    """
    N, C = len(source), len(motions)
    moved, residual, log_inlier, log_outlier = np.zeros((C, N, 2)), np.empty((C, N)), np.empty((C, N)), np.empty(N)
    for i in range(N):
        log_outlier[i] = model.weights.outlier_bias + (model.weights.cluster_inlier_out if association[i] < 0 else 0.0)
    for c in range(C):
        if active[c]:
            fill_residual(source, target, motions[c], association, nearest_target, c, moved[c], residual[c])
            fill_agreement(moved[c], residual[c], association, reach, c, model, log_inlier[c])
            subtract_ahead(target_sweep, moved[c], model, log_inlier[c], log_outlier if c == 0 else log_outlier[:0])
            subtract_back(source_sweep, target, motions[c], association, model, log_inlier[c])
        else:
            for i in range(N):
                residual[c, i], log_inlier[c, i] = np.inf, -np.inf
    length, same, different = edge_potentials(source, target, association, model)
    return Tables(moved, residual, log_inlier, log_outlier, length, same, different)


@kernel
def node_potentials(tables: Tables, states: Integers, model: ClusteringModel) -> Array:
    """(N, P + 1) of P clusters, and last of the outlier. states: (P,) clusters that exist."""
    N, P = len(tables.log_outlier), len(states)
    log_unary = np.empty((N, P + 1))
    for i in range(N):
        least = np.inf
        for s in range(P):
            log_unary[i, s] = tables.log_inlier[states[s], i]
            least = min(least, tables.residual[states[s], i])
        log_unary[i, P] = tables.log_outlier[i] + (model.weights.outlier if least > model.outlier_threshold else 0.0)
    return log_unary


@kernel
def transition_potentials(tables: Tables, states: Integers, log_unary: Array, model: ClusteringModel) -> Array:
    """(N-1, P + 1, P + 1) from every state to every state of the next point; finite. log_unary: output of `node_potentials`."""
    P, w = len(states), model.weights
    log_pairwise = np.empty((len(tables.length), P + 1, P + 1))
    for i in range(len(tables.length)):
        edge = log_pairwise[i]
        for s in range(P):
            is_possible = log_unary[i, s] > -np.inf
            x, y = tables.moved[states[s], i, 0], tables.moved[states[s], i, 1]
            for t in range(P):
                edge[s, t] = tables.same[i] if s == t else tables.different[i]
                if s != t and is_possible and log_unary[i + 1, t] > -np.inf:
                    k = states[t]
                    across = distance(tables.moved[k, i + 1, 0] - x, tables.moved[k, i + 1, 1] - y)
                    parting = robust_square(across - tables.length[i], 1 / model.neighbour_distance)
                    edge[s, t] += w.neighbour_distance_different * parting
            edge[s, P] = edge[P, s] = w.pairwise_outlier
        edge[P, P] = w.sequence
    return log_pairwise


@kernel
def cluster(tables: Tables, active: Booleans, model: ClusteringModel) -> tuple[Array, Integers]:
    """An exact pass over the chain: normalised log-beliefs (N, D), last of the outlier, and (N,) labels, -1 outlier.

    active: (C,) clusters that exist, no more than those of the tables.
    """
    N, C = len(tables.log_outlier), len(active)
    states = np.flatnonzero(active)
    P = len(states)
    log_unary = node_potentials(tables, states, model)
    some = max_marginals(log_unary, transition_potentials(tables, states, log_unary, model))
    log_beliefs, labels = np.empty((N, C + 1)), np.empty(N, np.int64)
    for i in range(N):
        best, labels[i] = -np.inf, -1
        for c in range(C):
            log_beliefs[i, c] = -np.inf
        for s in range(P):
            log_beliefs[i, states[s]] = some[i, s]
            if some[i, s] > best:
                best, labels[i] = some[i, s], states[s]
        log_beliefs[i, C] = some[i, P]
        if some[i, P] > best:
            labels[i] = -1
    return log_beliefs, labels
