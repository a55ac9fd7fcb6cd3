"""Covariance of the motions and calibrated confidence of the labels of one pair; `inference.uncertainty`."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from torchcrf_scan.fast.motion import POINT, Members, members_of, places_of
from torchcrf_scan.fast.robust import robust_weight
from torchcrf_scan.inference.uncertainty import BENT, COARSE, EMPTY, MOST_CERTAIN, NOTHING, RIDGE, RUNS, SHARED, TINY, WITHIN
from torchcrf_scan.loops.jit import Array, Integers, entry, kernel
from torchcrf_scan.loops.rigid import rotate, transform, transform_of
from torchcrf_scan.loops.solve import axes_of, inverse_of, product
from torchcrf_scan.prediction import LEAST_SHARE
from torchcrf_scan.search.directions import Directions, directions_of

EXCLUDED = math.exp(2 * MOST_CERTAIN)  # belief of a state in the sum that excludes it


class Fit(NamedTuple):
    """A cluster's residuals near its motion, as functions of (theta L, x, y); `inference.uncertainty.Linearisation`.

    Attributes:
        weights: (P,). residual: (P, 2). jacobian: (P, 2, 3). freedom: (P,). centre: (2,). length: L.
    """

    weights: Array
    residual: Array
    jacobian: Array
    freedom: Array
    centre: Array
    length: float


@kernel
def linearise(
    members: Members, places: Integers, motion: Array, metric: int, scale: float, noise: float, surface: Directions
) -> Fit:
    """A cluster's fit at its motion. surface: of all source points."""
    P = len(places)
    by = transform_of(motion)
    weights, residual, arm, centre = np.ones(P), np.empty((P, 2)), np.empty((P, 2)), np.zeros(2)
    total = 0.0
    for p in range(P):
        arm[p, 0], arm[p, 1] = transform(by, members.points[p, 0], members.points[p, 1])
        residual[p, 0], residual[p, 1] = arm[p, 0] - members.partner[p, 0], arm[p, 1] - members.partner[p, 1]
        if metric != POINT:
            weights[p] = robust_weight(residual[p, 0] ** 2 + residual[p, 1] ** 2, scale)
        total += weights[p]
        centre[0] += weights[p] * arm[p, 0]
        centre[1] += weights[p] * arm[p, 1]
    total = max(total, 1e-9)
    centre[0], centre[1] = centre[0] / total, centre[1] / total
    second = 0.0
    for p in range(P):
        arm[p, 0], arm[p, 1] = arm[p, 0] - centre[0], arm[p, 1] - centre[1]
        second += weights[p] * (arm[p, 0] ** 2 + arm[p, 1] ** 2)
    length = math.sqrt(second / total + noise**2)
    jacobian, freedom = np.empty((P, 2, 3)), np.full(P, 2.0)
    for p in range(P):
        ux = uy = 0.0
        if metric != POINT:
            ux, uy = members.tangent[p, 0], members.tangent[p, 1]
            if surface.is_found[places[p]] and (ux != 0 or uy != 0 or surface.is_straight[places[p]]):
                ux, uy = rotate(by, surface.tangent[places[p], 0], surface.tangent[places[p], 1])
        lx, ly = -arm[p, 1] / length, arm[p, 0] / length
        along = ux * lx + uy * ly
        jacobian[p, 0, 0], jacobian[p, 1, 0] = lx - ux * along, ly - uy * along
        jacobian[p, 0, 1], jacobian[p, 1, 1] = 1 - ux * ux, -uy * ux
        jacobian[p, 0, 2], jacobian[p, 1, 2] = -ux * uy, 1 - uy * uy
        along = ux * residual[p, 0] + uy * residual[p, 1]
        residual[p, 0], residual[p, 1] = residual[p, 0] - ux * along, residual[p, 1] - uy * along
        freedom[p] -= ux * ux + uy * uy
    return Fit(weights, residual, jacobian, freedom, centre, length)


class Sums(NamedTuple):
    """Sums over the first points of a fit, with weights w, residuals r and Jacobians J.

    Attributes:
        score: (P+1, 3) of w J^T r. normal: (P+1, 3, 3) of H = w J^T J. apart: (P+1, 3, 3) of w H.
        total: of all weights. spread: mean squared residual.
    """

    score: Array
    normal: Array
    apart: Array
    total: float
    spread: float


