"""Association features independent of the motions (L1..L11 and their boosters), cached between rounds.

`features.association` for one pair, with the weights applied at once.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from torchcrf_scan.fast.boosting import Stumps, add_margins, double_array, stumps_of
from torchcrf_scan.fast.robust import robust_square
from torchcrf_scan.features.scales import KAPPA
from torchcrf_scan.inference.state import Parameters
from torchcrf_scan.loops.jit import Array, Booleans, Integers, kernel
from torchcrf_scan.loops.rigid import apply
from torchcrf_scan.loops.shape import Shape
from torchcrf_scan.names import SHAPE_CHANNELS, STATIC_CHANNELS

RADIUS = SHAPE_CHANNELS  # order of the channels: L1..L9, the radius, the translation
LENGTHS = 12  # to three neighbours on either side, straight and along the scan
DESCRIPTORS = 18  # numbers kept of a point: the lengths, three angles, the radius, x and y
TOGETHER = 256  # pairs of points processed at once: few enough for the fastest cache


class AssociationModel(NamedTuple):
    """Fitted weights, scales and boosters of the association chain (`features.scales.Scales`).

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
    """The fitted parameters as arrays, once for all pairs."""
    scales = parameters.scales
    buffers = (scales.local, scales.local_outlier, scales.pairwise, scales.pairwise_outlier)
    local, local_outlier, pairwise, pairwise_outlier = (double_array(values) for values in buffers)
    weights = double_array(parameters.association)
    data, outlier = stumps_of(parameters.boosters.data), stumps_of(parameters.boosters.outlier)
    arrays = weights, 1 / local, local_outlier, 1 / pairwise, pairwise_outlier
    return AssociationModel(*arrays, float(scales.cluster_distance), float(scales.gate), data, outlier)


class AssociationPair(NamedTuple):
    """Points and descriptors of two scans, in the unit of the features.

    Attributes:
        source: (N, 2), target: (M, 2) points.
        of_source: (N, 18), of_target: (M, 18) descriptors: lengths in the order of channels L1..L3 and L7..L9, after and
            before the point in turn, angles, radius, and the position, that of the source under the initial motion.
    """

    source: Array
    target: Array
    of_source: Array
    of_target: Array


class Workspace(NamedTuple):
    """Static scores cached between rounds, updated by `associate`; results do not depend on the cache.

    Attributes:
        is_known: (N,) valid entries. candidates, mask: (N, K) for which they were computed.
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
    """An empty workspace for N source points with K candidates each."""
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
def static_channels(errors: Array, per_local: Array) -> Array:
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
def differences(pair: AssociationPair, work: Workspace, points: Integers) -> Array:
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
    """(11, R) the best of every channel over the real candidates, -kappa without one. channels: (11, R K)."""
    K = mask.shape[1]
    best = np.full((STATIC_CHANNELS, len(points)), -KAPPA)  # lower bound of all channels
    for c in range(STATIC_CHANNELS):
        for r in range(len(points)):
            row = channels[c, r * K : (r + 1) * K]
            for k in range(K):
                if mask[points[r], k]:
                    best[c, r] = max(best[c, r], row[k])
    return best


@kernel
def _update_points(model: AssociationModel, pair: AssociationPair, work: Workspace, points: Integers) -> None:
    """Updates the workspace of some source points (R,) from their candidates."""
    K = work.candidates.shape[1]
    channels = static_channels(differences(pair, work, points), model.per_local)
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
    """Updates the workspace for the candidates (N, K)."""
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
