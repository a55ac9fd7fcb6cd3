"""What a match tells a tracker: the movers' points in the world, and their velocities over ground with covariances."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from torchcrf_scan.geometry import se2
from torchcrf_scan.geometry.velocity import ground_velocity
from torchcrf_scan.scan import BACKGROUND, Floats, Ints

UNKNOWN = 1e6  # (m/s)^2, of a velocity of which nothing is stated


class Sightings(NamedTuple):
    """The arguments of `Tracker.update`.

    Attributes:
        points: (N, 2) in the world. cluster: (N,). velocities: (K, 2) over ground, m/s. covariances: (K, 2, 2).
        sensor: (2,) its position in the world.
    """

    points: Floats
    cluster: Ints
    velocities: Floats
    covariances: Floats
    sensor: Floats


def sightings_of(
    points: Floats, cluster: Ints, motions: Floats, covariances: Floats | None, pose: Floats, since: float
) -> Sightings:
    """The movers of a scan that was matched to one `since` seconds earlier.

    Args:
        points: (N, 2) of the new scan, in its frame. cluster: (N,) 0 background, k >= 1 mover k, -1 outlier.
        motions: (K+1, 3) from the new scan into the earlier one, as `JointScanCRF.match(new, earlier)` gives them.
        covariances: (K+1, 3, 3) of them; None: not known.
        pose: (3,) `T_world_sensor` of the new scan.
    """
    K = len(motions) - 1
    velocities, spread = np.full((K, 2), np.nan), np.tile(UNKNOWN * np.eye(2), (K, 1, 1))
    for k in range(1, K + 1):
        if (cluster == k).any():
            centroid = points[cluster == k].mean(0)
            velocities[k - 1] = -ground_velocity(centroid, motions[k], motions[BACKGROUND], since)
            if covariances is not None:
                both = (_at(centroid, motions[row], covariances[row]) for row in (k, BACKGROUND))
                spread[k - 1] = sum(both, np.zeros((2, 2))) / since**2
    to_world = float(pose[0]), float(pose[0] - motions[BACKGROUND, 0])  # from the new scan's axes, and from the earlier one's
    turned = se2.rotate(np.full(K, to_world[0]), velocities)
    axes = se2.rotate(np.full(2, to_world[1]), np.eye(2))  # (2, 2) rows: images of x and y
    return Sightings(se2.apply(pose, points), cluster, turned, axes.T @ spread @ axes, pose[1:])


def _at(point: Floats, motion: Floats, covariance: Floats) -> Floats:
    """(2, 2) covariance of the image of a point (2,), given that (3, 3) of the motion (3,)."""
    x, y = se2.rotate(motion[0], point)
    slope = np.array([[-y, 1.0, 0.0], [x, 0.0, 1.0]])  # by (theta, tx, ty)
    return np.asarray(slope @ covariance @ slope.T)
