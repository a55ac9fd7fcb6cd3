"""Kalman filter of an object that moves at a nearly constant velocity. State: position (2) and velocity (2), in the world."""

from __future__ import annotations

import numpy as np

from torchcrf_scan.scan import Floats


def predict(state: Floats, covariance: Floats, dt: float, acceleration: float) -> tuple[Floats, Floats]:
    """State and covariance `dt` seconds later, under white noise acceleration; a time before is answered as no time at all.

    Args:
        state: (4,). covariance: (4, 4).
        acceleration: m/s per square root of a second: the standard deviation of the velocity's change within one second.

    Source: Bar-Shalom, Li, Kirubarajan, Estimation with Applications to Tracking and Navigation, 2001, section 6.2.2.
    """
    dt = max(dt, 0.0)
    transition, noise = np.eye(4), np.zeros((4, 4))
    for axis in (0, 1):
        transition[axis, axis + 2] = dt
        noise[axis, axis], noise[axis + 2, axis + 2] = dt**3 / 3, dt
        noise[axis, axis + 2] = noise[axis + 2, axis] = dt**2 / 2
    return transition @ state, transition @ covariance @ transition.T + acceleration**2 * noise


def update(state: Floats, covariance: Floats, innovation: Floats, H: Floats, R: Floats) -> tuple[Floats, Floats]:
    """State and covariance after a measurement, in Joseph's form: the covariance stays symmetric and positive.

    Args:
        state: (4,). covariance: (4, 4).
        innovation: (M,) measured minus expected. H: (M, 4) its derivative. R: (M, M) its noise.
    """
    gain = np.linalg.solve(H @ covariance @ H.T + R, H @ covariance).T  # (4, M)
    kept = np.eye(len(state)) - gain @ H
    updated = kept @ covariance @ kept.T + gain @ R @ gain.T
    return state + gain @ innovation, (updated + updated.T) / 2


def chi_square(innovation: Floats, S: Floats) -> Floats:
    """Squared Mahalanobis distances r^T S^-1 r. innovation: (..., M); S: (..., M, M). Returns (...,)."""
    scaled = np.linalg.solve(S, innovation[..., None])[..., 0]
    return np.asarray((innovation * scaled).sum(-1))
