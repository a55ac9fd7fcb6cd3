"""The way back through ComputeRT: slopes of beliefs and of the motions before, from slopes of the fitted motions.

A least-squares step solves N s = b. With l = N^-1 (slope of s) its slopes are those of l . (b - N s) at fixed l and s, which is one
sum over the points.
"""

from __future__ import annotations

import math

import numpy as np

from torchcrf_scan.fast.motion import (
    GIVEN,
    LEAST_TOTAL,
    POINT,
    Members,
    Partners,
    is_large,
    likely_members,
    places_of,
)
from torchcrf_scan.fast.robust import robust_weight
from torchcrf_scan.inference.motion import ALONG, LARGEST_TURN, LEAST_DAMPING, SHIFT_DAMPING, TURN_DAMPING
from torchcrf_scan.loops.jit import Array, Booleans, Integers, kernel
from torchcrf_scan.loops.kabsch import ROUNDING, mean_point
from torchcrf_scan.loops.rigid import rotate, rotate_back, transform, transform_of
from torchcrf_scan.loops.solve import solve


@kernel
def add_moved(slope: Array, motion: Array, x: float, y: float, gx: float, gy: float) -> None:
    """Adds to the slope (3,) of a motion that of a point moved by it to (x, y). gx, gy: the point's slope."""
    slope[0] += gy * (x - motion[1]) - gx * (y - motion[2])
    slope[1] += gx
    slope[2] += gy


@kernel
def across(tx: float, ty: float, x: float, y: float) -> tuple[float, float]:
    """A vector with its part along a surface of direction t reduced to the share `ALONG`."""
    along = (1 - ALONG) * (tx * x + ty * y)
    return x - along * tx, y - along * ty


@kernel
def normal_system(moved: Array, members: Members, weights: Array, total: float, cx: float, cy: float) -> Array:
    """(9,) the damped matrix, upper triangle in rows, and the right side of `gauss_newton_step` about the pivot c."""
    system, scale = np.zeros(9), 0.0
    for p in range(len(weights)):
        w, tx, ty = weights[p], members.tangent[p, 0], members.tangent[p, 1]
        lx, ly = cy - moved[p, 1], moved[p, 0] - cx
        mlx, mly = across(tx, ty, lx, ly)
        mrx, mry = across(tx, ty, moved[p, 0] - members.partner[p, 0], moved[p, 1] - members.partner[p, 1])
        mxx, mxy = across(tx, ty, 1.0, 0.0)
        _, myy = across(tx, ty, 0.0, 1.0)
        scale += w * (lx * lx + ly * ly)
        system[0] += w * (lx * mlx + ly * mly)
        system[1] += w * mlx
        system[2] += w * mly
        system[3] += w * mxx
        system[4] += w * mxy
        system[5] += w * myy
        system[6] -= w * (lx * mrx + ly * mry)
        system[7] -= w * mrx
        system[8] -= w * mry
    system[0] += TURN_DAMPING * scale + LEAST_DAMPING * total
    system[3] += SHIFT_DAMPING * total
    system[5] += SHIFT_DAMPING * total
    return system


@kernel
def pull_step(
    moved: Array,
    members: Members,
    weights: Array,
    slope: Array,
    start: Array,
    to_moved: Array,
    to_partner: Array,
    to_weights: Array,
) -> tuple[float, float, float]:
    """Writes the slopes of a Gauss-Newton step that follows a motion, and returns the slope of that motion itself.

    Args:
        moved: (P, 2) points under the motion `start` (3,). weights: (P,) robust ones. slope: (3,) of the motion after the step.
        to_moved, to_partner: (P, 2), to_weights: (P,), slopes written.
    """
    P = len(weights)
    cx, cy = mean_point(moved, weights)
    raw = 0.0
    for p in range(P):
        raw += weights[p]
    total = max(raw, LEAST_TOTAL)
    cx, cy = cx * raw / total, cy * raw / total
    a, b, c, d, e, f, x, y, z = normal_system(moved, members, weights, total, cx, cy)
    s0, s1, s2 = solve(a, b, c, d, e, f, x, y, z)
    theta = min(max(s0, -LARGEST_TURN), LARGEST_TURN)
    turn = transform_of(np.array([theta, 0.0, 0.0]))
    ox, oy = rotate(turn, start[1], start[2])
    px, py = rotate(turn, cx, cy)
    gx, gy = slope[1], slope[2]
    g0 = slope[0] + gx * (py - oy) + gy * (ox - px)  # shift = c - R c + s, then R applied to the start's
    bx, by = rotate_back(turn, gx, gy)
    to_cx, to_cy = gx - bx, gy - by
    l0, l1, l2 = solve(a, b, c, d, e, f, g0 if s0 == theta else 0.0, gx, gy)
    turning, shifting = l0 * s0, l1 * s1 + l2 * s2
    damped = LEAST_DAMPING * turning + SHIFT_DAMPING * shifting if raw > LEAST_TOTAL else 0.0
    for p in range(P):
        w, tx, ty = weights[p], members.tangent[p, 0], members.tangent[p, 1]
        lx, ly = cy - moved[p, 1], moved[p, 0] - cx
        ux, uy = l0 * lx + l1, l0 * ly + l2
        vx = s0 * lx + s1 + moved[p, 0] - members.partner[p, 0]
        vy = s0 * ly + s2 + moved[p, 1] - members.partner[p, 1]
        mux, muy = across(tx, ty, ux, uy)
        mvx, mvy = across(tx, ty, vx, vy)
        to_weights[p] = -(ux * mvx + uy * mvy) - TURN_DAMPING * turning * (lx * lx + ly * ly) - damped
        to_lx = -w * (l0 * mvx + s0 * mux + 2 * TURN_DAMPING * turning * lx)
        to_ly = -w * (l0 * mvy + s0 * muy + 2 * TURN_DAMPING * turning * ly)
        to_moved[p, 0], to_moved[p, 1] = to_ly - w * mux, -to_lx - w * muy
        to_partner[p, 0], to_partner[p, 1] = w * mux, w * muy
        to_cx, to_cy = to_cx - to_ly, to_cy + to_lx
    for p in range(P):
        share = weights[p] / total
        to_moved[p, 0] += share * to_cx
        to_moved[p, 1] += share * to_cy
        ax, ay = (moved[p, 0] - cx, moved[p, 1] - cy) if raw > LEAST_TOTAL else (moved[p, 0], moved[p, 1])
        to_weights[p] += (ax * to_cx + ay * to_cy) / total
    return slope[0], bx, by


