"""Motions at constant velocity: the exponential map of the plane's rigid motions and its inverse."""

from __future__ import annotations

import numpy as np

from torchcrf_scan.geometry import se2
from torchcrf_scan.scan import Floats

SMALL = 1e-6  # radians below which an arc counts as straight


def _arc(theta: Floats) -> tuple[Floats, Floats]:
    """sin(theta) / theta and (1 - cos(theta)) / theta, (...,)."""
    safe = np.where(np.abs(theta) < SMALL, 1.0, theta)
    straight = np.abs(theta) < SMALL
    return np.where(straight, 1.0, np.sin(safe) / safe), np.where(straight, theta / 2, (1 - np.cos(safe)) / safe)


def exp(twist: Floats) -> Floats:
    """(..., 3) motions after one second at velocities (theta, x, y) (..., 3), constant in the moving frame."""
    sine, versine = _arc(twist[..., 0])
    x, y = twist[..., 1], twist[..., 2]
    return np.stack([se2.wrap(twist[..., 0]), sine * x - versine * y, versine * x + sine * y], axis=-1)


def log(motion: Floats) -> Floats:
    """(..., 3) velocities that make the motions (..., 3) in one second: the inverse of `exp`."""
    theta = se2.wrap(motion[..., 0])
    sine, versine = _arc(theta)
    size = sine**2 + versine**2
    x, y = motion[..., 1], motion[..., 2]
    return np.stack([theta, (sine * x + versine * y) / size, (sine * y - versine * x) / size], axis=-1)
