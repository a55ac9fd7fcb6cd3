"""Rigid motions of the plane, one at a time: (theta, tx, ty) arrays of three."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from torchcrf_scan.loops.jit import Array, Integers, kernel


class Transform(NamedTuple):
    """A motion prepared for many points: cosine and sine of its rotation, and its translation."""

    cos: float
    sin: float
    tx: float
    ty: float


@kernel
def wrap(angle: float) -> float:
    """The angle in (-pi, pi], radians."""
    return math.pi - (math.pi - angle) % (2 * math.pi)


@kernel
def transform_of(motion: Array) -> Transform:
    """The transform of a motion (3,)."""
    return Transform(math.cos(motion[0]), math.sin(motion[0]), motion[1], motion[2])


@kernel
def transform(by: Transform, x: float, y: float) -> tuple[float, float]:
    """A point under a rigid motion."""
    return by.cos * x - by.sin * y + by.tx, by.sin * x + by.cos * y + by.ty


@kernel
def rotate(by: Transform, x: float, y: float) -> tuple[float, float]:
    """A direction under the motion's rotation."""
    return by.cos * x - by.sin * y, by.sin * x + by.cos * y


@kernel
def rotate_back(by: Transform, x: float, y: float) -> tuple[float, float]:
    """A direction under the inverse of the motion's rotation."""
    return by.cos * x + by.sin * y, by.cos * y - by.sin * x


@kernel
def apply(motion: Array, points: Array) -> Array:
    """(P, 2) points under a motion (3,)."""
    by, moved = transform_of(motion), np.empty_like(points)
    for i in range(len(points)):
        moved[i, 0], moved[i, 1] = transform(by, points[i, 0], points[i, 1])
    return moved


@kernel
def apply_to_rows(motion: Array, points: Array, rows: Array) -> None:
    """Writes (P, 2) points under a motion (3,) to the first two of the rows (2 or more, P or more): x and y."""
    by = transform_of(motion)
    for i in range(len(points)):
        rows[0, i], rows[1, i] = transform(by, points[i, 0], points[i, 1])


@kernel
def apply_to_some(motion: Array, points: Array, index: Integers, rows: Array) -> None:
    """`apply_to_rows` of the points with these indices (L,) alone. rows: (2 or more, L or more)."""
    by = transform_of(motion)
    for k in range(len(index)):
        rows[0, k], rows[1, k] = transform(by, points[index[k], 0], points[index[k], 1])


@kernel
def inverse(motion: Array) -> Array:
    """(3,) the inverse motion."""
    back = np.empty(3)
    back[0] = wrap(-motion[0])
    back[1], back[2] = rotate_back(transform_of(motion), -motion[1], -motion[2])
    return back


@kernel
def compose(after: Array, before: Array) -> Array:
    """(3,) the motion `before`, then `after`."""
    both = before.copy()
    compose_into(both, after)
    return both


@kernel
def compose_into(motion: Array, step: Array) -> None:
    """Makes a motion (3,) the same motion followed by a step (3,), in place."""
    x, y = transform(transform_of(step), motion[1], motion[2])
    motion[0], motion[1], motion[2] = wrap(step[0] + motion[0]), x, y


@kernel
def motion_onto(theta: float, px: float, py: float, qx: float, qy: float) -> Array:
    """(3,) the motion of rotation theta that takes the point p onto q."""
    x, y = rotate(Transform(math.cos(theta), math.sin(theta), 0.0, 0.0), px, py)
    motion = np.empty(3)
    motion[0], motion[1], motion[2] = theta, qx - x, qy - y
    return motion


@kernel
def parting(a: Transform, b: Transform, x: float, y: float) -> float:
    """Distance between the two places of a point under two motions."""
    ax, ay = transform(a, x, y)
    bx, by = transform(b, x, y)
    return math.sqrt((ax - bx) * (ax - bx) + (ay - by) * (ay - by))
