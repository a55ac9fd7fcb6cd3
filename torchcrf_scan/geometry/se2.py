"""Rigid motions of the plane as (..., 3) rows (theta, tx, ty).

`T_target_source` maps source points into the target frame: p_target = R(theta) p_source + t, R acting on column vectors
(the paper's Eq. 6 writes row vectors, hence its R is the transpose). Every function takes torch tensors or numpy arrays.
"""

from __future__ import annotations

import math
from types import ModuleType
from typing import TypeVar

import numpy as np
import torch

Array = TypeVar("Array", torch.Tensor, np.ndarray)


def _namespace(array: Array) -> ModuleType:
    return torch if isinstance(array, torch.Tensor) else np


def wrap(angle: Array) -> Array:
    """Angle in (-pi, pi]."""
    return math.pi - (math.pi - angle) % (2 * math.pi)


def rotate(theta: Array, points: Array) -> Array:
    """R(theta) points. theta: (...,); points: (..., 2), broadcast together."""
    xp = _namespace(points)
    c, s = xp.cos(theta), xp.sin(theta)
    x, y = points[..., 0], points[..., 1]
    return xp.stack([c * x - s * y, s * x + c * y], axis=-1)


def apply(motion: Array, points: Array) -> Array:
    """Moves points. motion: (..., 3); points: (..., P, 2). Returns (..., P, 2)."""
    return rotate(motion[..., 0, None], points) + motion[..., None, 1:]


def compose(second: Array, first: Array) -> Array:
    """The motion that applies `first`, then `second`. (..., 3) each."""
    xp = _namespace(first)
    translation = rotate(second[..., 0], first[..., 1:]) + second[..., 1:]
    return xp.concatenate([wrap(second[..., :1] + first[..., :1]), translation], axis=-1)


def inverse(motion: Array) -> Array:
    """The motion that undoes `motion`: (..., 3). The sensor's own motion is the inverse of the background's."""
    xp = _namespace(motion)
    return xp.concatenate([wrap(-motion[..., :1]), -rotate(-motion[..., 0], motion[..., 1:])], axis=-1)


def distance(a: Array, b: Array) -> tuple[Array, Array]:
    """Rotation error |wrap(theta_a - theta_b)| in radians and translation error in metres: (...,) each."""
    xp = _namespace(a)
    delta = a[..., 1:] - b[..., 1:]
    return abs(wrap(a[..., 0] - b[..., 0])), xp.sqrt((delta**2).sum(-1))
