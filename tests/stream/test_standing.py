"""A sensor that stands does not tremble, and one that moves is not held back."""

import numpy as np

from torchcrf_scan.geometry import se2
from torchcrf_scan.scan import Floats
from torchcrf_scan.stream.fusion import Standing

COVARIANCE = np.diag([0.003, 0.003, 0.003]) ** 2


def settled(poses: Floats, step: float = 0.1) -> Floats:
    standing, out = Standing(), []
    for k, pose in enumerate(poses):
        out.append(standing.settled(pose, COVARIANCE, step * k))
        standing.add(pose, step * k)
    return np.array(out)


def test_a_standing_sensor_trembles_less() -> None:
    noisy = np.random.default_rng(3).normal(0.0, 0.003, (200, 3))
    assert settled(noisy)[20:].std() < 0.6 * noisy[20:].std()


def test_a_spike_within_its_uncertainty_is_taken_out() -> None:
    poses = np.zeros((20, 3))
    poses[12, 0] = 0.008
    assert np.abs(settled(poses)).max() < 1e-15


def test_a_start_is_followed_from_the_first_scan_that_shows_it() -> None:
    poses = np.zeros((30, 3))
    poses[15:, 1] = 0.03 * np.arange(1, 16)
    assert np.allclose(settled(poses)[15:], poses[15:])


def test_a_creeping_sensor_is_never_farther_off_than_it_is_uncertain() -> None:
    poses = np.zeros((100, 3))
    poses[:, 2] = 0.001 * np.arange(100)  # 1 cm/s
    assert np.abs(settled(poses) - poses).max() <= 3 * 0.003


def test_angles_across_the_turn_are_near_each_other() -> None:
    poses = np.zeros((20, 3))
    poses[:, 0] = se2.wrap(np.pi + 0.001 * (-1.0) ** np.arange(20))
    assert np.abs(se2.wrap(settled(poses)[:, 0] - np.pi)).max() <= 0.001 + 1e-12


def test_few_poses_and_old_ones_tell_nothing() -> None:
    poses = np.random.default_rng(0).normal(0.0, 0.003, (6, 3))
    assert np.array_equal(settled(poses[:4]), poses[:4])
    assert np.array_equal(settled(poses, step=0.5), poses)
