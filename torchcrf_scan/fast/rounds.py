"""One round of Algorithm 1 for one pair: clustering chain, motions, association chain, motions; `inference.joint.step`."""

from __future__ import annotations

import math

import numpy as np

from torchcrf_scan.fast.arrays import Fitted, Scene, Settings, State
from torchcrf_scan.fast.association import associate, registered_points
from torchcrf_scan.fast.clustering import ClusteringModel, Tables, cluster, nearest_to_outliers, tabulate
from torchcrf_scan.fast.free_space import Sweep, look
from torchcrf_scan.fast.kept_candidates import Kept, update
from torchcrf_scan.fast.motion import count_points, estimate, retire_empty
from torchcrf_scan.fast.static_features import Workspace
from torchcrf_scan.inference.joint import ROBUST_SHARE
from torchcrf_scan.loops.jit import Array, Integers, kernel
from torchcrf_scan.loops.rigid import wrap


@kernel
def tables_of(scene: Scene, state: State, model: ClusteringModel) -> Tables:
    """Potentials of the clustering chain at a state's motions and associations."""
    nearest = nearest_to_outliers(scene.boxes, scene.source, state.motions, state.active, state.association)
    tables = tabulate(
        scene.source,
        scene.target,
        scene.source_sweep,
        scene.target_sweep,
        state.motions,
        state.active,
        scene.reach,
        state.association,
        nearest,
        model,
    )
    for i in range(len(scene.source)):
        tables.log_outlier[i] += scene.outlier[i]
        for c in range(1, len(state.motions)):
            tables.log_inlier[c, i] += scene.moving[i]
    return tables


@kernel
def nearest_clusters(tables: Tables, reach: Array, association: Integers) -> Integers:
    """(N,) cluster of finite reach (N, C) whose motion takes a point nearest to its partner; -1 without a partner."""
    labels = np.empty(len(association), np.int64)
    for i in range(len(labels)):
        least, best = np.inf, 0
        for c in range(len(tables.residual)):
            if reach[i, c] < np.inf and tables.residual[c, i] < least:
                least, best = tables.residual[c, i], c
        labels[i] = best if association[i] >= 0 else -1
    return labels


@kernel
def free_space_of(sweep: Sweep, points: Array) -> tuple[Array, Array]:
    """Free-space test of (N, 2) points: (N,) seen through and (N,) hidden, each from 0 to 1."""
    seen_through, hidden = np.empty(len(points)), np.empty(len(points))
    for i in range(len(points)):
        seen_through[i], hidden[i] = look(sweep, points[i, 0], points[i, 1])
    return seen_through, hidden


@kernel
def refit(scene: Scene, state: State, cluster: Integers, motions: Array, fitted: Fitted, settings: Settings) -> Array:
    """(C, 3) motions from a state's associations and (N,) cluster labels, from the motions (C, 3)."""
    return estimate(
        scene.source,
        scene.target,
        scene.tangents,
        state.association,
        cluster,
        motions,
        state.active,
        settings.metric,
        ROBUST_SHARE * fitted.clustering.cluster_distance,
        settings.min_extent,
    )


@kernel
def step(scene: Scene, state: State, tables: Tables, kept: Kept, work: Workspace, fitted: Fitted, settings: Settings) -> State:
    """One round: clustering chain, motions, association chain, motions. tables: at the state's motions and associations."""
    update(kept, scene.boxes, scene.source, tables.moved, state.motions, state.active)
    index = kept.index.copy()
    mask = np.full(index.shape, True)
    log_cluster, labels = cluster(tables, state.active, fitted.clustering)
    motions = refit(scene, state, labels, state.motions, fitted, settings)
    moved = registered_points(scene.source, motions, state.active, log_cluster)
    seen_through, hidden = free_space_of(scene.target_sweep, moved)
    log_association, association = associate(
        fitted.association, scene.descriptors, work, index, mask, moved, seen_through, hidden, scene.outlier
    )
    active, empty_for = state.active.copy(), state.empty_for.copy()
    after = State(motions, active, empty_for, association, labels, index, log_association, log_cluster)
    motions[:] = refit(scene, after, labels, motions, fitted, settings)
    retire_empty(active, empty_for, count_points(association, labels, len(active)))
    return after


@kernel
def same_labels(a: State, b: State) -> bool:
    """Whether both chains' labels agree."""
    different = 0
    for i in range(len(a.association)):
        different += a.association[i] != b.association[i] or a.cluster[i] != b.cluster[i]
    return different == 0


@kernel
def damp(after: State, before: State, older: State) -> None:
    """Halves the motions' step, in place, if the labels equal those of two rounds ago."""
    if not same_labels(after, older) or same_labels(after, before):
        return
    for c in range(len(after.motions)):
        new, old = after.motions[c], before.motions[c]
        new[0] = old[0] + wrap(new[0] - old[0]) / 2
        new[1], new[2] = old[1] + (new[1] - old[1]) / 2, old[2] + (new[2] - old[2]) / 2


@kernel
def has_settled(after: State, before: State, settings: Settings) -> bool:
    """Labels unchanged and motions within the tolerances."""
    for c in range(len(after.motions)):
        new, old = after.motions[c], before.motions[c]
        turn, shift = abs(wrap(new[0] - old[0])), math.sqrt((new[1] - old[1]) ** 2 + (new[2] - old[2]) ** 2)
        if after.active[c] and not (turn < settings.rotation_tolerance and shift < settings.translation_tolerance):
            return False
    return same_labels(after, before)
