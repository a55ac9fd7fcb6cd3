"""Algorithm 1 in blocks for one pair, from the start to the answer; `inference.joint.decode` in loops.

For the settings that `backend.COMPILED_SETTINGS` lists. The whole of a pair is one call of machine code, so that other threads can
run meanwhile.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from torchcrf_scan.config import ModelConfig
from torchcrf_scan.fast.association import (
    AssociationModel,
    AssociationPair,
    Workspace,
    associate,
    association_model,
    association_pair,
    registered_points,
    workspace,
)
from torchcrf_scan.fast.candidates import by_motion, with_targets
from torchcrf_scan.fast.clustering import ClusteringModel, Tables, cluster, clustering_model, nearest_to_outliers, tabulate
from torchcrf_scan.fast.free_space import Sweep, look, sweep_of
from torchcrf_scan.fast.kept_candidates import Kept, kept_of, update
from torchcrf_scan.fast.motion import METRICS, count_points, estimate, retire_empty
from torchcrf_scan.fast.selection import Worth, discard_vacuous, worth_of
from torchcrf_scan.fast.uncertainty import association_confidence, cluster_confidence, motion_covariance
from torchcrf_scan.features.potentials import REFERENCE_UNIT
from torchcrf_scan.inference.joint import MERGE_ROTATION, ROBUST_SHARE, SELECTION_ROUNDS
from torchcrf_scan.inference.state import Parameters
from torchcrf_scan.loops.jit import Array, Booleans, Integers, kernel
from torchcrf_scan.loops.nearest import Boxes, boxes_of
from torchcrf_scan.loops.pair import Pair, PairStart
from torchcrf_scan.loops.rigid import parting, transform_of, wrap
from torchcrf_scan.loops.shape import describe, resolution


class Learned(NamedTuple):
    """What was learned, as arrays and numbers; `inference.joint.Parameters`.

    Attributes:
        association_calibration, cluster_calibration: (2,) slope and offset of the confidences.
        covariance_factor: of all covariances.
    """

    association: AssociationModel
    clustering: ClusteringModel
    worth: Worth
    association_calibration: Array
    cluster_calibration: Array
    covariance_factor: float


class Settings(NamedTuple):
    """What of the configuration decoding asks for; `metric` is a place in `motion.METRICS`."""

    candidates: int
    iterations: int
    stop_early: bool
    is_joint: bool
    metric: int
    min_extent: float
    rotation_tolerance: float
    translation_tolerance: float
    wrap_closed: bool
    is_metre: bool


class Decoded(NamedTuple):
    """The answer, metres; the attributes are those of `batch.Prediction`.

    Attributes:
        association, cluster: (N,). motions: (C, 3). active: (C,). candidates: (N, K).
        log_association: (N, K+1). log_cluster: (N, D). association_confidence, cluster_confidence: (N,).
        covariance: (C, 3, 3). information: (C, 3). directions: (C, 3, 3); see `inference.uncertainty.Uncertainty`.
    """

    association: Integers
    cluster: Integers
    motions: Array
    active: Booleans
    candidates: Integers
    log_association: Array
    log_cluster: Array
    converged: bool
    iterations: int
    association_confidence: Array
    cluster_confidence: Array
    covariance: Array
    information: Array
    directions: Array


class Scene(NamedTuple):
    """A pair in the unit that features are measured in, and what does not change from round to round.

    Attributes:
        factor: that unit's on metres. source: (N, 2), target: (M, 2). noise: of a return.
        tangents: (M, 2) of the target. reach: (N, C).
        outlier, moving: (N,) log potentials of `features.learned.ExtraLogUnary`.
    """

    factor: float
    source: Array
    target: Array
    noise: float
    boxes: Boxes
    source_sweep: Sweep
    target_sweep: Sweep
    descriptors: AssociationPair
    tangents: Array
    reach: Booleans
    outlier: Array
    moving: Array


class State(NamedTuple):
    """One round's; `inference.joint.State`.

    Attributes:
        motions: (C, 3). active: (C,). empty_for: (C,). association, cluster: (N,).
        candidates: (N, K). log_association: (N, K+1). log_cluster: (N, D).
    """

    motions: Array
    active: Booleans
    empty_for: Integers
    association: Integers
    cluster: Integers
    candidates: Integers
    log_association: Array
    log_cluster: Array


def learned_of(parameters: Parameters) -> Learned:
    """The learned numbers out of their tensors, once for all pairs."""
    calibration = parameters.calibration
    return Learned(
        association_model(parameters),
        clustering_model(parameters),
        worth_of(parameters),
        calibration.association.double().cpu().numpy().copy(),
        calibration.cluster.double().cpu().numpy().copy(),
        float(calibration.covariance_factor),
    )


def settings_of(model: ModelConfig) -> Settings:
    """The settings that `decode_pair` needs."""
    config, features = model.inference, model.features
    return Settings(
        config.candidates,
        config.iterations,
        config.stop_early,
        config.movers == "joint",
        METRICS.index(config.motion_metric),
        config.min_extent,
        config.rotation_tolerance,
        config.translation_tolerance,
        features.wrap_closed,
        features.length_unit == "metre",
    )


@kernel
def scaled(points: Array, factor: float) -> Array:
    """(P, 2) in another unit of length; a loop, for array expressions take long to compile."""
    changed = np.empty_like(points)
    for i in range(len(points)):
        changed[i, 0], changed[i, 1] = points[i, 0] * factor, points[i, 1] * factor
    return changed


@kernel
def scaled_motions(motions: Array, factor: float) -> Array:
    """(C, 3) in another unit of length."""
    scaled = motions.copy()
    for c in range(len(motions)):
        scaled[c, 1] *= factor
        scaled[c, 2] *= factor
    return scaled


@kernel
def scene_of(pair: Pair, start: PairStart, outlier: Array, moving: Array, settings: Settings) -> Scene:
    """Describes both scans in the unit of the features; outlier, moving: (N,) as in `Scene`."""
    factor = 1.0 if settings.is_metre else REFERENCE_UNIT / resolution(pair.source, pair.target, pair.noise)
    source, target, noise = scaled(pair.source, factor), scaled(pair.target, factor), pair.noise * factor
    guess, origin = pair.initial_motion.copy(), pair.target_origin.copy()
    for axis in range(2):
        guess[1 + axis] *= factor
        origin[axis] *= factor
    source_closed, target_closed = pair.source_closed and settings.wrap_closed, pair.target_closed and settings.wrap_closed
    descriptors = association_pair(source, target, describe(source, source_closed), describe(target, target_closed), guess)
    source_sweep = sweep_of(source, noise, source_closed, np.zeros(2))
    target_sweep = sweep_of(target, noise, target_closed, origin)
    boxes = boxes_of(target)
    given = start.target_tangents, start.reach, outlier, moving
    return Scene(factor, source, target, noise, boxes, source_sweep, target_sweep, descriptors, *given)


@kernel
def tables_of(scene: Scene, state: State, model: ClusteringModel) -> Tables:
    """The clustering chain at a round's motions and associations."""
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
def nearest_clusters(tables: Tables, reach: Booleans, association: Integers) -> Integers:
    """(N,) cluster in whose reach (N, C) a point is and whose motion takes it nearest to its partner; -1 without a partner."""
    labels = np.empty(len(association), np.int64)
    for i in range(len(labels)):
        least, best = np.inf, 0
        for c in range(len(tables.residual)):
            if reach[i, c] and tables.residual[c, i] < least:
                least, best = tables.residual[c, i], c
        labels[i] = best if association[i] >= 0 else -1
    return labels


