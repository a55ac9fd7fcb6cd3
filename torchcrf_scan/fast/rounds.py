"""One round of Algorithm 1 for one pair: clustering chain, motions, association chain, motions; `inference.joint.step`."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from torchcrf_scan.fast.arrays import Fitted, Scene, Settings, State
from torchcrf_scan.fast.association import associate, registered_points
from torchcrf_scan.fast.clustering import ClusteringModel, Tables, cluster, distance, nearest_to_all, nearest_to_outliers, tabulate
from torchcrf_scan.fast.free_space import Sweep, look
from torchcrf_scan.fast.kept_candidates import Kept, kept_of, update
from torchcrf_scan.fast.limit import log_within
from torchcrf_scan.fast.motion import Partners, count_points, estimate, retire_empty, soft_partners
from torchcrf_scan.fast.selection import discard_vacuous
from torchcrf_scan.fast.static_features import Workspace, workspace
from torchcrf_scan.inference.joint import ROBUST_SHARE, SELECTION_ROUNDS
from torchcrf_scan.loops.jit import Array, Booleans, Integers, entry, kernel
from torchcrf_scan.loops.rigid import wrap


class Caches(NamedTuple):
    """What the rounds of a pair keep from one to the next; results do not depend on it."""

    kept: Kept
    work: Workspace


class Done(NamedTuple):
    """One round.

    Attributes:
        before, after: the states. between: (C, 3) motions between the passes over both chains.
        is_damped: the step of the motions was halved. is_settled: labels and motions did not change.
    """

    before: State
    between: Array
    after: State
    is_damped: bool
    is_settled: bool


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
def limit_clusters(scene: Scene, state: State, tables: Tables) -> None:
    """Adds the potential of the limit of outliers to those of the clusters, in place, if there is one. tables: at the state."""
    if scene.limit.distance == 0:
        return
    nearest = nearest_to_all(scene.boxes, scene.source, state.motions, state.active)
    for c in range(len(state.motions)):
        if state.active[c]:
            for i in range(len(scene.source)):
                j = nearest[i, c]
                dx, dy = tables.moved[c, i, 0] - scene.target[j, 0], tables.moved[c, i, 1] - scene.target[j, 1]
                tables.log_inlier[c, i] += log_within(scene.limit, distance(dx, dy))


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
def label_nearest(scene: Scene, state: State, fitted: Fitted) -> None:
    """Writes the labels of a start, `nearest_clusters`, into its state."""
    state.cluster[:] = nearest_clusters(tables_of(scene, state, fitted.clustering), scene.reach, state.association)


@kernel
def free_space_of(sweep: Sweep, points: Array) -> tuple[Array, Array]:
    """Free-space test of (N, 2) points: (N,) seen through and (N,) hidden, each from 0 to 1."""
    seen_through, hidden = np.empty(len(points)), np.empty(len(points))
    for i in range(len(points)):
        seen_through[i], hidden[i] = look(sweep, points[i, 0], points[i, 1])
    return seen_through, hidden


@kernel
def partners_of(scene: Scene, state: State, settings: Settings) -> Partners:
    """The mean partners by a state's beliefs; of no point where labels decide."""
    source = scene.source if settings.is_soft else scene.source[:0]
    return soft_partners(source, scene.target, scene.tangents, state.association, state.candidates, state.log_association)


@kernel
def refit(
    scene: Scene,
    partners: Partners,
    association: Integers,
    cluster: Integers,
    log_cluster: Array,
    motions: Array,
    active: Booleans,
    fitted: Fitted,
    settings: Settings,
) -> Array:
    """(C, 3) motions from labels (N,) and, where soft, beliefs of both chains, from the motions (C, 3); see `estimate`."""
    return estimate(
        scene.source,
        scene.target,
        scene.tangents,
        association,
        cluster,
        partners,
        log_cluster,
        motions,
        active,
        settings.metric,
        ROBUST_SHARE * fitted.clustering.cluster_distance,
        settings.min_extent,
    )


