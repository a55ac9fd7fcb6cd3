"""Odometry that cannot be true, and stamps closer than scans are: answers stay finite and sensible."""

import numpy as np
import pytest
from rooms_cast import path_of, scan_at

from torchcrf_scan import JointScanCRF, ScanStream


@pytest.fixture(scope="module")
def model() -> JointScanCRF:
    return JointScanCRF.from_pretrained()


@pytest.mark.parametrize("jump", [1e4, 1e7, 1e300, 1e308])
def test_odometry_that_jumps_is_not_believed(model: JointScanCRF, jump: float) -> None:
    path, stream = path_of(5), ScanStream(model)
    for k, pose in enumerate(path):
        result = stream.feed(scan_at(pose, seed=k), 0.1 * k, np.array([0.0, jump * (-1) ** k, 0.0]))
        assert result.status == "ok"
        np.testing.assert_allclose(result.pose, pose, atol=0.05)


def test_odometry_of_another_shape_is_an_error(model: JointScanCRF) -> None:
    with pytest.raises(ValueError, match=r"odometry: expected shape \(3,\), got \(4,\)"):
        ScanStream(model).feed(scan_at(np.zeros(3)), 0.0, np.zeros(4))


def test_covariances_of_scans_at_nearly_the_same_time_are_finite(model: JointScanCRF) -> None:
    stream = ScanStream(model)
    for k in range(3):
        result = stream.feed(scan_at(np.zeros(3), seed=k), 1e-300 * k)
        assert (np.linalg.eigvalsh(result.twist_covariance) > 0).all()
