"""What is believed of a measured pose: what is not observed follows the prediction, and what stands does not tremble."""

from __future__ import annotations

from collections import deque

import numpy as np

from torchcrf_scan.geometry import se2
from torchcrf_scan.scan import Floats
from torchcrf_scan.stream.covariance import turned

ACCELERATION = (20.0, 10.0, 10.0)  # rad/s^2 and m/s^2, standard deviations of what constant velocity does not foresee

SETTLING = 1.0  # seconds whose poses are averaged of a sensor that stands
MOST_POSES = 100  # that are remembered
FEWEST = 4  # poses in that time, from which it may be seen to stand
STANDS = 3.0  # standard deviations that a pose may be off their median,
MOST = (0.01, 0.02, 0.02)  # rad and metres, but never more


def fused(predicted: Floats, measured: Floats, covariance: Floats, elapsed: float) -> Floats:
    """(3,) the pose between a predicted and a measured one (3,), weighted by their covariances (a Kalman update).

    Args:
        covariance: (3, 3) of the measured pose, in the world.
        elapsed: seconds since the velocity of the prediction was measured.
    """
    ahead = se2.compose(se2.inverse(predicted), measured)
    prior = np.diag(np.square(np.array(ACCELERATION) * elapsed**2 / 2))
    gain = np.linalg.solve(prior + turned(covariance, -float(predicted[0])), prior).T
    return se2.compose(predicted, gain @ ahead)


class Standing:
    """The last poses as they were measured: a sensor that stands is where most of them were."""

    def __init__(self) -> None:
        self._poses: deque[tuple[float, Floats]] = deque()

    def settled(self, pose: Floats, covariance: Floats, time: float) -> Floats:
        """(3,) the median of the poses of the last second, if the measured one (3,) is within its uncertainty of it; else that.

        Args:
            covariance: (3, 3) of the pose, in the world. time: seconds.
        """
        before = [of for since, of in self._poses if 0 <= time - since <= SETTLING]
        if len(before) < FEWEST:
            return pose
        apart = se2.compose(se2.inverse(pose), np.array([*before, pose]))  # in the sensor's frame: the world's is arbitrary
        middle = np.median(apart, axis=0)
        bound = np.minimum(STANDS * np.sqrt(np.diag(turned(covariance, -float(pose[0])))), MOST)
        return pose if (np.abs(middle) > bound).any() else se2.compose(pose, middle)

    def add(self, pose: Floats, time: float) -> None:
        """Remembers a measured pose (3,)."""
        self._poses.append((time, pose))
        while time - self._poses[0][0] > SETTLING or len(self._poses) > MOST_POSES:
            self._poses.popleft()

    def clear(self) -> None:
        """Forgets all."""
        self._poses.clear()
