"""What is published after a scan."""

import numpy as np
import pytest

pytest.importorskip("cyclonedds", reason="the library cyclonedds is not installed (extra `ros2`)")
pytest.importorskip("rosbags", reason="the library rosbags is not installed (extra `ros2`)")

from torchcrf_scan.live import messages
from torchcrf_scan.live.types import LASER, new
from torchcrf_scan.result import MovingObject, ScanResult
from torchcrf_scan.scan import Scan

STAMP = {"sec": 1, "nanosec": 2}


def moving(number: int, heading: float = 0.0, points: int = 5) -> MovingObject:
    return MovingObject(number, np.array([1.0, 2.0]), np.array([0.0, -1.5]), np.eye(4), heading, (4.0, 2.0), points, 1.0)


def test_odometry_is_in_its_frames() -> None:
    covariance = np.diag([1.0, 2.0, 3.0])
    scan = Scan.from_ranges([1.0], [0.0])
    labels = np.zeros(1, int)
    pose, twist = np.array([np.pi / 2, 3.0, 4.0]), np.array([0.1, 0.2, 0.3])
    told = ScanResult(scan, 0.0, pose, covariance, twist, 2 * covariance, labels > 0, labels, (), "ok", "")
    found = messages.odometry(told, STAMP, "odom", "laser")
    assert (found.header.frame_id, found.child_frame_id, found.header.stamp.sec) == ("odom", "laser", 1)
    assert (found.pose.pose.position.x, found.pose.pose.position.y) == (3, 4)
    np.testing.assert_allclose([found.pose.pose.orientation.z, found.pose.pose.orientation.w], np.sqrt(0.5))
    full = np.reshape(found.pose.covariance, (6, 6))
    np.testing.assert_allclose(np.diag(full)[[5, 0, 1]], [1, 2, 3])  # of theta, x and y
    np.testing.assert_allclose(np.diag(np.reshape(found.twist.covariance, (6, 6)))[[5, 0, 1]], [2, 4, 6])
    assert np.linalg.eigvalsh(full).min() > 0
    assert (found.twist.twist.linear.x, found.twist.twist.linear.y, found.twist.twist.angular.z) == (0.2, 0.3, 0.1)
    assert np.diag(np.reshape(found.pose.covariance, (6, 6))).tolist() == [2, 3, 1e-6, 1e-6, 1e-6, 1]
    assert np.diag(np.reshape(found.twist.covariance, (6, 6)))[[0, 1, 5]].tolist() == [4, 6, 2]


def test_markers_of_an_object() -> None:
    box, arrow = messages.markers((moving(7, np.pi),), STAMP, "odom").markers
    assert (box.ns, box.id, box.header.frame_id) == ("objects", 7, "odom")
    assert (box.scale.x, box.scale.y) == (4, 2)
    assert box.pose.orientation.z == pytest.approx(1)
    assert [(end.x, end.y) for end in arrow.points] == [(1, 2), (1, 0.5)]
    assert box.lifetime.nanosec > 0
    assert messages.markers((), STAMP, "odom").markers == []


def test_obstacles_have_boxes_along_the_axes_and_numbers_that_stay() -> None:
    ahead, aside = messages.obstacles((moving(7), moving(8, np.pi / 2, points=0)), STAMP, "odom").obstacles
    assert (ahead.size.x, ahead.size.y) == (4, 2)
    assert (aside.size.x, aside.size.y) == pytest.approx((2, 4))
    assert (ahead.score, aside.score) == (1, 0.5)
    assert ahead.uuid.uuid != aside.uuid.uuid
    assert ahead.uuid.uuid == messages.obstacles((moving(7),), STAMP, "odom").obstacles[0].uuid.uuid
    assert len(bytes(messages.obstacles((moving(7),), STAMP, "odom").serialize())) > 100


def test_scans_without_some_beams() -> None:
    scan = new(LASER, angle_min=-1.0, angle_increment=0.5, range_max=9.0, ranges=[1.0, 2.0, np.inf], intensities=[5.0, 6.0, 7.0])
    found = messages.without(scan, np.array([True, False, False]))
    assert np.isnan(found.ranges[0])
    assert found.ranges[1:] == [2.0, np.inf]
    assert (found.angle_min, found.angle_increment, found.range_max, found.intensities) == (-1.0, 0.5, 9.0, [5.0, 6.0, 7.0])
    assert scan.ranges[0] == 1.0
