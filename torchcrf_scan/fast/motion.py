"""ComputeRT of one pair from labels or from beliefs; `inference.motion` without batches."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from torchcrf_scan.choices import MOTION_METRICS
from torchcrf_scan.fast.robust import robust_weight
from torchcrf_scan.inference.motion import ALONG, LEAST_DAMPING, PATIENCE
from torchcrf_scan.loops.jit import Array, Booleans, Integers, kernel
from torchcrf_scan.loops.kabsch import kabsch, mean_point
from torchcrf_scan.loops.rigid import apply_to_rows, compose, motion_onto
from torchcrf_scan.search.registration import PAIR_ROWS, gauss_newton_step

POINT, LINE, GIVEN = 0, 1, 2  # metrics, in this order:
METRICS = tuple(MOTION_METRICS)


class Members(NamedTuple):
    """The points of one cluster and their partners.

    Attributes:
        points: (P, 2) source points. partner: (P, 2) associated target points. tangent: (P, 2) of the surface there.
        weights: (P,), 1 for labels.
    """

    points: Array
    partner: Array
    tangent: Array
    weights: Array


class Partners(NamedTuple):
    """What the beliefs of the association chain say of every point (A-18); `inference.motion.soft_support`.

    Attributes:
        inlier: (N,) belief that it has a partner. partner: (N, 2) the mean one. tangent: (N, 2) of the surface at the likeliest.
    """

    inlier: Array
    partner: Array
    tangent: Array


LEAST_TOTAL = 1e-9  # of weights and beliefs that are divided by


@kernel
def soft_partners(
    source: Array, target: Array, tangents: Array, association: Integers, candidates: Integers, log_association: Array
) -> Partners:
    """Mean partners by beliefs (N, K+1) over candidates (N, K); without beliefs, (0, 0), by the labels (N,).

    A point at the sensor's own place, as padding is, has no weight.
    """
    N = len(source)
    inlier, partner, tangent = np.zeros(N), np.zeros((N, 2)), np.zeros((N, 2))
    for i in range(N):
        x = y = total = 0.0
        likeliest, largest = max(association[i], 0), -np.inf
        if len(log_association) == 0:
            total = 1.0 if association[i] >= 0 else 0.0
            x, y = total * target[likeliest, 0], total * target[likeliest, 1]
        else:
            likeliest = candidates[i, 0]
            for k in range(candidates.shape[1]):
                j, share = candidates[i, k], math.exp(log_association[i, k])
                x, y, total = x + share * target[j, 0], y + share * target[j, 1], total + share
                if share > largest:
                    likeliest, largest = j, share
        partner[i, 0], partner[i, 1] = x / max(total, LEAST_TOTAL), y / max(total, LEAST_TOTAL)
        tangent[i, 0], tangent[i, 1] = tangents[likeliest, 0], tangents[likeliest, 1]
        inlier[i] = total if source[i, 0] != 0 or source[i, 1] != 0 else 0.0
    return Partners(inlier, partner, tangent)


@kernel
def likely_members(source: Array, partners: Partners, log_cluster: Array, c: int) -> tuple[Members, Integers]:
    """The points (P,) that may belong to cluster c, weighted by the beliefs of both chains, and which these are."""
    N = len(source)
    places, weights, P = np.empty(N, np.int64), np.empty(N), 0
    for i in range(N):
        weight = math.exp(log_cluster[i, c]) * partners.inlier[i]
        if weight > 0:
            places[P], weights[P] = i, weight
            P += 1
    points, partner, tangent = np.empty((P, 2)), np.empty((P, 2)), np.empty((P, 2))
    for p in range(P):
        i = places[p]
        points[p, 0], points[p, 1] = source[i, 0], source[i, 1]
        partner[p, 0], partner[p, 1] = partners.partner[i, 0], partners.partner[i, 1]
        tangent[p, 0], tangent[p, 1] = partners.tangent[i, 0], partners.tangent[i, 1]
    return Members(points, partner, tangent, weights[:P]), places[:P]


@kernel
def places_of(association: Integers, cluster: Integers, c: int) -> Integers:
    """(P,) the points with label c and a partner, ascending. association, cluster: (N,), -1 outlier."""
    places, P = np.empty(len(cluster), np.int64), 0
    for i in range(len(cluster)):
        if cluster[i] == c and association[i] >= 0:
            places[P] = i
            P += 1
    return places[:P]


@kernel
def members_of(source: Array, target: Array, tangents: Array, association: Integers, places: Integers) -> Members:
    """The points at P places with their partners. source: (N, 2); target, tangents: (M, 2); association: (N,); places: (P,)."""
    P = len(places)
    points, partner, tangent = np.empty((P, 2)), np.empty((P, 2)), np.empty((P, 2))
    for p in range(P):
        i, j = places[p], association[places[p]]
        points[p, 0], points[p, 1] = source[i, 0], source[i, 1]
        partner[p, 0], partner[p, 1] = target[j, 0], target[j, 1]
        tangent[p, 0], tangent[p, 1] = tangents[j, 0], tangents[j, 1]
    return Members(points, partner, tangent, np.ones(P))


@kernel
def largest_spread(points: Array) -> float:
    """Root mean square extent of (P, 2) points along their main axis."""
    mx, my = mean_point(points, np.ones(len(points)))
    xx = yy = xy = 0.0
    for i in range(len(points)):
        x, y = points[i, 0] - mx, points[i, 1] - my
        xx, yy, xy = xx + x * x, yy + y * y, xy + x * y
    total = max(len(points), 1)
    xx, yy, xy = xx / total, yy / total, xy / total
    return math.sqrt((xx + yy) / 2 + math.sqrt(((xx - yy) / 2) ** 2 + xy**2))


@kernel
def line_step(members: Members, start: Array, scale: float) -> Array:
    """(3,) one robust point-to-line step from a motion (3,); `inference.motion.line_fit` of one cluster.

    scale: residual at which a robust weight is one half.
    """
    partner, tangent, pairs = members.partner, members.tangent, np.empty((PAIR_ROWS, len(members.points)))
    apply_to_rows(start, members.points, pairs)
    for i in range(len(partner)):
        pairs[2, i], pairs[3, i], pairs[4, i], pairs[5, i] = partner[i, 0], partner[i, 1], tangent[i, 0], tangent[i, 1]
        pairs[6, i] = members.weights[i] * robust_weight((pairs[0, i] - pairs[2, i]) ** 2 + (pairs[1, i] - pairs[3, i]) ** 2, scale)
    return compose(gauss_newton_step(pairs, ALONG, LEAST_DAMPING), start)


@kernel
def shift_at(members: Members, theta: float) -> Array:
    """(3,) the least-squares motion with a given rotation, radians."""
    px, py = mean_point(members.points, members.weights)
    qx, qy = mean_point(members.partner, members.weights)
    return motion_onto(theta, px, py, qx, qy)


@kernel
def is_large(source: Array, places: Integers, min_extent: float) -> bool:
    """Whether the labelled points at some places (P,) determine a rotation."""
    if len(places) < 3:
        return False
    points = np.empty((len(places), 2))
    for p in range(len(places)):
        points[p, 0], points[p, 1] = source[places[p], 0], source[places[p], 1]
    return largest_spread(points) >= min_extent


@kernel
def estimate(
    source: Array,
    target: Array,
    tangents: Array,
    association: Integers,
    cluster: Integers,
    partners: Partners,
    log_cluster: Array,
    motions: Array,
    active: Booleans,
    metric: int,
    scale: float,
    min_extent: float,
) -> Array:
    """(C, 3) motions from labels or beliefs, with the rules for small clusters; those of inactive clusters are unchanged.

    Args:
        source: (N, 2); target, tangents: (M, 2); association, cluster: (N,), -1 outlier.
        partners, log_cluster: (N, D) beliefs that weigh the points; of no point: the labels decide.
        motions: (C, 3) initial. active: (C,) clusters that exist. metric: POINT, LINE or GIVEN.
        scale: residual at which a robust weight is one half. min_extent: a smaller cluster takes the background's rotation.
    """
    fitted = motions.copy()
    if metric == GIVEN:
        return fitted
    is_soft = len(partners.inlier) > 0
    for c in range(len(motions)):
        if not active[c] and c > 0:
            continue
        places = places_of(association, cluster, c)
        has_rotation = is_large(source, places, min_extent)
        if not has_rotation and (len(places) == 0 or c == 0):
            continue
        if is_soft:
            members = likely_members(source, partners, log_cluster, c)[0]
        else:
            members = members_of(source, target, tangents, association, places)
        if not has_rotation:
            fitted[c] = shift_at(members, fitted[0, 0])
        elif metric == POINT:
            fitted[c] = kabsch(members.points, members.partner, members.weights)
        else:
            fitted[c] = line_step(members, motions[c], scale)
    if not active[0]:
        fitted[0] = motions[0]
    return fitted


@kernel
def count_points(association: Integers, cluster: Integers, clusters: int) -> Integers:
    """(C,) number of associated points of every cluster. association, cluster: (N,), -1 outlier."""
    count = np.zeros(clusters, np.int64)
    for i in range(len(cluster)):
        if cluster[i] >= 0 and association[i] >= 0:
            count[cluster[i]] += 1
    return count


@kernel
def retire_empty(active: Booleans, empty_for: Integers, count: Integers) -> None:
    """Ends a round, in place: removes clusters (never the background) that had no point for two rounds. All (C,)."""
    for c in range(len(active)):
        empty_for[c] = 0 if count[c] > 0 else empty_for[c] + 1
        active[c] = c == 0 or (active[c] and empty_for[c] < PATIENCE)