@kernel
def certain(labels: Integers, states: int) -> Array:
    """(N, S) log-beliefs of labels (N,) that are beyond doubt."""
    log_beliefs = np.empty((len(labels), states))
    for i in range(len(labels)):
        for s in range(states):
            log_beliefs[i, s] = 0.0 if s == labels[i] else -np.inf
    return log_beliefs


@kernel
def first_state(scene: Scene, start: PairStart, is_chosen: bool, settings: Settings) -> State:
    """The start as a state, all considered movers in it unless they are chosen; `cluster` and beliefs are for `begin` to say."""
    N, C = len(scene.source), len(start.motions)
    active = start.active.copy()
    if not is_chosen:
        for c in range(C):
            active[c] = start.log_odds[c] > -np.inf
    motions = scaled_motions(start.motions, scene.factor)
    nobody, none = np.full(N, -1), np.empty((0, 0))
    candidates = np.empty((0, 0), np.int64)
    return State(motions, active, np.zeros(C, np.int64), start.association.copy(), nobody, candidates, none, none)


def first_beliefs(scene: Scene, state: State, count: int) -> State:
    """The labels of a start as beliefs, for those who want no rounds at all. count: K."""
    found, mask, _ = by_motion(scene.boxes, scene.source, state.motions, state.active, count)
    candidates, _, place = with_targets(found, mask, state.association)
    C = len(state.motions)
    states = np.where(state.cluster < 0, C, state.cluster)
    return State(
        state.motions,
        state.active,
        state.empty_for,
        state.association,
        state.cluster,
        candidates,
        certain(place, candidates.shape[1] + 1),
        certain(states, C + 1),
    )