@kernel
def step(
    scene: Scene, state: State, tables: Tables, kept: Kept, work: Workspace, fitted: Fitted, settings: Settings
) -> tuple[State, Array]:
    """One round: clustering chain, motions, association chain, motions. tables: at the state's motions and associations.

    Returns the state after it, and the motions (C, 3) between both chains.
    """
    update(kept, scene.boxes, scene.source, tables.moved, state.motions, state.active)
    index = kept.index.copy()
    mask = np.full(index.shape, True)
    log_cluster, labels = cluster(tables, state.active, fitted.clustering)
    partners = partners_of(scene, state, settings)
    between = refit(scene, partners, state.association, labels, log_cluster, state.motions, state.active, fitted, settings)
    moved = registered_points(scene.source, between, state.active, log_cluster)
    seen_through, hidden = free_space_of(scene.target_sweep, moved)
    log_association, association = associate(
        fitted.association, scene.descriptors, work, index, mask, scene.limit, moved, seen_through, hidden, scene.outlier
    )
    active, empty_for = state.active.copy(), state.empty_for.copy()
    after = State(between.copy(), active, empty_for, association, labels, index, log_association, log_cluster)
    partners = partners_of(scene, after, settings)
    after.motions[:] = refit(scene, partners, association, labels, log_cluster, between, active, fitted, settings)
    retire_empty(active, empty_for, count_points(association, labels, len(active)))
    return after, between


@kernel
def advance(
    scene: Scene,
    state: State,
    older: State,
    done: int,
    is_chosen: bool,
    log_odds: Array,
    kept: Kept,
    work: Workspace,
    fitted: Fitted,
    settings: Settings,
) -> tuple[State, Array, bool, bool]:
    """One round with what goes before and after it: the selection of movers, and the guards against cycles.

    Args:
        state: whose vacuous clusters are removed, in place. older: the state before it.
        done: number of rounds before. is_chosen: no selection. log_odds: (C,) of the hypotheses.

    Returns:
        the state after it, the motions (C, 3) between both chains, whether the step was halved, and whether the state has settled.
    """
    tables = tables_of(scene, state, fitted.clustering)
    if done == 0:
        state.cluster[:] = nearest_clusters(tables, scene.reach, state.association)
    if done < SELECTION_ROUNDS and not is_chosen:
        discard_vacuous(tables, state.active, log_odds, fitted.clustering, fitted.worth)
    limit_clusters(scene, state, tables)  # after the selection, which compares clusters
    after, between = step(scene, state, tables, kept, work, fitted, settings)
    is_damped = settings.stop_early and swings(after, state, older)
    if is_damped:
        halve_step(after.motions, state.motions)
    return after, between, is_damped, has_settled(after, state, settings)


@kernel
def same_labels(a: State, b: State) -> bool:
    """Whether both chains' labels agree."""
    different = 0
    for i in range(len(a.association)):
        different += a.association[i] != b.association[i] or a.cluster[i] != b.cluster[i]
    return different == 0


@kernel
def swings(after: State, before: State, older: State) -> bool:
    """Whether the labels equal those of two rounds ago and not the last ones (the guard against cycles of spec 7.6)."""
    return same_labels(after, older) and not same_labels(after, before)


@kernel
def halve_step(after: Array, before: Array) -> None:
    """Halves a step of motions, in place. after, before: (C, 3)."""
    for c in range(len(after)):
        new, old = after[c], before[c]
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


@entry
def caches_of(scene: Scene, clusters: int, candidates: int) -> Caches:
    """Empty caches. clusters: C. candidates: K, 0 for all targets."""
    kept = kept_of(len(scene.source), len(scene.target), clusters, candidates)
    return Caches(kept, workspace(len(scene.source), kept.index.shape[1]))


@entry
def do_round(
    scene: Scene,
    state: State,
    older: State,
    done: int,
    is_chosen: bool,
    log_odds: Array,
    caches: Caches,
    fitted: Fitted,
    settings: Settings,
) -> Done:
    """One round, see `advance`."""
    after, between, is_damped, is_settled = advance(
        scene, state, older, done, is_chosen, log_odds, caches.kept, caches.work, fitted, settings
    )
    return Done(state, between, after, is_damped, is_settled)
