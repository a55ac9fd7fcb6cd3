"""Planar covariances as ROS messages have them: six by six, in a form that filters accept."""

from __future__ import annotations

import numpy as np

from torchcrf_scan.scan import Floats

LEAST, MOST = 1e-9, 1e6  # variances, in units of m^2 and rad^2 (and per second squared); outside, filters become unstable
PLANAR = 1e-6  # variance of z, roll and pitch, which are 0 in the plane
PLACES = (5, 0, 1)  # of theta, x and y among x, y, z, roll, pitch, yaw


def spatial_covariance(covariance: Floats) -> Floats:
    """(36,) of (x, y, z, roll, pitch, yaw), row by row, of (3, 3) of (theta, x, y): symmetric, finite, positive definite.

    Its variances in any direction are at least `LEAST` and at most `MOST`; numbers that are not finite count as unknown.
    """
    if np.isfinite(covariance).all():
        values, vectors = np.linalg.eigh((covariance + covariance.T) / 2)
        planar = (vectors * np.clip(values, LEAST, MOST)) @ vectors.T
    else:
        planar = MOST * np.eye(3)
    full = PLANAR * np.eye(6)
    full[np.ix_(PLACES, PLACES)] = (planar + planar.T) / 2
    return full.ravel()