@kernel
def look_at_all(sweep: Sweep, points: Array) -> tuple[Array, Array]:
    """(N,) seen through and (N,) hidden; points: (N, 2)."""
    seen_through, hidden = np.empty(len(points)), np.empty(len(points))
    for i in range(len(points)):
        seen_through[i], hidden[i] = look(sweep, points[i, 0], points[i, 1])
    return seen_through, hidden


@kernel
def refit(scene: Scene, state: State, cluster: Integers, motions: Array, learned: Learned, settings: Settings) -> Array:
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
        ROBUST_SHARE * learned.clustering.cluster_distance,
        settings.min_extent,
    )


@kernel
def step(scene: Scene, state: State, tables: Tables, kept: Kept, work: Workspace, learned: Learned, settings: Settings) -> State:
    """One round: clustering chain, motions, association chain, motions. tables: at the state's motions and associations."""
    update(kept, scene.boxes, scene.source, tables.moved, state.motions, state.active)
    index = kept.index.copy()
    mask = np.full(index.shape, True)
    log_cluster, labels = cluster(tables, state.active, learned.clustering)
    motions = refit(scene, state, labels, state.motions, learned, settings)
    moved = registered_points(scene.source, motions, state.active, log_cluster)
    seen_through, hidden = look_at_all(scene.target_sweep, moved)
    log_association, association = associate(
        learned.association, scene.descriptors, work, index, mask, moved, seen_through, hidden, scene.outlier
    )
    active, empty_for = state.active.copy(), state.empty_for.copy()
    after = State(motions, active, empty_for, association, labels, index, log_association, log_cluster)
    motions[:] = refit(scene, after, labels, motions, learned, settings)
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
    """Halves the motions' step, in place, where the labels have come back to those of two rounds ago."""
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


@kernel
def mean_gap(source: Array, a: Array, b: Array, labels: Integers, c: int) -> float:
    """How far two motions (3,) take the points with label c apart, on average. source: (N, 2); labels: (N,)."""
    one, other = transform_of(a), transform_of(b)
    total, count = 0.0, 0
    for i in range(len(labels)):
        if labels[i] == c:
            total, count = total + parting(one, other, source[i, 0], source[i, 1]), count + 1
    return total / max(count, 1)


@kernel
def add_logs(a: float, b: float) -> float:
    """log(exp a + exp b); impossible where both are."""
    high, low = max(a, b), min(a, b)
    return high + math.log1p(math.exp(low - high)) if high > -np.inf else high


@kernel
def join(state: State, low: int, high: int) -> None:
    """Gives cluster `high` to `low`, in place."""
    for i in range(len(state.cluster)):
        if state.cluster[i] == high:
            state.cluster[i] = low
        state.log_cluster[i, low] = add_logs(state.log_cluster[i, low], state.log_cluster[i, high])
        state.log_cluster[i, high] = -np.inf
    state.active[high] = False


@kernel
def merge_alike(source: Array, state: State, scale: float) -> None:
    """Clusters that turn out to be one become the one with the lower number, in place; `inference.joint.merge_alike`."""
    C = len(state.motions)
    labels, active = state.cluster.copy(), state.active.copy()
    count = np.zeros(C, np.int64)
    for i in range(len(labels)):
        if labels[i] >= 0:
            count[labels[i]] += 1
    for low in range(C - 1):
        for high in range(low + 1, C):
            if not (active[low] and active[high] and count[low] > 0 and count[high] > 0):
                continue
            a, b = state.motions[low], state.motions[high]
            if abs(wrap(a[0] - b[0])) < MERGE_ROTATION:
                apart = max(mean_gap(source, a, b, labels, low), mean_gap(source, a, b, labels, high))
                if apart < scale:
                    join(state, low, high)


