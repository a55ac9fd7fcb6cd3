"""The way back through one round of one pair: from slopes of the state after it to slopes of the state before and of the inputs."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from torchcrf_scan.adjoint.association import pull_associate
from torchcrf_scan.adjoint.clustering import pull_cluster
from torchcrf_scan.adjoint.motion import pull_estimate, pull_partners
from torchcrf_scan.fast.arrays import Fitted, Scene, Settings, State
from torchcrf_scan.fast.association import registered_points
from torchcrf_scan.fast.clustering import nearest_to_outliers
from torchcrf_scan.fast.rounds import Done, free_space_of, limit_clusters, partners_of, tables_of
from torchcrf_scan.fast.static_features import Workspace
from torchcrf_scan.inference.joint import ROBUST_SHARE
from torchcrf_scan.loops.jit import Array, Integers, entry, kernel
from torchcrf_scan.names import ASSOCIATION_WEIGHTS, CLUSTERING_WEIGHTS


class Slopes(NamedTuple):
    """Derivatives of a loss by a state: motions (C, 3), log_association (N, K+1), log_cluster (N, D)."""

    motions: Array
    log_association: Array
    log_cluster: Array


class Inputs(NamedTuple):
    """Derivatives of a loss by what the rounds are given, summed over them.

    Attributes:
        association: (23,), clustering: (21,) by the weights. outlier, moving: (N,) by the learned log potentials.
    """

    association: Array
    clustering: Array
    outlier: Array
    moving: Array


def no_slopes(state: State) -> Slopes:
    """Slopes of 0 of a state."""
    return Slopes(*(np.zeros(of.shape) for of in (state.motions, state.log_association, state.log_cluster)))


def no_inputs(points: int) -> Inputs:
    """Slopes of 0 by the inputs of a pair."""
    return Inputs(np.zeros(len(ASSOCIATION_WEIGHTS)), np.zeros(len(CLUSTERING_WEIGHTS)), np.zeros(points), np.zeros(points))


@kernel
def pull_refit(
    scene: Scene,
    state: State,
    association: Integers,
    cluster: Integers,
    log_cluster: Array,
    motions: Array,
    turn: float,
    slopes: Array,
    to_association: Array,
    to_cluster: Array,
    fitted: Fitted,
    settings: Settings,
) -> Array:
    """(C, 3) slopes of the motions before `fast.rounds.refit`; adds those of the beliefs of both chains.

    Args:
        state: whose beliefs over associations weigh the points, and whose clusters exist.
        motions: (C, 3) before. turn: the background's rotation after. slopes: (C, 3) of the motions after.
        to_association: (N, K+1), to_cluster: (N, D), slopes added to.
    """
    N = len(scene.source)
    to_inlier, to_partner = np.zeros(N), np.zeros((N, 2))
    before = pull_estimate(
        scene.source,
        association,
        cluster,
        partners_of(scene, state, settings),
        log_cluster,
        motions,
        state.active,
        settings.metric,
        ROBUST_SHARE * fitted.clustering.cluster_distance,
        settings.min_extent,
        turn,
        slopes,
        to_cluster,
        to_inlier,
        to_partner,
    )
    pull_partners(scene.target, state.candidates, state.log_association, to_inlier, to_partner, to_association)
    return before


@kernel
def pull_last_fit(scene: Scene, done: Done, slopes: Slopes, fitted: Fitted, settings: Settings) -> Array:
    """(C, 3) slopes of the motions between both passes, through the fit after the second; adds those of the beliefs."""
    before, after, share = done.before, done.after, 0.5 if done.is_damped else 1.0
    turn = before.motions[0, 0] + (after.motions[0, 0] - before.motions[0, 0]) / share
    as_fitted = State(
        after.motions,
        before.active,  # clusters are retired after the fit
        after.empty_for,
        after.association,
        after.cluster,
        after.candidates,
        after.log_association,
        after.log_cluster,
    )
    labels, beliefs = (after.association, after.cluster, after.log_cluster), (slopes.log_association, slopes.log_cluster)
    return pull_refit(scene, as_fitted, *labels, done.between, turn, share * slopes.motions, *beliefs, fitted, settings)


@kernel
def pull_first_fit(
    scene: Scene, done: Done, between: Array, to_association: Array, slopes: Slopes, fitted: Fitted, settings: Settings
) -> Array:
    """(C, 3) slopes of the motions before the round, through the fit after the first pass; adds those of the beliefs.

    between: (C, 3) slopes of the motions after that fit. to_association: slopes of the beliefs before the round, added to.
    """
    before, after = done.before, done.after
    labels, beliefs = (before.association, after.cluster, after.log_cluster), (to_association, slopes.log_cluster)
    return pull_refit(scene, before, *labels, before.motions, done.between[0, 0], between, *beliefs, fitted, settings)


@kernel
def pull_second_pass(
    scene: Scene, done: Done, slopes: Slopes, inputs: Inputs, work: Workspace, between: Array, fitted: Fitted
) -> None:
    """Adds the slopes through the pass over the association chain. between: (C, 3) of the motions it was made at, added to."""
    after, active = done.after, done.before.active
    moved = registered_points(scene.source, done.between, active, after.log_cluster)
    sight = free_space_of(scene.target_sweep, moved)
    at, given = (done.between, active, moved), (inputs.association, inputs.outlier)
    pull_associate(scene, after, *at, *sight, fitted.association, work, slopes.log_association, *given, between)


@kernel
def pull_first_pass(scene: Scene, done: Done, slopes: Slopes, inputs: Inputs, start: Array, fitted: Fitted) -> None:
    """Adds the slopes through the pass over the clustering chain. start: (C, 3) of the motions before the round, added to."""
    before, model = done.before, fitted.clustering
    tables = tables_of(scene, before, model)
    limit_clusters(scene, before, tables)
    nearest = nearest_to_outliers(scene.boxes, scene.source, before.motions, before.active, before.association)
    given = inputs.clustering, inputs.outlier, inputs.moving
    pull_cluster(scene, before, tables, nearest, done.after.log_cluster, model, slopes.log_cluster, *given, start)


@entry
def pull_round(
    scene: Scene, done: Done, slopes: Slopes, inputs: Inputs, work: Workspace, fitted: Fitted, settings: Settings
) -> Slopes:
    """Slopes of the state before a round, to its motions and its beliefs over associations; adds those of the inputs.

    Args:
        slopes: of the state after the round, changed in place. work: a cache of the static scores.
        With motions from labels no slope passes through them.
    """
    between, start = np.zeros_like(done.between), np.zeros_like(done.between)
    to_association = np.zeros_like(done.before.log_association)
    if settings.is_soft:
        between[:] = pull_last_fit(scene, done, slopes, fitted, settings)
    pull_second_pass(scene, done, slopes, inputs, work, between, fitted)
    if settings.is_soft and not settings.detaches:
        start[:] = pull_first_fit(scene, done, between, to_association, slopes, fitted, settings)
    pull_first_pass(scene, done, slopes, inputs, start, fitted)
    if settings.detaches:
        start[:] = 0.0
    if done.is_damped:
        start += slopes.motions / 2
    return Slopes(start, to_association, np.zeros_like(done.after.log_cluster))
