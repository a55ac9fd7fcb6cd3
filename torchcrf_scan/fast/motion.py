"""ComputeRT of one pair from hard labels; `inference.motion` in loops."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from torchcrf_scan.inference.motion import ALONG, PATIENCE
from torchcrf_scan.loops.jit import Array, Booleans, Integers, kernel
from torchcrf_scan.loops.rigid import compose

ROUNDING = 8 * float(np.finfo(np.float64).eps)
POINT, LINE, GIVEN = 0, 1, 2  # metrics, in this order:
METRICS = ("point", "line", "given")


class Members(NamedTuple):
    """Which points speak for one cluster, and where they went.

    Attributes:
        points: (P, 2) source points. partner: (P, 2) where they went. tangent: (P, 2) direction of the surface there.
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
    """What the points at P places say. source: (N, 2); target, tangents: (M, 2); association: (N,); places: (P,)."""
    P = len(places)
    points, partner, tangent = np.empty((P, 2)), np.empty((P, 2)), np.empty((P, 2))
    for p in range(P):
        i, j = places[p], association[places[p]]
        points[p, 0], points[p, 1] = source[i, 0], source[i, 1]
        partner[p, 0], partner[p, 1] = target[j, 0], target[j, 1]
        tangent[p, 0], tangent[p, 1] = tangents[j, 0], tangents[j, 1]
    return Members(points, partner, tangent)


@kernel
def mean_point(points: Array) -> tuple[float, float]:
    """Of (P, 2) points; 0 of none."""
    x = y = 0.0
    for i in range(len(points)):
        x, y = x + points[i, 0], y + points[i, 1]
    total = max(len(points), 1)
    return x / total, y / total


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
def kabsch(points: Array, partner: Array) -> Array:
    """(3,) the motion that minimises the squared distances of (P, 2) points to their partners, P >= 1 (the paper's Eq. 6)."""
    P = len(points)
    px, py = mean_point(points)
    qx, qy = mean_point(partner)
    sine = cosine = size = 0.0
    for i in range(P):
        ax, ay = points[i, 0] - px, points[i, 1] - py
        bx, by = partner[i, 0] - qx, partner[i, 1] - qy
        sine += ax * by - ay * bx
        cosine += ax * bx + ay * by
        size += math.hypot(points[i, 0], points[i, 1]) * math.hypot(partner[i, 0], partner[i, 1])
    is_determined = max(abs(sine), abs(cosine)) > ROUNDING * size
    motion = np.empty(3)
    motion[0] = math.atan2(sine, cosine) if is_determined else 0.0
    cos, sin = math.cos(motion[0]), math.sin(motion[0])
    motion[1] = qx - (cos * px - sin * py)
    motion[2] = qy - (sin * px + cos * py)
    return motion


@kernel
def solve(a: float, b: float, c: float, d: float, e: float, f: float, x: float, y: float, z: float) -> tuple[float, float, float]:
    """Solves ((a, b, c), (b, d, e), (c, e, f)) v = (x, y, z), positive definite, by elimination."""
    u, v = b / a, c / a
    dd, ee, ff = d - u * b, e - u * c, f - v * c
    yy, zz = y - u * x, z - v * x
    w = ee / dd
    third = (zz - w * yy) / (ff - w * ee)
    second = (yy - ee * third) / dd
    return (x - b * second - c * third) / a, second, third


@kernel
def line_step(members: Members, start: Array, scale: float) -> Array:
    """(3,) one robust point-to-line step from `start`; `inference.motion.line_fit` and `gauss_newton_step` of one cluster.

    scale: residual at which a point's weight has fallen to a half.
    """
    points, partner, tangent = members
    P = len(points)
    moved, weights = np.empty((P, 2)), np.empty(P)
    cos, sin = math.cos(start[0]), math.sin(start[0])
    total = cx = cy = 0.0
    for i in range(P):
        x = cos * points[i, 0] - sin * points[i, 1] + start[1]
        y = sin * points[i, 0] + cos * points[i, 1] + start[2]
        w = 1 / (1 + ((x - partner[i, 0]) ** 2 + (y - partner[i, 1]) ** 2) / scale**2)
        moved[i, 0], moved[i, 1], weights[i] = x, y, w
        total, cx, cy = total + w, cx + w * x, cy + w * y
    total = max(total, 1e-9)
    cx, cy = cx / total, cy / total
    slack = 1 - ALONG
    tt = tx = ty = xx = xy = yy = rt = rx = ry = size = 0.0  # the normal equations of a turn and two shifts
    for i in range(P):
        w, ux, uy = weights[i], tangent[i, 0], tangent[i, 1]
        dx, dy = moved[i, 0] - partner[i, 0], moved[i, 1] - partner[i, 1]
        lx, ly = -(moved[i, 1] - cy), moved[i, 0] - cx  # d moved / d theta, turning about the weighted centre
        lu, du = lx * ux + ly * uy, slack * (dx * ux + dy * uy)
        tt += w * (lx * lx + ly * ly - slack * lu * lu)
        tx += w * (lx - slack * lu * ux)
        ty += w * (ly - slack * lu * uy)
        xx += w * (1 - slack * ux * ux)
        xy -= w * slack * ux * uy
        yy += w * (1 - slack * uy * uy)
        rt -= w * (lx * dx + ly * dy - lu * du)
        rx -= w * (dx - du * ux)
        ry -= w * (dy - du * uy)
        size += w * (lx * lx + ly * ly)
    tt += 1e-4 * size + 1e-6 * total
    xx, yy = xx + 1e-3 * total, yy + 1e-3 * total
    theta, sx, sy = solve(tt, tx, ty, xx, xy, yy, rt, rx, ry)
    theta = min(max(theta, -0.5), 0.5)
    cos, sin = math.cos(theta), math.sin(theta)
    step = np.empty(3)
    step[0], step[1], step[2] = theta, cx - (cos * cx - sin * cy) + sx, cy - (sin * cx + cos * cy) + sy
    return compose(step, start)


@kernel
def shift_at(members: Members, theta: float) -> Array:
    """(3,) the best motion with a given rotation."""
    px, py = mean_point(members.points)
    qx, qy = mean_point(members.partner)
    cos, sin = math.cos(theta), math.sin(theta)
    motion = np.empty(3)
    motion[0], motion[1], motion[2] = theta, qx - (cos * px - sin * py), qy - (sin * px + cos * py)
    return motion


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
    """(C, 3) motions from the labels, with the rules for small clusters; those of clusters that do not exist stay.

    Args:
        source: (N, 2); target, tangents: (M, 2); association, cluster: (N,), -1 outlier.
        motions: (C, 3) to begin with. active: (C,) clusters that exist. metric: POINT, LINE or GIVEN.
        scale: residual at which a robust weight has fallen to a half. min_extent: a smaller cluster takes the background's turn.
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
    """(C,) points with that label and a partner. association, cluster: (N,), -1 outlier."""
    count = np.zeros(clusters, np.int64)
    for i in range(len(cluster)):
        if cluster[i] >= 0 and association[i] >= 0:
            count[cluster[i]] += 1
    return count


@kernel
def retire_empty(active: Booleans, empty_for: Integers, count: Integers) -> None:
    """Ends a round, in place: clusters without a point for two rounds are removed, the background never. All (C,)."""
    for c in range(len(active)):
        empty_for[c] = 0 if count[c] > 0 else empty_for[c] + 1
        active[c] = c == 0 or (active[c] and empty_for[c] < PATIENCE)