@kernel
def iterate(
    scene: Scene, state: State, start: PairStart, is_chosen: bool, learned: Learned, settings: Settings
) -> tuple[State, bool, int]:
    """The rounds: the last state, whether it has settled, and how many there were."""
    tables = tables_of(scene, state, learned.clustering)
    state.cluster[:] = nearest_clusters(tables, scene.reach, state.association)
    kept = kept_of(len(scene.source), len(scene.target), len(state.motions), settings.candidates)
    work = workspace(len(scene.source), kept.index.shape[1])
    before = state
    converged, iterations = False, 0
    for done in range(settings.iterations):
        if done > 0:
            tables = tables_of(scene, state, learned.clustering)
        if done < SELECTION_ROUNDS and not is_chosen:
            discard_vacuous(tables, state.active, start.log_odds, learned.clustering, learned.worth)
        after = step(scene, state, tables, kept, work, learned, settings)
        if settings.stop_early:
            damp(after, state, before)
        before, state = state, after
        iterations += 1
        converged = converged or has_settled(state, before, settings)
        if settings.stop_early and converged:
            break
    return state, converged, iterations


@kernel
def read_out(scene: Scene, state: State, converged: bool, iterations: int, learned: Learned, settings: Settings) -> Decoded:
    """The state as the user sees it, and how sure it is."""
    covariance, information, directions = motion_covariance(
        scene.source,
        scene.target,
        scene.tangents,
        state.association,
        state.cluster,
        state.motions,
        settings.metric,
        ROBUST_SHARE * learned.clustering.cluster_distance,
        scene.noise,
    )
    metres = 1 / scene.factor
    for c in range(len(covariance)):
        for r in range(3):
            for d in range(3):
                unit = (1.0 if r == 0 else metres) * (1.0 if d == 0 else metres)
                covariance[c, r, d] *= learned.covariance_factor * unit
    return Decoded(
        state.association,
        state.cluster,
        scaled_motions(state.motions, metres),
        state.active,
        state.candidates,
        state.log_association,
        state.log_cluster,
        converged,
        iterations,
        association_confidence(state.log_association, state.candidates, state.association, learned.association_calibration),
        cluster_confidence(state.log_cluster, state.cluster, learned.cluster_calibration),
        covariance,
        information,
        directions,
    )


def decode_pair(pair: Pair, start: PairStart, outlier: Array, moving: Array, learned: Learned, settings: Settings) -> Decoded:
    """Labels, motions and confidences of one pair of at least one point a scan, from its start. No argument is changed.

    outlier, moving: (N,) learned log potentials, see `features.learned.ExtraLogUnary`.
    """
    is_chosen = not settings.is_joint or len(start.log_odds) == 0
    scene = scene_of(pair, start, outlier, moving, settings)
    state = first_state(scene, start, is_chosen, settings)
    state, converged, iterations = iterate(scene, state, start, is_chosen, learned, settings)
    if settings.iterations == 0:
        state = first_beliefs(scene, state, settings.candidates)
    merge_alike(scene.source, state, learned.clustering.cluster_distance)
    return read_out(scene, state, converged, iterations, learned, settings)


def decode_nothing(pair: Pair, start: PairStart, outlier: Array, moving: Array, learned: Learned, settings: Settings) -> Decoded:
    """The answer where a scan is empty: outliers, and the motions of the start, of which nothing is known."""
    N, C = len(pair.source), len(start.motions)
    nobody = np.full(N, -1)
    candidates = np.zeros((N, 1), np.int64)
    log_association, log_cluster = certain(np.full(N, 1), 2), certain(np.full(N, C), C + 1)
    uncertainty = motion_covariance(
        pair.source, pair.target, start.target_tangents, nobody, nobody, start.motions, settings.metric, 1.0, pair.noise
    )
    return Decoded(
        nobody,
        nobody.copy(),
        start.motions.copy(),
        np.arange(C) == 0,
        candidates,
        log_association,
        log_cluster,
        True,
        0,
        association_confidence(log_association, candidates, nobody, learned.association_calibration),
        cluster_confidence(log_cluster, nobody, learned.cluster_calibration),
        *uncertainty,
    )
