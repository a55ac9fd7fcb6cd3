"""Messages of ROS as scans and poses: sensor_msgs/LaserScan, planar sensor_msgs/PointCloud2, nav_msgs/Odometry, transforms."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from torchcrf_scan.data.limits import check_beams
from torchcrf_scan.errors import TorchCRFScanError
from torchcrf_scan.scan import Floats, Scan

LASER, CLOUD = "sensor_msgs/msg/LaserScan", "sensor_msgs/msg/PointCloud2"
ODOMETRY, TRANSFORMS = "nav_msgs/msg/Odometry", "tf2_msgs/msg/TFMessage"
OLD_TRANSFORMS = "tf/msg/tfMessage"

TYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}  # of sensor_msgs/PointField
TIMES = {"t": 1e-9, "time": 1.0, "timestamp": 1.0, "time_offset": 1.0}  # names of a point's time, and its unit if it is a fraction
PLANAR, OUTLYING = 0.1, 0.02  # metres from the plane, and the share of points that may be farther
UPRIGHT = 0.98  # cosine of the greatest tilt of a planar mount


def stamp_of(header: Any) -> float:
    """Seconds of a header's stamp."""
    return float(header.stamp.sec) + 1e-9 * float(header.stamp.nanosec)


def laser_scan(message: Any, no_return: float) -> Scan:
    """The scan of a LaserScan. Limits that cannot be, which some drivers write, count as unknown.

    no_return: metres; readings from there on are beams without return.
    """
    ranges = np.asarray(message.ranges, dtype=np.float64)
    count = len(ranges)
    check_beams(count, "ranges")
    first, step = float(message.angle_min), float(message.angle_increment)
    if step == 0 and count > 1:
        step = (float(message.angle_max) - first) / (count - 1)
    least, most, between = float(message.range_min), float(message.range_max), float(message.time_increment)
    least = least if math.isfinite(least) and least >= 0 else 0.0
    return Scan.from_ranges(
        np.where(ranges >= no_return, np.nan, ranges),
        angle_min=first,
        angle_increment=step,
        range_min=least,
        range_max=most if least < most < math.inf else None,
        time_increment=between if math.isfinite(between) else None,
    )


def cloud_scan(message: Any, no_return: float) -> Scan:
    """The scan of a planar PointCloud2, a beam for every point; raises TorchCRFScanError for one that is not planar.

    no_return: metres; points from there on are beams without return.
    """
    points = _points(message)
    names = points.dtype.names or ()
    if not {"x", "y"} <= set(names):
        raise TorchCRFScanError(f"expected a cloud with x and y, got {', '.join(names)}")
    x, y = (points[name].astype(np.float64) for name in ("x", "y"))
    with np.errstate(invalid="ignore"):
        ranges = np.hypot(x, y)
    seen = np.isfinite(ranges)
    if "z" in names and seen.any():
        height = points["z"][seen]
        far = np.abs(height - np.median(height)) > PLANAR
        if far.mean() > OUTLYING:
            raise TorchCRFScanError(f"expected a planar cloud, got heights from {height.min():.2f} to {height.max():.2f} m")
    bearings = np.where(seen, np.arctan2(y, x), 0.0)
    return Scan.from_ranges(np.where(ranges < no_return, ranges, np.nan), bearings, times=_times(points))


def _points(message: Any) -> np.ndarray:
    """(P,) records of a cloud."""
    width, height, step = int(message.width), int(message.height), int(message.point_step)
    check_beams(width * height, "points")
    rows = np.asarray(message.data, dtype=np.uint8).reshape(height, -1)[:, : width * step]
    return np.frombuffer(rows.tobytes(), dtype=point_layout(message), count=width * height)


def point_layout(message: Any) -> np.dtype:
    """The fields of a point of a cloud."""
    order = ">" if message.is_bigendian else "<"
    fields = {field.name: field for field in message.fields if field.datatype in TYPES}  # padding has one name several times
    formats = [order + TYPES[field.datatype] for field in fields.values()]
    offsets = [int(field.offset) for field in fields.values()]
    return np.dtype({"names": [*fields], "formats": formats, "offsets": offsets, "itemsize": int(message.point_step)})


def _times(points: np.ndarray) -> Floats | None:
    """(P,) seconds of the points; whole numbers are nanoseconds."""
    for name, unit in TIMES.items():
        if name in (points.dtype.names or ()):
            times = points[name].astype(np.float64) * (unit if points.dtype[name].kind == "f" else 1e-9)
            return times if np.isfinite(times).all() and np.ptp(times) > 0 else None
    return None


SCANS: Mapping[str, Callable[[Any, float], Scan]] = {LASER: laser_scan, CLOUD: cloud_scan}  # types that hold a scan


def planar_pose(position: Any, orientation: Any) -> Floats | None:
    """(3,) pose (theta, x, y) of a position and a quaternion; None if it is tilted or upside down."""
    x, y, z, w = (float(getattr(orientation, name)) for name in "xyzw")
    norm = x * x + y * y + z * z + w * w
    if norm == 0:
        x, y, z, w, norm = 0.0, 0.0, 0.0, 1.0, 1.0
    if not 1 - 2 * (x * x + y * y) / norm > UPRIGHT:
        return None
    turn = math.atan2(2 * (w * z + x * y), norm - 2 * (y * y + z * z))
    pose = np.array([turn, float(position.x), float(position.y)])
    return pose if np.isfinite(pose).all() else None