@kernel
def pull_line(members: Members, start: Array, scale: float, slope: Array, to_weights: Array, to_partner: Array) -> Array:
    """(3,) slope of the start of `line_step`; writes those of the weights (P,) and partners (P, 2). slope: (3,) of the motion."""
    P = len(members.weights)
    moved, robust, by = np.empty((P, 2)), np.empty(P), transform_of(start)
    for p in range(P):
        moved[p, 0], moved[p, 1] = transform(by, members.points[p, 0], members.points[p, 1])
        dx, dy = moved[p, 0] - members.partner[p, 0], moved[p, 1] - members.partner[p, 1]
        robust[p] = robust_weight(dx * dx + dy * dy, scale)
    weights, to_moved, before = members.weights * robust, np.empty((P, 2)), np.empty(3)
    before[0], before[1], before[2] = pull_step(moved, members, weights, slope, start, to_moved, to_partner, to_weights)
    for p in range(P):
        dx, dy = moved[p, 0] - members.partner[p, 0], moved[p, 1] - members.partner[p, 1]
        pull = -2 * to_weights[p] * members.weights[p] * robust[p] ** 2 / scale**2
        to_weights[p] *= robust[p]
        to_partner[p, 0] -= pull * dx
        to_partner[p, 1] -= pull * dy
        add_moved(before, start, moved[p, 0], moved[p, 1], to_moved[p, 0] + pull * dx, to_moved[p, 1] + pull * dy)
    return before


@kernel
def pull_shares(members: Members, total: float, is_least: bool, to_weights: Array) -> None:
    """Turns slopes (P,) of the weights' shares of their total into slopes of the weights. is_least: the total is a constant."""
    mean = 0.0
    for p in range(len(to_weights)):
        mean += members.weights[p] * to_weights[p] / total
    for p in range(len(to_weights)):
        to_weights[p] = (to_weights[p] - (0.0 if is_least else mean)) / total


@kernel
def pull_point(members: Members, slope: Array, to_weights: Array, to_partner: Array) -> None:
    """Writes the slopes of the weights (P,) and partners (P, 2) of `kabsch`. slope: (3,) of the motion."""
    P, weights = len(members.weights), members.weights
    px, py = mean_point(members.points, weights)
    qx, qy = mean_point(members.partner, weights)
    sine = cosine = size = total = 0.0
    for p in range(P):
        w, ax, ay = weights[p], members.points[p, 0] - px, members.points[p, 1] - py
        bx, by = members.partner[p, 0] - qx, members.partner[p, 1] - qy
        total, sine, cosine = total + w, sine + w * (ax * by - ay * bx), cosine + w * (ax * bx + ay * by)
        size += (
            w * math.hypot(members.points[p, 0], members.points[p, 1]) * math.hypot(members.partner[p, 0], members.partner[p, 1])
        )
    is_determined = max(abs(sine), abs(cosine)) > ROUNDING * size
    turn = transform_of(np.array([math.atan2(sine, cosine) if is_determined else 0.0, 0.0, 0.0]))
    rx, ry = rotate(turn, px, py)
    ox, oy = rotate_back(turn, slope[1], slope[2])
    to_theta = (slope[0] + slope[1] * ry - slope[2] * rx) * total / (sine**2 + cosine**2) if is_determined else 0.0
    to_sine, to_cosine = to_theta * cosine, -to_theta * sine
    for p in range(P):
        ax, ay = members.points[p, 0] - px, members.points[p, 1] - py
        bx, by = members.partner[p, 0] - qx, members.partner[p, 1] - qy
        share = weights[p] / total
        to_weights[p] = to_sine * (ax * by - ay * bx) + to_cosine * (ax * bx + ay * by)
        to_weights[p] += slope[1] * members.partner[p, 0] + slope[2] * members.partner[p, 1]
        to_weights[p] -= ox * members.points[p, 0] + oy * members.points[p, 1]
        to_partner[p, 0] = share * (slope[1] - to_sine * ay + to_cosine * ax)
        to_partner[p, 1] = share * (slope[2] + to_sine * ax + to_cosine * ay)
    pull_shares(members, total, False, to_weights)


