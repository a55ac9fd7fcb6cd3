"""Velocities over ground: the sensor's own motion is undone, and only that."""

import numpy as np
import torch
from support import assert_close, normal

from torchcrf_scan.geometry import se2
from torchcrf_scan.geometry.velocity import ground_velocity


def test_what_moves_with_the_background_stands_still() -> None:
    motion = normal(4, 3)
    assert_close(ground_velocity(normal(4, 2, seed=1), motion, motion, 0.1), torch.zeros(4, 2))


def test_a_known_way_over_ground_by_hand() -> None:
    background = np.array([-np.pi / 2, 0.0, 1.0])  # the sensor went 1 m ahead and turned by 90 degrees
    motion = se2.compose(background, np.array([0.0, 0.3, -0.4]))  # of what first went 0.3 m ahead and 0.4 m to the right
    np.testing.assert_allclose(ground_velocity(np.array([5.0, 2.0]), motion, background, 0.1), [3.0, -4.0], atol=1e-12)


def test_many_movers_share_one_background() -> None:
    centroids, motions, background = normal(5, 2), normal(5, 3, seed=1), normal(3, seed=2)
    expected = torch.stack([ground_velocity(c, motion, background, 0.2) for c, motion in zip(centroids, motions, strict=True)])
    assert_close(ground_velocity(centroids, motions, background, 0.2), expected)


def test_unknown_motions_have_no_velocity() -> None:
    unknown = np.full(3, np.nan)
    assert np.isnan(ground_velocity(np.zeros(2), unknown, np.zeros(3), 0.1)).all()
    assert np.isnan(ground_velocity(np.zeros(2), np.zeros(3), unknown, 0.1)).all()
