"""Where a movie looks: a window that follows what is seen, smoothly."""

from __future__ import annotations

import numpy as np

from torchcrf_scan.scan import Floats

FOLLOW = 0.12  # share of the way to the wanted centre that the window goes in a frame
ZOOM = 0.03  # the same for its size
BULK = (8, 92)  # percentiles of the points' coordinates that should be in the picture
LEAST = 1.5  # metres, half the height
MARGIN = 1.25


class Camera:
    """A window of one aspect in the plane.

    Args:
        aspect: width over height.
    """

    def __init__(self, aspect: float) -> None:
        self._aspect = aspect
        self._centre, self._half = np.zeros(2), 0.0

    def follow(self, points: Floats, sensor: Floats) -> None:
        """Moves towards a window that holds the bulk of the points (N, 2) and the sensor (2,)."""
        bulk = np.percentile(points, BULK, axis=0) if len(points) else np.zeros((0, 2))
        corners = np.concatenate([bulk, sensor[None]])
        low, high = corners.min(axis=0), corners.max(axis=0)
        half = max(MARGIN / 2 * float(((high - low) / (self._aspect, 1.0)).max()), LEAST)
        away = np.abs(sensor - self._centre) / (self._aspect, 1.0)
        if self._half == 0 or float(away.max()) > self._half:
            self._centre, self._half = (low + high) / 2, half
        self._centre = self._centre + FOLLOW * ((low + high) / 2 - self._centre)
        self._half += ZOOM * (half - self._half)

    @property
    def window(self) -> tuple[Floats, Floats]:
        """Lower and upper corner, (2,) each."""
        size = self._half * np.array([self._aspect, 1.0])
        return self._centre - size, self._centre + size


def nice_step(length: float) -> float:
    """The largest of 1, 2, 5 times a power of ten that is not above a length."""
    power = 10.0 ** np.floor(np.log10(length))
    return float(power * max(step for step in (1, 2, 5) if step * power <= length * (1 + 1e-9)))
