"""Covariances of poses and velocities, never singular."""

from __future__ import annotations

import numpy as np

from torchcrf_scan.scan import Floats

UNKNOWN = (np.pi, 10.0, 10.0)  # standard deviations of what is not known at all: radians, metres
LEAST = np.diag([1e-8, 1e-8, 1e-8])  # added to every covariance


def unknown() -> Floats:
    """(3, 3) covariance of a pose or a velocity of which nothing is known."""
    return np.diag(np.square(UNKNOWN))


def turned(covariance: Floats, angle: float) -> Floats:
    """(3, 3) covariance of (theta, x, y) in axes from which the old ones are turned by an angle."""
    cos, sin = np.cos(angle), np.sin(angle)
    turn = np.array([[1.0, 0.0, 0.0], [0.0, cos, -sin], [0.0, sin, cos]])
    return turn @ covariance @ turn.T


def world_covariance(covariance: Floats, frame: Floats) -> Floats:
    """(3, 3) of a pose in the world, from that of the motion into a frame whose pose (3,) counts as known."""
    return turned(covariance, float(frame[0])) + LEAST


def velocity_covariance(now: Floats, before: Floats, pose: Floats, interval: float) -> Floats:
    """(3, 3) of the velocity in the sensor's frame, from those of two poses `interval` seconds apart, taken as independent."""
    return turned(now + before, -float(pose[0])) / interval**2 + LEAST
