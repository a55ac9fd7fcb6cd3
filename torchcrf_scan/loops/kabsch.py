"""Least-squares rigid motion of paired points in closed form; `geometry.kabsch` with equal weights."""

from __future__ import annotations

import math

import numpy as np

from torchcrf_scan.loops.jit import Array, kernel
from torchcrf_scan.loops.rigid import motion_onto

ROUNDING = 8 * float(np.finfo(np.float64).eps)  # of a sum of products: a smaller spread is rounding noise


@kernel
def mean_point(points: Array) -> tuple[float, float]:
    """Mean of (P, 2) points; 0 where P = 0."""
    x = y = 0.0
    for i in range(len(points)):
        x, y = x + points[i, 0], y + points[i, 1]
    total = max(len(points), 1)
    return x / total, y / total


@kernel
def kabsch(points: Array, partner: Array) -> Array:
    """(3,) the motion that minimises the squared distances of points to their partners (the paper's Eq. 6).

    Args:
        points, partner: (P, 2), P >= 1. The rotation is 0 where they do not determine it (one point, identical points).
    """
    px, py = mean_point(points)
    qx, qy = mean_point(partner)
    sine = cosine = size = 0.0
    for i in range(len(points)):
        ax, ay = points[i, 0] - px, points[i, 1] - py
        bx, by = partner[i, 0] - qx, partner[i, 1] - qy
        sine += ax * by - ay * bx
        cosine += ax * bx + ay * by
        size += math.hypot(points[i, 0], points[i, 1]) * math.hypot(partner[i, 0], partner[i, 1])
    is_determined = max(abs(sine), abs(cosine)) > ROUNDING * size
    return motion_onto(math.atan2(sine, cosine) if is_determined else 0.0, px, py, qx, qy)
