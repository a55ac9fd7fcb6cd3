"""Least-squares rigid motion of paired points in closed form; `geometry.kabsch` without batches."""

from __future__ import annotations

import math

import numpy as np

from torchcrf_scan.loops.jit import Array, kernel
from torchcrf_scan.loops.rigid import motion_onto

ROUNDING = 8 * float(np.finfo(np.float64).eps)  # of a sum of products: a smaller spread is rounding noise
SMALLEST = 1e-300  # total weight that is divided by


@kernel
def mean_point(points: Array, weights: Array) -> tuple[float, float]:
    """Mean of (P, 2) points weighted by (P,); 0 where P = 0."""
    x = y = total = 0.0
    for i in range(len(points)):
        x, y, total = x + weights[i] * points[i, 0], y + weights[i] * points[i, 1], total + weights[i]
    total = max(total, SMALLEST)
    return x / total, y / total


@kernel
def kabsch(points: Array, partner: Array, weights: Array) -> Array:
    """(3,) the motion that minimises the weighted squared distances of points to their partners (the paper's Eq. 6).

    Args:
        points, partner: (P, 2), P >= 1. The rotation is 0 where they do not determine it (one point, identical points).
        weights: (P,), positive.
    """
    px, py = mean_point(points, weights)
    qx, qy = mean_point(partner, weights)
    sine = cosine = size = 0.0
    for i in range(len(points)):
        w, ax, ay = weights[i], points[i, 0] - px, points[i, 1] - py
        bx, by = partner[i, 0] - qx, partner[i, 1] - qy
        sine += w * (ax * by - ay * bx)
        cosine += w * (ax * bx + ay * by)
        size += w * (math.hypot(points[i, 0], points[i, 1]) * math.hypot(partner[i, 0], partner[i, 1]))
    is_determined = max(abs(sine), abs(cosine)) > ROUNDING * size
    return motion_onto(math.atan2(sine, cosine) if is_determined else 0.0, px, py, qx, qy)