@kernel
def pull_shift(members: Members, theta: float, slope: Array, to_weights: Array, to_partner: Array) -> float:
    """The slope of the rotation of `shift_at`; writes those of the weights (P,) and partners (P, 2). slope: (3,) of the motion."""
    turn, total, to_theta = transform_of(np.array([theta, 0.0, 0.0])), 0.0, slope[0]
    for p in range(len(members.weights)):
        total += members.weights[p]
    least = max(total, LEAST_TOTAL)
    for p in range(len(members.weights)):
        x, y = rotate(turn, members.points[p, 0], members.points[p, 1])
        share = members.weights[p] / least
        to_theta += share * (slope[1] * y - slope[2] * x)
        to_weights[p] = slope[1] * (members.partner[p, 0] - x) + slope[2] * (members.partner[p, 1] - y)
        to_partner[p, 0], to_partner[p, 1] = share * slope[1], share * slope[2]
    pull_shares(members, least, total < LEAST_TOTAL, to_weights)
    return to_theta


@kernel
def pull_partners(
    target: Array,
    candidates: Integers,
    log_association: Array,
    to_inlier: Array,
    to_partner: Array,
    to_association: Array,
) -> None:
    """Adds to the slopes (N, K+1) of the beliefs those through `soft_partners`. to_inlier: (N,), to_partner: (N, 2) slopes."""
    for i in range(len(log_association)):
        K = candidates.shape[1]
        total = mean = 0.0
        for k in range(K):
            belief, j = math.exp(log_association[i, k]), candidates[i, k]
            total += belief
            mean += belief * (to_partner[i, 0] * target[j, 0] + to_partner[i, 1] * target[j, 1])
        least = max(total, LEAST_TOTAL)
        mean = mean / least if total >= LEAST_TOTAL else 0.0
        for k in range(K):
            belief, j = math.exp(log_association[i, k]), candidates[i, k]
            of_share = to_partner[i, 0] * target[j, 0] + to_partner[i, 1] * target[j, 1]
            to_association[i, k] += belief * ((of_share - mean) / least + to_inlier[i])


@kernel
def pull_estimate(
    source: Array,
    association: Integers,
    cluster: Integers,
    partners: Partners,
    log_cluster: Array,
    motions: Array,
    active: Booleans,
    metric: int,
    scale: float,
    min_extent: float,
    turn: float,
    slopes: Array,
    to_cluster: Array,
    to_inlier: Array,
    to_partner: Array,
) -> Array:
    """(C, 3) slopes of the motions before `estimate`, to beliefs; adds those of the beliefs.

    Args:
        turn: the background's fitted rotation, radians. slopes: (C, 3) of the fitted motions, changed in place.
        to_cluster: (N, D), to_inlier: (N,), to_partner: (N, 2) slopes added to.
        The others as in `estimate`.
    """
    if metric == GIVEN:
        return slopes.copy()
    before, to_turn = np.zeros_like(slopes), 0.0
    for c in range(len(motions) - 1, -1, -1):  # the background last: small clusters take its rotation
        places = places_of(association, cluster, c)
        has_rotation = is_large(source, places, min_extent)
        if c == 0:
            slopes[0, 0] += to_turn
        if not active[c] or (not has_rotation and (len(places) == 0 or c == 0)):
            before[c] += slopes[c]
            continue
        members, some = likely_members(source, partners, log_cluster, c)
        to_weights, to_some = np.empty(len(some)), np.empty((len(some), 2))
        if not has_rotation:
            to_turn += pull_shift(members, turn, slopes[c], to_weights, to_some)
        elif metric == POINT:
            pull_point(members, slopes[c], to_weights, to_some)
        else:
            before[c] += pull_line(members, motions[c], scale, slopes[c], to_weights, to_some)
        for p in range(len(some)):
            i, belief = some[p], math.exp(log_cluster[some[p], c])
            to_cluster[i, c] += to_weights[p] * belief * partners.inlier[i]
            to_inlier[i] += to_weights[p] * belief
            to_partner[i, 0] += to_some[p, 0]
            to_partner[i, 1] += to_some[p, 1]
    return before