@kernel
def sums_of(fit: Fit) -> Sums:
    """Sums over the points of a fit."""
    P = len(fit.weights)
    score, normal, apart = np.zeros((P + 1, 3)), np.zeros((P + 1, 3, 3)), np.zeros((P + 1, 3, 3))
    total = squares = free = 0.0
    for p in range(P):
        w, j = fit.weights[p], fit.jacobian[p]
        rx, ry = fit.residual[p, 0], fit.residual[p, 1]
        total += w
        squares += w * (rx * rx + ry * ry)
        free += w * fit.freedom[p]
        for r in range(3):
            score[p + 1, r] = score[p, r] + w * (j[0, r] * rx + j[1, r] * ry)
            for d in range(3):
                both = w * (j[0, r] * j[0, d] + j[1, r] * j[1, d])
                normal[p + 1, r, d] = normal[p, r, d] + both
                apart[p + 1, r, d] = apart[p, r, d] + w * both
    return Sums(score, normal, apart, max(total, 1e-9), squares / max(free, 1e-9))


@kernel
def shared_error(fit: Fit, places: Integers, spread: float, noise: float, surface: Directions) -> float:
    """Squared error of a motion that all its points share; `inference.uncertainty`. places: (P,). spread: mean squared residual."""
    sampled = free = 0.0
    for p in range(len(places)):
        share = fit.weights[p] * fit.freedom[p]
        sampled, free = sampled + share * surface.spacing[places[p]] ** 2, free + share
    beyond = spread - noise**2
    return max(beyond if surface.step >= COARSE else SHARED**2 * (beyond - BENT**2 * sampled / max(free, 1e-9)), 0.0)


@kernel
def score_covariance(sums: Sums, places: Integers, noise: float) -> Array:
    """(3, 3) covariance of the summed score, the middle of the sandwich estimator.

    places: (P,) of the points, ascending. noise: standard deviation of a return.
    """
    P = len(places)
    length = (P + RUNS - 1) // RUNS
    step, whole, meat = sums.score[P], sums.normal[P].copy(), np.zeros((3, 3))
    for r in range(3):
        whole[r, r] += RIDGE * sums.total
    rest, score = np.empty((3, 3)), np.empty(3)
    enters = leaves = 0
    for last in range(places[0] if P > 0 else 0, (places[P - 1] + length) if P > 0 else 0):
        if enters < P and places[enters] == last:
            enters += 1
        if leaves < P and places[leaves] == last - length:
            leaves += 1
        if enters == leaves:
            continue
        for r in range(3):
            for d in range(3):
                rest[r, d] = whole[r, d] - (sums.normal[enters, r, d] - sums.normal[leaves, r, d])
        change = product(whole, inverse_of(rest))
        for r in range(3):
            score[r] = 0.0
            for d in range(3):
                score[r] += change[r, d] * (sums.score[enters, d] - sums.score[leaves, d])
                rest[r, d] = sums.apart[enters, r, d] - sums.apart[leaves, r, d]
        alone = product(product(change, rest), change.T.copy())
        for r in range(3):
            for d in range(3):
                meat[r, d] += (score[r] * score[d] + noise**2 * alone[r, d]) / length
    for r in range(3):
        for d in range(3):
            meat[r, d] += (NOTHING * max(noise**2, sums.spread) if r == d else 0.0) + step[r] * step[d]
    return meat


@kernel
def projection_on(information: Array, directions: Array) -> Array:
    """(3, 3) projection on the directions (3, 3), a row each, of sufficient information (3,)."""
    keep = np.zeros((3, 3))
    for k in range(3):
        if information[k] >= LEAST_SHARE:
            for r in range(3):
                for d in range(3):
                    keep[r, d] += directions[k, r] * directions[k, d]
    return keep


@kernel
def cluster_covariance(
    fit: Fit, places: Integers, motion: Array, metric: int, noise: float, reach: float, surface: Directions
) -> tuple[Array, Array, Array]:
    """(3, 3) covariance, (3,) information and (3, 3) directions of one motion, as `inference.uncertainty` defines them.

    Args:
        places: (P,) the cluster's points, ascending. motion: (3,). metric: POINT, else point-to-line.
        noise: standard deviation of a return. reach: largest distance of a source point from the sensor.
        surface: of all source points.
    """
    sums = sums_of(fit)
    normal, total = sums.normal[len(places)].copy(), sums.total
    for r in range(3):
        for d in range(3):
            normal[r, d] /= total
    information, directions = axes_of(normal)
    if metric != POINT:  # without information due to the tangents' noise and to steps along the surface
        for r in range(3):
            normal[r, r] -= LEAST_SHARE
    keep = projection_on(information, directions)
    bread = product(product(keep, normal), keep)
    known = product(product(bread, inverse_of(score_covariance(sums, places, noise))), bread)
    for r in range(3):
        for d in range(3):
            known[r, d] *= total * total
    known[0, 0] += 3 / (math.pi * fit.length) ** 2
    known[1, 1] += 1 / reach**2
    known[2, 2] += 1 / reach**2
    x, y = motion[1] - fit.centre[0], motion[2] - fit.centre[1]
    local = inverse_of(known)
    if metric != POINT:
        shared = shared_error(fit, places, sums.spread, noise, surface)
        for r in range(3):
            local[r, r] += shared
    return about_origin(local, fit.length, x, y), information, directions


