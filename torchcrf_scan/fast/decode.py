"""Algorithm 1 in blocks for one pair, from the start to the prediction; `inference.joint.decode` without batches.

For the settings supported by `fast.choice`. All rounds of a pair are one call of machine code, so that other threads can run
meanwhile.
"""

from __future__ import annotations

import math

import numpy as np

from torchcrf_scan.fast.arrays import Decoded, Fitted, Scene, Settings, State
from torchcrf_scan.fast.free_space import sweep_of
from torchcrf_scan.fast.kept_candidates import kept_of
from torchcrf_scan.fast.limit import Limit
from torchcrf_scan.fast.rounds import advance, label_nearest
from torchcrf_scan.fast.static_features import association_pair, workspace
from torchcrf_scan.fast.uncertainty import association_confidence, cluster_confidence, motion_covariance
from torchcrf_scan.features.limit import SOFTNESS
from torchcrf_scan.features.potentials import REFERENCE_UNIT
from torchcrf_scan.inference.joint import MERGE_ROTATION, ROBUST_SHARE
from torchcrf_scan.loops.candidates import by_motion, with_targets
from torchcrf_scan.loops.jit import Array, Integers, entry, kernel
from torchcrf_scan.loops.nearest import boxes_of
from torchcrf_scan.loops.pair import Pair, PairStart
from torchcrf_scan.loops.rigid import parting, transform_of, wrap
from torchcrf_scan.loops.shape import describe, resolution


@kernel
def scaled(points: Array, factor: float) -> Array:
    """(P, 2) in another unit of length; a loop, as array expressions take long to compile."""
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
def limited(reach: Array) -> Array:
    """(N, C) of `Start.reach`, inf where it is not 0."""
    found = np.zeros_like(reach)
    for i in range(reach.shape[0]):
        for c in range(reach.shape[1]):
            if reach[i, c] > 0:
                found[i, c] = np.inf
    return found


@entry
def scene_of(pair: Pair, start: PairStart, outlier: Array, moving: Array, settings: Settings) -> Scene:
    """The pair in the unit of the features, with its descriptors. outlier, moving: (N,) as in `Scene`."""
    unit = 1.0 if settings.is_metre and settings.outlier_distance == 0 else resolution(pair.source, pair.target, pair.noise)
    factor = 1.0 if settings.is_metre else REFERENCE_UNIT / unit
    limit = Limit(settings.outlier_distance * factor, SOFTNESS * unit * factor)
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
    reach = limited(start.reach) if settings.is_reach_hard else start.reach
    given = start.target_tangents, reach, outlier, moving
    return Scene(factor, source, target, noise, boxes, source_sweep, target_sweep, descriptors, *given, limit)


@entry
def certain(labels: Integers, states: int) -> Array:
    """(N, S) log-beliefs that put all belief on labels (N,)."""
    log_beliefs = np.empty((len(labels), states))
    for i in range(len(labels)):
        for s in range(states):
            log_beliefs[i, s] = 0.0 if s == labels[i] else -np.inf
    return log_beliefs


@entry
def first_state(scene: Scene, start: PairStart, is_chosen: bool) -> State:
    """The start as a state, all considered movers in it unless they are chosen; `cluster` and beliefs are not filled in yet."""
    N, C = len(scene.source), len(start.motions)
    active = start.active.copy()
    if not is_chosen:
        for c in range(C):
            active[c] = start.log_odds[c] > -np.inf
    motions = scaled_motions(start.motions, scene.factor)
    outliers, none = np.full(N, -1), np.empty((0, 0))
    candidates = np.empty((0, 0), np.int64)
    return State(motions, active, np.zeros(C, np.int64), start.association.copy(), outliers, candidates, none, none)


def first_beliefs(scene: Scene, state: State, count: int) -> State:
    """The state with the labels of a start as beliefs, the result of zero rounds. count: K."""
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
def mean_gap(source: Array, a: Array, b: Array, labels: Integers, c: int) -> float:
    """Mean distance of the points with label c under two motions (3,). source: (N, 2); labels: (N,)."""
    one, other = transform_of(a), transform_of(b)
    total, count = 0.0, 0
    for i in range(len(labels)):
        if labels[i] == c:
            total, count = total + parting(one, other, source[i, 0], source[i, 1]), count + 1
    return total / max(count, 1)


@kernel
def add_logs(a: float, b: float) -> float:
    """log(exp a + exp b); -inf if both are."""
    high, low = max(a, b), min(a, b)
    return high + math.log1p(math.exp(low - high)) if high > -np.inf else high


