"""Bags written again without what moves: the beams of moving objects are blanked, everything else is copied.

The scans' topic keeps its name, so that a SLAM program takes the new bag for the old one. The odometry found is added.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from torchcrf_scan.data.ros_messages import CLOUD, LASER, ODOMETRY, point_layout, stamp_of
from torchcrf_scan.data.spatial_covariance import spatial_covariance
from torchcrf_scan.errors import TorchCRFScanError
from torchcrf_scan.result import ScanResult
from torchcrf_scan.scan import Bools
from torchcrf_scan.whole_file import whole_path

FOUND = "/torchcrf_scan/odometry"  # topic of the odometry that was found
FRAME = "odom"  # its frame
VERSION: Literal[8] = 8  # of the metadata of a ROS 2 bag, which all distributions in use read
STAMP_ERROR = 1e-6  # seconds
XYZ = {"x", "y", "z"}

Write = Callable[[ScanResult], None]


@contextmanager
def writing_clean_bag(source: Path, target: Path, topic: str | None = None) -> Iterator[Write]:
    """A bag under construction: yields `write(result)`, to be called with the results of the source's scans in their order.

    Messages of the topic for which there is no result are left out; those of other topics are copied up to the last result, and
    all of them if every scan had one. The bag is there when the block ends, and only if it ends without error.

    Args:
        source: ROS 1 bag (.bag) or folder of a ROS 2 bag.
        topic: of the scans; None: the only one.

    Raises:
        TorchCRFScanError: a bag that rosbags cannot read, or a result that does not belong to it.
    """
    from rosbags.highlevel import AnyReader

    with whole_path(target) as temporary, AnyReader([source]) as reader, _writer(reader, source, temporary) as writer:
        copy = _Copy(reader, writer, _scans(reader, topic))
        yield copy.write
        copy.finish()


def _scans(reader: Any, topic: str | None) -> str:
    """The name of the topic with the scans."""
    names = {kind: [one.topic for one in reader.connections if one.msgtype == kind] for kind in (LASER, CLOUD)}
    if topic is None:
        return str([*names[LASER], *names[CLOUD]][0])
    return next(str(name) for name in names[LASER] + names[CLOUD] if name.strip("/") == topic.strip("/"))


def _writer(reader: Any, source: Path, target: Path) -> Any:
    """A writer of the same kind of bag."""
    from rosbags import rosbag1, rosbag2

    if not reader.is2:
        return rosbag1.Writer(target)
    files = [source] if source.is_file() else list(source.iterdir())
    has_mcap = any(file.suffix == ".mcap" for file in files)
    plugin = rosbag2.StoragePlugin.MCAP if has_mcap else rosbag2.StoragePlugin.SQLITE3
    return rosbag2.Writer(target, version=VERSION, storage_plugin=plugin)


class _Copy:
    """Goes through a bag beside the results of its scans."""

    def __init__(self, reader: Any, writer: Any, topic: str) -> None:
        from rosbags.typesys import Stores, get_typestore

        self._reader, self._writer, self._topic = reader, writer, topic
        self._types = get_typestore(Stores.ROS2_HUMBLE if reader.is2 else Stores.ROS1_NOETIC)
        self._connections = {connection.id: _add(writer, connection, reader) for connection in reader.connections}
        self._odometry = writer.add_connection(FOUND, ODOMETRY, typestore=self._types)
        self._messages = reader.messages()

    def write(self, result: ScanResult) -> None:
        """Copies up to the scan of a result, and writes that without what moves, and its odometry."""
        for connection, stamp, data in self._messages:
            if not self._is_scan(connection):
                self._writer.write(self._connections[connection.id], stamp, data)
                continue
            try:
                message = self._reader.deserialize(data, connection.msgtype)
            except Exception:  # a library's, of damaged bytes; there is no result of them
                continue
            if is_scan_of(message, stamp, result):
                clean = self._bytes(self._reader.typestore, blank(message, result.moving))
                self._writer.write(self._connections[connection.id], stamp, clean)
                odometry = odometry_message(self._types.types, message.header, result)
                self._writer.write(self._odometry, stamp, self._bytes(self._types, odometry))
                return
        raise TorchCRFScanError(
            f"{self._reader.paths[0]}: expected the scan of {result.stamp:.6f} s on {self._topic}, got no such message"
        )

    def finish(self) -> None:
        """Copies what follows the last result, up to the next scan."""
        for connection, stamp, data in self._messages:
            if self._is_scan(connection):
                return
            self._writer.write(self._connections[connection.id], stamp, data)

    def _is_scan(self, connection: Any) -> bool:
        return connection.topic == self._topic and connection.msgtype in (LASER, CLOUD)

    def _bytes(self, types: Any, message: Any) -> Any:
        serialize = types.serialize_cdr if self._reader.is2 else types.serialize_ros1
        return serialize(message, message.__msgtype__)


def _add(writer: Any, connection: Any, reader: Any) -> Any:
    """The same connection in the writer."""
    ext, known = connection.ext, {"msgdef": connection.msgdef.data or None}
    if not reader.is2:
        known |= {"md5sum": connection.digest, "callerid": ext.callerid, "latching": ext.latching}
        return writer.add_connection(connection.topic, connection.msgtype, **known)
    known |= {"rihs01": connection.digest or None, "typestore": reader.typestore}
    known |= {"serialization_format": ext.serialization_format, "offered_qos_profiles": ext.offered_qos_profiles}
    return writer.add_connection(connection.topic, connection.msgtype, **known)


def is_scan_of(message: Any, recorded: int, result: ScanResult) -> bool:
    """Whether a message is the scan of a result. recorded: nanoseconds, for messages whose own stamp is 0."""
    beams = len(message.ranges) if message.__msgtype__ == LASER else message.width * message.height
    stamp = stamp_of(message.header) or 1e-9 * recorded
    return bool(beams == len(result.moving) and abs(stamp - result.stamp) < STAMP_ERROR)


def blank(message: Any, moving: Bools) -> Any:
    """A scan's message with NaN where a beam hit something that moves."""
    if message.__msgtype__ == LASER:
        return replace(message, ranges=np.where(moving, np.float32(np.nan), message.ranges).astype(np.float32))
    layout = point_layout(message)
    data = np.array(message.data, dtype=np.uint8)
    for row, hit in zip(data.reshape(message.height, message.row_step), moving.reshape(message.height, message.width), strict=True):
        points = row[: message.width * message.point_step].view(layout)
        for name in XYZ & set(layout.names or ()):
            points[name][hit] = np.nan
    return replace(message, data=data)


