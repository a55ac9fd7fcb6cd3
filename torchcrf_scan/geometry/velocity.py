"""Velocities over ground, from motions relative to a moving sensor."""

from __future__ import annotations

from torchcrf_scan.geometry import se2
from torchcrf_scan.geometry.se2 import Array


def ground_velocity(centroid: Array, motion: Array, background: Array, dt: float) -> Array:
    """The velocity of a mover relative to the world, in the source frame, m/s: (B^-1(T(c)) - c) / dt.

    Args:
        centroid: (..., 2) c, of the mover's source points.
        motion: (..., 3) T, the mover's `T_target_source`.
        background: (..., 3) B, the background's `T_target_source`; its inverse removes the sensor's own motion.
        dt: seconds between the scans.

    Returns:
        (..., 2), NaN where a motion is.
    """
    end = se2.apply(se2.compose(se2.inverse(background), motion), centroid[..., None, :])[..., 0, :]
    return (end - centroid) / dt