@kernel
def about_origin(local: Array, length: float, x: float, y: float) -> Array:
    """(3, 3) covariance of (theta, tx, ty) from that of (theta L, x, y) about a centroid; (x, y): from there to the translation."""
    change = np.zeros((3, 3))
    change[0, 0], change[1, 0], change[2, 0] = 1 / length, -y / length, x / length
    change[1, 1] = change[2, 2] = 1.0
    covariance = product(product(change, local), change.T.copy())
    for r in range(3):
        for d in range(r):
            covariance[r, d] = covariance[d, r] = (covariance[r, d] + covariance[d, r]) / 2
    return covariance


@entry
def motion_covariance(
    source: Array,
    target: Array,
    tangents: Array,
    association: Integers,
    cluster: Integers,
    motions: Array,
    metric: int,
    scale: float,
    noise: float,
) -> tuple[Array, Array, Array]:
    """Covariances (C, 3, 3), information (C, 3) and directions (C, 3, 3) of the motions (C, 3); see `inference.uncertainty`.

    Args:
        source: (N, 2) in beam order; target, tangents: (M, 2); association, cluster: (N,), -1 outlier, of the last fit.
        metric: POINT, else point-to-line. scale: residual at which a robust weight is one half.
        noise: standard deviation of a return. Both in the unit of the points.
    """
    N, C = len(source), len(motions)
    reach = 0.0
    mask = np.empty(N, np.bool_)
    for i in range(N):
        reach = max(reach, source[i, 0] ** 2 + source[i, 1] ** 2)
        mask[i] = cluster[i] >= 0 and association[i] >= 0
    reach = max(math.sqrt(reach) if reach > 0 else EMPTY * noise, 1e-3)
    noise = max(noise, TINY * reach)
    if metric == POINT:
        mask[:] = False
    surface = directions_of(source, mask, noise)
    covariance, information, directions = np.empty((C, 3, 3)), np.empty((C, 3)), np.empty((C, 3, 3))
    for c in range(C):
        places = places_of(association, cluster, c)
        members = members_of(source, target, tangents, association, places)
        fit = linearise(members, places, motions[c], metric, scale, noise, surface)
        covariance[c], information[c], directions[c] = cluster_covariance(fit, places, motions[c], metric, noise, reach, surface)
    return covariance, information, directions


@kernel
def confidence(yes: float, no: float, calibration: Array) -> float:
    """Calibrated probability of a label with belief `yes` against `no`. calibration: (2,) slope and offset."""
    return 1 / (1 + math.exp(-(calibration[0] * (math.log(yes) - math.log(no)) + calibration[1])))


@entry
def association_confidence(log_association: Array, candidates: Integers, association: Integers, calibration: Array) -> Array:
    """(N,) calibrated probability that an association is right within `WITHIN` target points.

    log_association: (N, K+1). candidates: (N, K). association: (N,), -1 outlier. calibration: (2,) slope and offset.
    """
    N, K = candidates.shape
    sure = np.empty(N)
    for i in range(N):
        yes = no = 0.0
        for k in range(K + 1):
            belief = math.exp(max(log_association[i, k], MOST_CERTAIN))
            is_near = k < K and association[i] >= 0 and abs(candidates[i, k] - association[i]) <= WITHIN
            is_chosen = is_near or (k == K and association[i] < 0)
            yes += belief if is_chosen else EXCLUDED
            no += EXCLUDED if is_chosen else belief
        sure[i] = confidence(yes, no, calibration)
    return sure


@entry
def cluster_confidence(log_cluster: Array, cluster: Integers, calibration: Array) -> Array:
    """(N,) calibrated probability of the chosen cluster. log_cluster: (N, D). cluster: (N,), -1 outlier. calibration: (2,)."""
    N, D = log_cluster.shape
    sure = np.empty(N)
    for i in range(N):
        chosen = cluster[i] if cluster[i] >= 0 else D - 1
        yes = no = 0.0
        for k in range(D):
            belief = math.exp(max(log_cluster[i, k], MOST_CERTAIN))
            yes += belief if k == chosen else EXCLUDED
            no += EXCLUDED if k == chosen else belief
        sure[i] = confidence(yes, no, calibration)
    return sure
