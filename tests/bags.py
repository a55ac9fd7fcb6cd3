"""Bags written by rosbags: a sensor that drives along a room, of any format."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("rosbags", reason="the library rosbags is not installed (extra `ros`)")

from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

BEAMS = 181
STORES = {1: get_typestore(Stores.ROS1_NOETIC), 2: get_typestore(Stores.ROS2_HUMBLE)}
STORES[1].register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms", "tf2_msgs/msg/TFMessage"))
FORMATS = ("ros1", "ros1 bz2", "ros1 lz4", "sqlite", "sqlite file", "mcap", "mcap file", "packed messages")

Message = tuple[str, str, float, dict[str, Any]]  # topic, type, stamp of recording, fields


def made(store: Any, kind: str, fields: dict[str, Any]) -> Any:
    """A message; fields that are not given are zero, dictionaries are messages."""
    return store.types[kind](**{name: value(store, form, fields.get(name)) for name, form in store.fielddefs[kind][1]})


def value(store: Any, form: Any, given: Any) -> Any:
    node, detail = form
    if int(node) == 2:
        return made(store, detail, given or {})
    if int(node) == 1:
        return given if given is not None else ("" if detail[0] == "string" else store_zero(detail[0]))
    (inner, kind), length = detail
    if int(inner) == 2:
        return [made(store, kind, one) for one in given or []]
    return np.asarray(given if given is not None else [0] * length, dtype=TYPES[kind[0]])


TYPES = {"float32": np.float32, "float64": np.float64, "uint8": np.uint8, "byte": np.uint8}


def store_zero(kind: str) -> Any:
    return False if kind == "bool" else 0.0 if kind.startswith("float") else 0


def header(stamp: float, frame: str = "laser") -> dict[str, Any]:
    seconds = int(stamp)
    nanoseconds = round((stamp - seconds) * 1e9)
    return {"stamp": {"sec": seconds, "nanosec": nanoseconds}, "frame_id": frame, "seq": 0}


def laser(stamp: float, ranges: np.ndarray, **fields: Any) -> dict[str, Any]:
    step = np.pi / (len(ranges) - 1)
    usual = {"angle_min": -np.pi / 2, "angle_max": np.pi / 2, "angle_increment": step, "range_min": 0.1, "range_max": 30.0}
    return {"header": header(stamp), **usual, "time_increment": 1e-4, "ranges": ranges.astype(np.float32)} | fields


def room(x: float, beams: int = BEAMS) -> np.ndarray:
    """(beams,) ranges in a room 8 m wide from x metres along its axis; the first beam returned nothing."""
    bearings = np.linspace(-np.pi / 2, np.pi / 2, beams)
    with np.errstate(divide="ignore"):
        ranges = np.minimum(np.abs(4 / np.sin(bearings)), (12 - x) / np.maximum(np.cos(bearings), 1e-9))
    ranges[0] = np.inf
    return ranges


LASER, CLOUD = "sensor_msgs/msg/LaserScan", "sensor_msgs/msg/PointCloud2"
ODOMETRY, TRANSFORMS = "nav_msgs/msg/Odometry", "tf2_msgs/msg/TFMessage"


def drive(count: int = 5, topic: str = "/scan", begin: float = 100.0) -> list[Message]:
    """Scans 0.1 s and 0.1 m apart, recorded 5 ms late."""
    stamps = begin + 0.1 * np.arange(count)
    return [(topic, LASER, stamp + 0.005, laser(stamp, room(0.1 * k))) for k, stamp in enumerate(stamps)]


def wheels(count: int = 5, begin: float = 100.0, speed: float = 1.0) -> list[Message]:
    """Odometry of the robot's centre at 20 Hz, straight ahead."""
    found = []
    for k in range(2 * count):
        stamp = begin + 0.05 * k
        pose = {"pose": {"position": {"x": speed * 0.05 * k, "y": 0.0, "z": 0.0}, "orientation": {"w": 1.0}}}
        fields = {"header": header(stamp, "odom"), "child_frame_id": "base", "pose": pose}
        found.append(("/odom", ODOMETRY, stamp + 0.001, fields))
    return found


def cloud(stamp: float, points: np.ndarray, names: Sequence[str] = ("x", "y", "z"), height: int = 1) -> dict[str, Any]:
    """points: (P, fields) float32, behind four bytes of padding."""
    step = 4 + 4 * len(names)
    fields = [{"name": name, "offset": 4 + 4 * k, "datatype": 7, "count": 1} for k, name in enumerate(names)]
    rows = np.zeros((len(points), step), np.uint8)
    rows[:, 4:] = points.astype("<f4").view(np.uint8).reshape(len(points), -1)
    width = len(points) // height
    return {"header": header(stamp), "height": height, "width": width, "fields": fields, "point_step": step,
            "row_step": step * width, "data": rows.ravel(), "is_dense": True}  # fmt: skip


def write(folder: Path, form: str, messages: Sequence[Message]) -> Path:
    """A bag of the messages in the order of their stamps; the path to open."""
    folder.mkdir(exist_ok=True)
    messages = sorted(messages, key=lambda message: message[2])
    if form.startswith("ros1"):
        return _write1(folder / "run.bag", form.removeprefix("ros1").strip(), messages)
    place = folder / form.replace(" ", "_")
    plugin = StoragePlugin.MCAP if "mcap" in form else StoragePlugin.SQLITE3
    writer = Writer2(place, version=9, storage_plugin=plugin)
    if form.startswith("packed messages"):
        writer.set_compression(CompressionMode.MESSAGE, CompressionFormat.ZSTD)
    with writer:
        _write_all(writer, STORES[2], messages, STORES[2].serialize_cdr)
    return next(path for path in place.iterdir() if path.suffix in (".mcap", ".db3")) if form.endswith("file") else place


def _write1(path: Path, packing: str, messages: Sequence[Message]) -> Path:
    writer = Writer1(path)
    if packing:
        writer.set_compression(getattr(Writer1.CompressionFormat, packing.upper()))
    with writer:
        _write_all(writer, STORES[1], messages, STORES[1].serialize_ros1)
    return path


def _write_all(writer: Any, store: Any, messages: Sequence[Message], serialize: Any) -> None:
    connections: dict[str, Any] = {}
    for topic, kind, stamp, fields in messages:
        if topic not in connections:
            connections[topic] = writer.add_connection(topic, kind, typestore=store)
        writer.write(connections[topic], round(stamp * 1e9), serialize(made(store, kind, fields), kind))
