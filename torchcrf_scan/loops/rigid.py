"""Rigid motions of the plane, one at a time: (theta, tx, ty) arrays of three."""

from __future__ import annotations

import math

import numpy as np

from torchcrf_scan.loops.jit import Array, kernel


@kernel
def wrap(angle: float) -> float:
    """To (-pi, pi]."""
    return math.pi - (math.pi - angle) % (2 * math.pi)


@kernel
def apply(motion: Array, points: Array) -> Array:
    """(P, 2) points under a motion (3,)."""
    cos, sin = math.cos(motion[0]), math.sin(motion[0])
    moved = np.empty_like(points)
    for i in range(len(points)):
        x, y = points[i, 0], points[i, 1]
        moved[i, 0] = cos * x - sin * y + motion[1]
        moved[i, 1] = sin * x + cos * y + motion[2]
    return moved


@kernel
def inverse(motion: Array) -> Array:
    """(3,) the motion that undoes it."""
    cos, sin = math.cos(motion[0]), math.sin(motion[0])
    back = np.empty(3)
    back[0] = wrap(-motion[0])
    back[1] = -cos * motion[1] - sin * motion[2]
    back[2] = sin * motion[1] - cos * motion[2]
    return back


@kernel
def compose(after: Array, before: Array) -> Array:
    """(3,) `before`, then `after`."""
    cos, sin = math.cos(after[0]), math.sin(after[0])
    both = np.empty(3)
    both[0] = wrap(after[0] + before[0])
    both[1] = cos * before[1] - sin * before[2] + after[1]
    both[2] = sin * before[1] + cos * before[2] + after[2]
    return both
