"""A measured pose and the predicted one, each as far as it is certain: what is not observed follows the prediction."""

from __future__ import annotations

import numpy as np

from torchcrf_scan.geometry import se2
from torchcrf_scan.scan import Floats
from torchcrf_scan.stream.covariance import turned

ACCELERATION = (20.0, 10.0, 10.0)  # rad/s^2 and m/s^2, standard deviations of what constant velocity does not foresee
DOUBT = 4.0  # factor on the covariance of a measured pose: errors of real scanners are larger than promised


def fused(predicted: Floats, measured: Floats, covariance: Floats, elapsed: float) -> Floats:
    """(3,) the pose between a predicted and a measured one (3,), weighted by their covariances (a Kalman update).

    Args:
        covariance: (3, 3) of the measured pose, in the world.
        elapsed: seconds since the velocity of the prediction was measured.
    """
    ahead = se2.compose(se2.inverse(predicted), measured)
    prior = np.diag(np.square(np.array(ACCELERATION) * elapsed**2 / 2))
    gain = np.linalg.solve(prior + DOUBT * turned(covariance, -float(predicted[0])), prior).T
    return se2.compose(predicted, gain @ ahead)
