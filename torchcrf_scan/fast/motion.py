"""ComputeRT of one pair from hard labels; `inference.motion` without batches."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from torchcrf_scan.fast.robust import robust_weight
from torchcrf_scan.inference.motion import ALONG, PATIENCE
from torchcrf_scan.loops.jit import Array, Booleans, Integers, kernel
from torchcrf_scan.loops.kabsch import kabsch, mean_point
from torchcrf_scan.loops.rigid import apply_to_rows, compose, motion_onto
from torchcrf_scan.search.registration import PAIR_ROWS, gauss_newton_step

POINT, LINE, GIVEN = 0, 1, 2  # metrics, in this order:
METRICS = ("point", "line", "given")


class Members(NamedTuple):
    """The points of one cluster and their partners.

    Attributes:
        points: (P, 2) source points. partner: (P, 2) associated target points. tangent: (P, 2) of the surface there.
    """

    points: Array
    partner: Array
    tangent: Array


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
    return Members(points, partner, tangent)


@kernel
def largest_spread(points: Array) -> float:
    """Root mean square extent of (P, 2) points along their main axis."""
    mx, my = mean_point(points)
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
        pairs[6, i] = robust_weight((pairs[0, i] - pairs[2, i]) ** 2 + (pairs[1, i] - pairs[3, i]) ** 2, scale)
    return compose(gauss_newton_step(pairs, ALONG), start)


@kernel
def shift_at(members: Members, theta: float) -> Array:
    """(3,) the least-squares motion with a given rotation, radians."""
    px, py = mean_point(members.points)
    qx, qy = mean_point(members.partner)
    return motion_onto(theta, px, py, qx, qy)


@kernel
def estimate(
    source: Array,
    target: Array,
    tangents: Array,
    association: Integers,
    cluster: Integers,
    motions: Array,
    active: Booleans,
    metric: int,
    scale: float,
    min_extent: float,
) -> Array:
    """(C, 3) motions from the labels, with the rules for small clusters; those of inactive clusters are unchanged.

    Args:
        source: (N, 2); target, tangents: (M, 2); association, cluster: (N,), -1 outlier.
        motions: (C, 3) initial. active: (C,) clusters that exist. metric: POINT, LINE or GIVEN.
        scale: residual at which a robust weight is one half. min_extent: a smaller cluster takes the background's rotation.
    """
    fitted = motions.copy()
    if metric == GIVEN:
        return fitted
    for c in range(len(motions)):
        if not active[c] and c > 0:
            continue
        members = members_of(source, target, tangents, association, places_of(association, cluster, c))
        P = len(members.points)
        if P >= 3 and largest_spread(members.points) >= min_extent:
            fitted[c] = kabsch(members.points, members.partner) if metric == POINT else line_step(members, motions[c], scale)
        elif P > 0 and c > 0:
            fitted[c] = shift_at(members, fitted[0, 0])
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
