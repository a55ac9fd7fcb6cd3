"""Scans of bags of ROS 1 and ROS 2 (library rosbags, which knows the types of messages)."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from torchcrf_scan.data.bag_records import Bag, Message, Topic, unpack_message
from torchcrf_scan.data.mcap_bag import McapBag
from torchcrf_scan.data.options import AS_RECORDED, AUTO, ReadOptions
from torchcrf_scan.data.reading import Reading
from torchcrf_scan.data.ros1_bag import Ros1Bag
from torchcrf_scan.data.ros2_bag import FolderBag, SqliteBag
from torchcrf_scan.data.ros_messages import CLOUD, LASER, ODOMETRY, OLD_TRANSFORMS, SCANS, TRANSFORMS, stamp_of
from torchcrf_scan.data.ros_odometry import OdometryBeside
from torchcrf_scan.errors import TorchCRFScanError

if TYPE_CHECKING:
    from rosbags.typesys.store import Typestore

Decode = Callable[[Message], Any]


def read_bag(bag: Bag, options: ReadOptions = AS_RECORDED) -> Iterator[Reading]:
    """The scans of one topic of a bag as recorded, with the stamps of their headers (of the recording where these are 0).

    Raises:
        TorchCRFScanError: no topic with scans, several and none chosen, or rosbags missing; or, after every scan before it, a
            message that cannot be read (unless `on_bad` takes it) or a damaged file, with its place.
        OSError: the file cannot be opened.
    """
    topics = bag.topics()
    scans = _choose_scans(bag.path, topics, options.topic)
    odometry = _choose_odometry(bag.path, topics, options.odometry)
    read = _Reader(bag, topics, scans, math.inf if options.no_return is None else options.no_return)
    if odometry is None:
        for message in bag.messages([scans.name]):
            if (found := options.attempt(partial(read.scan, message))) is not None:
                yield found[0]
        return
    yield from _with_odometry(bag, read, topics, scans, odometry, options)


def read_ros1_bag(path: str | Path, options: ReadOptions = AS_RECORDED) -> Iterator[Reading]:
    """`read_bag` of a bag of ROS 1."""
    return read_bag(Ros1Bag(Path(path)), options)


def read_mcap(path: str | Path, options: ReadOptions = AS_RECORDED) -> Iterator[Reading]:
    """`read_bag` of an MCAP file."""
    return read_bag(McapBag(Path(path)), options)


def read_sqlite_bag(path: str | Path, options: ReadOptions = AS_RECORDED) -> Iterator[Reading]:
    """`read_bag` of a database of ROS 2."""
    return read_bag(SqliteBag(Path(path)), options)


def read_folder_bag(path: str | Path, options: ReadOptions = AS_RECORDED) -> Iterator[Reading]:
    """`read_bag` of a folder of ROS 2."""
    return read_bag(FolderBag(Path(path)), options)


def _choose_scans(path: Path, topics: list[Topic], name: str | None) -> Topic:
    """The topic asked for; else the only LaserScan, else the only PointCloud2."""
    has_lasers = any(topic.type == LASER for topic in topics)
    return _choose(path, topics, (LASER,) if has_lasers and name is None else (LASER, CLOUD), name, "topic")


def _choose_odometry(path: Path, topics: list[Topic], name: str | None) -> Topic | None:
    """The topic asked for, or the only one if it is `auto`; None if none is asked for."""
    if name is None:
        return None
    return _choose(path, topics, (ODOMETRY,), None if name == AUTO else name, "odometry")


def _choose(path: Path, topics: list[Topic], types: tuple[str, ...], name: str | None, option: str) -> Topic:
    fits = [topic for topic in topics if topic.type in types]
    if not fits:
        wanted = " or ".join(kind.replace("/msg/", "/") for kind in types)
        raise TorchCRFScanError(f"{path}: {option}: expected a topic of type {wanted}, got {_listed(topics) or 'none'}")
    chosen = [topic for topic in fits if name is None or topic.name.strip("/") == name.strip("/")]
    if len(chosen) == 1:
        return chosen[0]
    raise TorchCRFScanError(f"{path}: {option}: expected {'one' if name else 'which'} of {_listed(fits)}, got {name or 'none'}")


def _listed(topics: list[Topic]) -> str:
    return ", ".join(f"{topic.name} ({topic.type.replace('/msg/', '/')})" for topic in topics)


class _Reader:
    """Decodes the messages of a bag."""

    def __init__(self, bag: Bag, topics: list[Topic], scans: Topic, no_return: float) -> None:
        self._store = _typestore(bag, topics, scans.is_cdr)
        self._scan_of, self._no_return = SCANS[scans.type], no_return

    def decode(self, message: Message) -> Any:
        """The message as an object; raises TorchCRFScanError with its place."""
        try:
            data = unpack_message(message.data) if message.is_packed else message.data
            deserialize = self._store.deserialize_cdr if message.topic.is_cdr else self._store.deserialize_ros1
            return deserialize(data, message.topic.type)
        except Exception as error:  # a library's, of damaged bytes
            raise TorchCRFScanError(
                f"{message.where}: expected a {message.topic.type}, got {type(error).__name__}: {error}"
            ) from error

    def scan(self, message: Message) -> tuple[Reading, str]:
        """The scan of a message, and the frame it is in."""
        told = self.decode(message)
        try:
            scan = self._scan_of(told, self._no_return)
        except (ValueError, TypeError, KeyError) as error:
            raise TorchCRFScanError(f"{message.where}, {message.topic.name}: {error}") from error
        return Reading(scan, stamp_of(told.header) or message.stamp), told.header.frame_id


def _with_odometry(
    bag: Bag, read: _Reader, topics: list[Topic], scans: Topic, odometry: Topic, options: ReadOptions
) -> Iterator[Reading]:
    beside = OdometryBeside()
    transforms = [topic.name for topic in topics if topic.type in (TRANSFORMS, OLD_TRANSFORMS)]
    try:
        for message in bag.messages([scans.name, odometry.name, *transforms]):
            if message.topic.name == scans.name:
                if (found := options.attempt(partial(read.scan, message))) is not None:
                    yield from beside.scan(*found)
            elif (told := options.attempt(partial(read.decode, message))) is None:
                continue
            elif message.topic.name == odometry.name:
                yield from beside.pose(told)
            else:
                beside.transform(told)
    except ValueError:
        yield from beside.rest()
        raise
    yield from beside.rest()


def _typestore(bag: Bag, topics: list[Topic], is_cdr: bool) -> Typestore:
    """The types that the bag defines, and those of ROS where it does not; raises TorchCRFScanError without rosbags."""
    try:
        from rosbags.typesys import Stores, get_types_from_idl, get_types_from_msg, get_typestore
    except ImportError as error:
        raise TorchCRFScanError(f"{bag.path}: expected the library rosbags, which reads bags (extra `ros`), got {error}") from error
    store = get_typestore(Stores.LATEST if is_cdr else Stores.ROS1_NOETIC)
    wanted = (LASER, CLOUD, ODOMETRY, TRANSFORMS, OLD_TRANSFORMS)
    found: dict[str, Any] = {}
    try:
        for topic in topics:
            if topic.type in wanted and topic.type not in store.fielddefs and topic.definition:
                parse = get_types_from_idl(topic.definition) if topic.is_idl else get_types_from_msg(topic.definition, topic.type)
                found |= {name: definition for name, definition in parse.items() if name not in store.fielddefs}
        store.register(found)
    except Exception as error:  # a library's, of damaged definitions
        raise TorchCRFScanError(f"{bag.path}: expected definitions of types, got {type(error).__name__}: {error}") from error
    return store
