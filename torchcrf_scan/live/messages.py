"""Answers as messages of ROS 2: odometry, objects, and the scan without its movers, of them alone, and with its labels."""

from __future__ import annotations

import math
import secrets
from typing import Any

import numpy as np

from torchcrf_scan.data.spatial_covariance import spatial_covariance
from torchcrf_scan.live.types import LASER, MARKER, MARKERS, OBSTACLE, OBSTACLES, ODOMETRY, new
from torchcrf_scan.result import MovingObject, ScanResult
from torchcrf_scan.scan import Bools

CUBE, ARROW = 1, 0  # of visualization_msgs/Marker
HEIGHT = 1.0  # metres that objects are drawn high
SHOWN = 500_000_000  # nanoseconds for which a marker is shown
LEAST_EXTENT = 0.05  # metres; markers of no extent are not drawn
COLOURS = ((0.90, 0.29, 0.24), (0.18, 0.53, 0.87), (0.95, 0.61, 0.13), (0.33, 0.69, 0.31), (0.58, 0.35, 0.78), (0.10, 0.69, 0.69))
SESSION = secrets.token_bytes(8)  # so that numbers of objects are not those of another run


def odometry(result: ScanResult, stamp: Any, world: str, sensor: str) -> Any:
    """nav_msgs/Odometry: the pose of the sensor in the world and its velocity in its own frame, with covariances."""
    theta, x, y = result.pose.tolist()
    turn, ahead, left = result.twist.tolist()
    return new(
        ODOMETRY,
        header={"stamp": stamp, "frame_id": world},
        child_frame_id=sensor,
        pose={"pose": _pose(x, y, theta), "covariance": spatial_covariance(result.covariance).tolist()},
        twist={
            "twist": {"linear": {"x": ahead, "y": left}, "angular": {"z": turn}},
            "covariance": spatial_covariance(result.twist_covariance).tolist(),
        },
    )


def markers(objects: tuple[MovingObject, ...], stamp: Any, world: str) -> Any:
    """visualization_msgs/MarkerArray: a box for every object, and an arrow of its way in a second."""
    found = []
    for one in objects:
        (x, y), (speed_x, speed_y) = one.position.tolist(), one.velocity.tolist()
        red, green, blue = COLOURS[one.number % len(COLOURS)]
        common = {
            "header": {"stamp": stamp, "frame_id": world},
            "id": one.number,
            "color": {"r": red, "g": green, "b": blue, "a": 0.8},
            "lifetime": {"sec": 0, "nanosec": SHOWN},
        }
        length, width = (max(extent, LEAST_EXTENT) for extent in one.extent)
        size = {"x": length, "y": width, "z": HEIGHT}
        found.append(new(MARKER, ns="objects", type=CUBE, pose=_pose(x, y, one.heading), scale=size, **common))
        ends = [{"x": x, "y": y, "z": HEIGHT}, {"x": x + speed_x, "y": y + speed_y, "z": HEIGHT}]
        thin = {"x": 0.05, "y": 0.1, "z": 0.1}
        found.append(new(MARKER, ns="velocities", type=ARROW, pose=_pose(0, 0, 0), scale=thin, points=ends, **common))
    return new(MARKERS, markers=found)


def obstacles(objects: tuple[MovingObject, ...], stamp: Any, world: str) -> Any:
    """nav2_dynamic_msgs/ObstacleArray: objects in boxes along the axes of the world, as the type has no heading."""
    found = []
    for one in objects:
        (x, y), (speed_x, speed_y), (length, width) = one.position.tolist(), one.velocity.tolist(), one.extent
        cos, sin = abs(math.cos(one.heading)), abs(math.sin(one.heading))
        found.append(
            new(
                OBSTACLE,
                uuid={"uuid": list(SESSION + one.number.to_bytes(8, "big"))},
                score=1.0 if one.points else 0.5,
                position={"x": x, "y": y},
                velocity={"x": speed_x, "y": speed_y},
                size={"x": length * cos + width * sin, "y": length * sin + width * cos, "z": HEIGHT},
            )
        )
    return new(OBSTACLES, header={"stamp": stamp, "frame_id": world}, obstacles=found)


def without(scan: Any, blanked: Bools) -> Any:
    """The LaserScan with NaN for some of its beams. blanked: (n_beams,)."""
    ranges = np.where(blanked, np.nan, np.asarray(scan.ranges, dtype=np.float64))
    return _copy(scan, ranges.tolist(), scan.intensities)


def labelled(scan: Any, result: ScanResult) -> Any:
    """The LaserScan with the track of every beam as its intensity: 0 background, k object k, -1 outlier or no return."""
    return _copy(scan, scan.ranges, result.track.astype(np.float64).tolist())


def _copy(scan: Any, ranges: Any, intensities: Any) -> Any:
    names = ("header", "angle_min", "angle_max", "angle_increment", "time_increment", "scan_time", "range_min", "range_max")
    return new(LASER, ranges=ranges, intensities=intensities, **{name: getattr(scan, name) for name in names})


def _pose(x: float, y: float, theta: float) -> dict[str, Any]:
    turn = {"z": math.sin(theta / 2), "w": math.cos(theta / 2)}
    return {"position": {"x": float(x), "y": float(y)}, "orientation": turn}