@kernel
def join(state: State, low: int, high: int) -> None:
    """Merges cluster `high` into `low`, in place."""
    for i in range(len(state.cluster)):
        if state.cluster[i] == high:
            state.cluster[i] = low
        state.log_cluster[i, low] = add_logs(state.log_cluster[i, low], state.log_cluster[i, high])
        state.log_cluster[i, high] = -np.inf
    state.active[high] = False


@entry
def merge_alike(source: Array, state: State, scale: float) -> Integers:
    """Merges clusters of equal motion into the one with the lower number, in place; `inference.joint.merge_alike`.

    Returns (J, 2) the lower and the higher number of each merged two, in order.
    """
    C = len(state.motions)
    joined, J = np.empty((C * C, 2), np.int64), 0
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
                    joined[J, 0], joined[J, 1] = low, high
                    J += 1
    return joined[:J].copy()


@entry
def iterate(
    scene: Scene, state: State, start: PairStart, is_chosen: bool, fitted: Fitted, settings: Settings
) -> tuple[State, bool, int]:
    """The rounds: the last state, whether it has converged, and the number of rounds."""
    kept = kept_of(len(scene.source), len(scene.target), len(state.motions), settings.candidates)
    work = workspace(len(scene.source), kept.index.shape[1])
    before = state
    converged, iterations = False, 0
    if settings.iterations == 0:
        label_nearest(scene, state, fitted)
    for done in range(settings.iterations):
        after, _, _, is_settled = advance(scene, state, before, done, is_chosen, start.log_odds, kept, work, fitted, settings)
        before, state = state, after
        iterations += 1
        converged = converged or is_settled
        if settings.stop_early and converged:
            break
    return state, converged, iterations


@entry
def read_out(scene: Scene, state: State, converged: bool, iterations: int, fitted: Fitted, settings: Settings) -> Decoded:
    """The result in metres, with covariances and confidences."""
    covariance, information, directions = motion_covariance(
        scene.source,
        scene.target,
        scene.tangents,
        state.association,
        state.cluster,
        state.motions,
        settings.metric,
        ROBUST_SHARE * fitted.clustering.cluster_distance,
        scene.noise,
    )
    metres = 1 / scene.factor
    for c in range(len(covariance)):
        for r in range(3):
            for d in range(3):
                unit = (1.0 if r == 0 else metres) * (1.0 if d == 0 else metres)
                covariance[c, r, d] *= fitted.covariance_factor * unit
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
        association_confidence(state.log_association, state.candidates, state.association, fitted.association_calibration),
        cluster_confidence(state.log_cluster, state.cluster, fitted.cluster_calibration),
        covariance,
        information,
        directions,
    )


def decode_pair(pair: Pair, start: PairStart, outlier: Array, moving: Array, fitted: Fitted, settings: Settings) -> Decoded:
    """Labels, motions and confidences of one pair of at least one point a scan, from its start. No argument is changed.

    outlier, moving: (N,) log potentials of `features.learned.ExtraLogUnary`.
    """
    is_chosen = not settings.is_joint or len(start.log_odds) == 0
    scene = scene_of(pair, start, outlier, moving, settings)
    state = first_state(scene, start, is_chosen)
    state, converged, iterations = iterate(scene, state, start, is_chosen, fitted, settings)
    if settings.iterations == 0:
        state = first_beliefs(scene, state, settings.candidates)
    merge_alike(scene.source, state, fitted.clustering.cluster_distance)
    return read_out(scene, state, converged, iterations, fitted, settings)


def decode_nothing(pair: Pair, start: PairStart, outlier: Array, moving: Array, fitted: Fitted, settings: Settings) -> Decoded:
    """The result if a scan is empty: outliers, and the motions of the start with the covariances of the prior."""
    N, C = len(pair.source), len(start.motions)
    outliers = np.full(N, -1)
    candidates = np.zeros((N, 1), np.int64)
    log_association, log_cluster = certain(np.full(N, 1), 2), certain(np.full(N, C), C + 1)
    uncertainty = motion_covariance(
        pair.source, pair.target, start.target_tangents, outliers, outliers, start.motions, settings.metric, 1.0, pair.noise
    )
    return Decoded(
        outliers,
        outliers.copy(),
        start.motions.copy(),
        np.arange(C) == 0,
        candidates,
        log_association,
        log_cluster,
        True,
        0,
        association_confidence(log_association, candidates, outliers, fitted.association_calibration),
        cluster_confidence(log_cluster, outliers, fitted.cluster_calibration),
        *uncertainty,
    )
