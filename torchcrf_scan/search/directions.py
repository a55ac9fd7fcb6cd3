"""Directions of the surfaces of a scan, from stretches that are long compared with the noise; `inference.directions`."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from torchcrf_scan.inference.directions import MISSING, NEIGHBOURS, STEPS, STRAIGHT, STRETCH
from torchcrf_scan.loops.circle import usual_step
from torchcrf_scan.loops.jit import Array, Booleans, Integers, kernel


class Directions(NamedTuple):
    """Directions of the surfaces of a scan.

    Attributes:
        tangent: (N, 2). is_found: (N,) whether it is defined. is_straight: (N,) whether the point is in line with its neighbours.
        spacing: (N,) distance to the nearer neighbour. step: radians between beams, NaN for one point.
    """

    tangent: Array
    is_found: Booleans
    is_straight: Booleans
    spacing: Array
    step: float


@kernel
def turns_of(points: Array) -> Array:
    """(N,) radians from a beam to the next, 0 for the last. points: (N, 2) in beam order, as seen from the sensor."""
    turn = np.zeros(len(points))
    for i in range(len(points) - 1):
        x, y, u, v = points[i, 0], points[i, 1], points[i + 1, 0], points[i + 1, 1]
        turn[i] = abs(math.atan2(x * v - y * u, x * u + y * v))
    return turn


@kernel
def surface_runs(points: Array, noise: float) -> Integers:
    """(N,) ascending numbers of the runs of neighbouring beams of which few are missing.

    points: (N, 2) in beam order. noise: of a range; neighbours a few noises apart are never cut.
    """
    run, turn = np.zeros(len(points), np.int64), turns_of(points)
    step = usual_step(turn, np.nan)
    for i in range(len(points) - 1):
        gap = math.sqrt((points[i + 1, 0] - points[i, 0]) ** 2 + (points[i + 1, 1] - points[i, 1]) ** 2)
        run[i + 1] = run[i] + (1 if turn[i] > MISSING * step and gap > STRETCH * noise else 0)
    return run


@kernel
def spacing_of(points: Array) -> Array:
    """(N,) distance from a point to the nearer of its neighbours; 0 without one. points: (N, 2) in beam order."""
    N = len(points)
    near = np.zeros(N)
    for i in range(N - 1):
        gap = math.sqrt((points[i + 1, 0] - points[i, 0]) ** 2 + (points[i + 1, 1] - points[i, 1]) ** 2)
        near[i] = min(near[i], gap) if i > 0 else gap
        near[i + 1] = gap
    return near


@kernel
def is_straight(points: Array, run: Integers, noise: float) -> Booleans:
    """(N,) whether a point is in line with two neighbours of its run. points: (N, 2). run: (N,)."""
    N = len(points)
    found = np.zeros(N, np.bool_)
    for i in range(N - 2):
        if run[i] != run[i + 2]:
            continue
        x, y = points[i + 2, 0] - points[i, 0], points[i + 2, 1] - points[i, 1]
        u, v = points[i + 1, 0] - points[i, 0], points[i + 1, 1] - points[i, 1]
        length = math.sqrt(x * x + y * y)
        if length > 0 and abs(x * v - y * u) <= STRAIGHT * noise * length:
            found[i] = found[i + 1] = found[i + 2] = True
    return found


@kernel
def surface_tangents(points: Array, mask: Booleans, noise: float, run: Integers) -> tuple[Array, Booleans]:
    """(N, 2) direction of the surface at every point, from a stretch long compared with the noise, and (N,) whether it is defined.

    points: (N, 2) in beam order. mask: (N,) points to use. run: (N,) of `surface_runs`.
    """
    N = len(points)
    tangent, is_found = np.zeros((N, 2)), np.zeros(N, np.bool_)
    for i in range(N):
        if not mask[i]:
            continue
        low, high = max(i - NEIGHBOURS, 0), min(i + NEIGHBOURS + 1, N)
        while run[low] != run[i]:
            low += 1
        while run[high - 1] != run[i]:
            high -= 1
        nearest = np.inf
        for j in range(low, high):
            if mask[j] and j != i:
                nearest = min(nearest, (points[j, 0] - points[i, 0]) ** 2 + (points[j, 1] - points[i, 1]) ** 2)
        if nearest == np.inf:
            continue
        stretch = (STRETCH * noise) ** 2 + STEPS**2 * nearest
        total = mx = my = 0.0
        for j in range(low, high):
            if mask[j]:
                x, y = points[j, 0] - points[i, 0], points[j, 1] - points[i, 1]
                w = max(1 - (x * x + y * y) / stretch, 0.0)
                total, mx, my = total + w, mx + w * x, my + w * y
        total = max(total, 1e-9)
        mx, my = mx / total, my / total
        xx = yy = xy = 0.0
        for j in range(low, high):
            if mask[j]:
                x, y = points[j, 0] - points[i, 0], points[j, 1] - points[i, 1]
                w = max(1 - (x * x + y * y) / stretch, 0.0) / total
                xx, yy, xy = xx + w * (x - mx) ** 2, yy + w * (y - my) ** 2, xy + w * (x - mx) * (y - my)
        angle = math.atan2(2 * xy, xx - yy) / 2 if xy != 0 or xx != yy else 0.0
        tangent[i, 0], tangent[i, 1] = math.cos(angle), math.sin(angle)
        is_found[i] = xx + yy > 0
    return tangent, is_found


@kernel
def directions_of(points: Array, mask: Booleans, noise: float) -> Directions:
    """Directions of the surfaces of (N, 2) points in beam order. mask: (N,) points to use."""
    run = surface_runs(points, noise)
    tangent, is_found = surface_tangents(points, mask, noise, run)
    step = usual_step(turns_of(points), np.nan)
    return Directions(tangent, is_found, is_straight(points, run, noise), spacing_of(points), step)