def odometry_message(types: Any, header: Any, result: ScanResult) -> Any:
    """nav_msgs/Odometry of a result, with the covariances of pose and twist; the sensor's frame is that of its header."""

    def make(name: str, *values: Any) -> Any:
        return types[name](*values)

    def vector(name: str, x: float, y: float, z: float = 0.0) -> Any:
        return make(f"geometry_msgs/msg/{name}", x, y, z)

    theta, x, y = result.pose.tolist()
    turn, ahead, left = result.twist.tolist()
    rotation = make("geometry_msgs/msg/Quaternion", 0.0, 0.0, float(np.sin(theta / 2)), float(np.cos(theta / 2)))
    pose = make("geometry_msgs/msg/Pose", vector("Point", x, y), rotation)
    twist = make("geometry_msgs/msg/Twist", vector("Vector3", ahead, left), vector("Vector3", 0.0, 0.0, turn))
    stamp = make("builtin_interfaces/msg/Time", header.stamp.sec, header.stamp.nanosec)
    sequence = [header.seq] if hasattr(header, "seq") else []  # ROS 1 numbers its messages
    return make(
        ODOMETRY,
        make("std_msgs/msg/Header", *sequence, stamp, FRAME),
        header.frame_id,
        make("geometry_msgs/msg/PoseWithCovariance", pose, spatial_covariance(result.covariance)),
        make("geometry_msgs/msg/TwistWithCovariance", twist, spatial_covariance(result.twist_covariance)),
    )
