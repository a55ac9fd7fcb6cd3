"""Scans in, answers out, one at a time as they come."""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from torchcrf_scan.data.ros_messages import laser_scan, planar_pose, stamp_of
from torchcrf_scan.live import messages
from torchcrf_scan.live.network import Bell, Connection
from torchcrf_scan.live.types import LASER, MARKERS, OBSTACLES, ODOMETRY
from torchcrf_scan.result import ScanResult, Stream
from torchcrf_scan.scan import Floats

log = logging.getLogger(__name__)

OUTPUTS = {  # name of a topic behind the prefix -> its type
    "odometry": ODOMETRY,
    "objects": MARKERS,
    "obstacles": OBSTACLES,
    "scan_static": LASER,
    "scan_moving": LASER,
    "scan_labels": LASER,
}
PAUSE = 0.2  # seconds between looks whether to stop
FAR_OFF = 60.0  # seconds; a latency beyond that is a clock of another machine


@dataclass(frozen=True, slots=True)
class Answered:
    """A scan that came in.

    Attributes:
        result: None if it was a bad scan. seconds: of the answer, from the scan's sending to the last message about it.
    """

    result: ScanResult | None
    seconds: float


class Listener:
    """Subscribes to a topic of LaserScan and publishes what is known after each.

    A scan that cannot be read or answered is told once in the log and left out. Writers keep one message and never wait.

    Args:
        connection: to a domain. stream: what answers.
        topic: of the scans. prefix: of the topics that are published, see `OUTPUTS`.
        no_return: metres; readings from there on mean that nothing came back.
        odometry: topic of nav_msgs/Odometry whose last pose is the first guess; None: there is none.
        world: name of the frame of the first scan. depth: scans that may wait; when more come, the oldest are lost.
    """

    def __init__(
        self,
        connection: Connection,
        stream: Stream,
        *,
        topic: str = "/scan",
        prefix: str = "/torchcrf_scan",
        no_return: float = math.inf,
        odometry: str | None = None,
        world: str = "odom",
        depth: int = 2,
    ) -> None:
        self._stream, self._world, self._no_return = stream, world, no_return
        self._connection = connection  # what it made ends with it
        self._writers = {name: connection.writer(f"{prefix}/{name}", kind) for name, kind in OUTPUTS.items()}
        self._odometry = None if odometry is None else connection.reader(odometry, ODOMETRY, 1)
        self._scans = connection.reader(topic, LASER, depth)
        self._bell = Bell(self._scans)
        self._told: set[str] = set()

    def listen(self, is_over: Callable[[], bool] = lambda: False) -> Iterator[Answered]:
        """Answers scans as they come, until `is_over` says so."""
        while not is_over():
            if not self._bell.wait(PAUSE):
                continue
            for message in self._take(self._scans):
                began = time.monotonic()
                result = self._guarded("a scan", self._answer, message)
                sent = message.sample_info.source_timestamp
                yield Answered(result, _latency(sent, time.monotonic() - began))

    def _answer(self, message: Any) -> ScanResult:
        result = self._stream.feed(laser_scan(message, self._no_return), stamp_of(message.header), self._pose())
        stamp, world = message.header.stamp, self._world
        moving = np.asarray(result.moving)
        self._write("odometry", messages.odometry(result, stamp, world, message.header.frame_id))
        self._write("objects", messages.markers(result.objects, stamp, world))
        self._write("obstacles", messages.obstacles(result.objects, stamp, world))
        self._write("scan_static", messages.without(message, moving))
        self._write("scan_moving", messages.without(message, ~moving))
        self._write("scan_labels", messages.labelled(message, result))
        return result

    def _write(self, name: str, message: Any) -> None:
        self._guarded(name, self._writers[name].write, message)

    def _pose(self) -> Floats | None:
        """(3,) the last pose by the odometry's topic."""
        newest = [] if self._odometry is None else self._take(self._odometry, keep=True)
        if not newest:
            return None
        pose = newest[-1].pose.pose
        return planar_pose(pose.position, pose.orientation)

    def _take(self, reader: Any, *, keep: bool = False) -> list[Any]:
        """The messages that wait; bytes that are none are told and dropped."""
        found = self._guarded("a message", reader.read if keep else reader.take, 1)
        return [message for message in found or [] if message.sample_info.valid_data]

    def _guarded(self, what: str, run: Callable[..., Any], *arguments: Any) -> Any:
        """The result of `run`; None where it fails, which is told the first time."""
        try:
            return run(*arguments)
        except Exception as error:  # whatever is wrong with one scan, the next is answered
            told = f"{what}: {type(error).__name__}: {error}"
            if told not in self._told and len(self._told) < 100:
                self._told.add(told)
                log.warning("%s; left out", told)
            return None


def _latency(sent: int, spent: float) -> float:
    """Seconds since a scan was sent (nanoseconds since 1970), or those spent on it if the sender has another clock."""
    since = 1e-9 * (time.time_ns() - sent)
    return since if spent <= since < FAR_OFF else spent
