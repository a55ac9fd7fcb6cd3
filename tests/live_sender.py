"""A robot in a process of its own: sends scans over the loopback interface, and tells in JSON which answers came."""

import json
import time
from collections import defaultdict
from collections.abc import Iterable, Iterator
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
from bags import LASER, ODOMETRY, laser, room

from torchcrf_scan.data.formats import read_scans
from torchcrf_scan.live.listener import OUTPUTS
from torchcrf_scan.live.network import LOOPBACK, Connection, Network
from torchcrf_scan.live.types import new

GAP = 0.002  # seconds between odometry and scan
SPEED = 1.0  # metres a second
PATIENCE, QUIET = 20.0, 2.0  # seconds to find each other, and without answers until there will be none


def drive(told: Path, domain: int, count: int, rate: float, *bad: int) -> None:
    """A drive through a room; bad: numbers of scans whose bearings are of many turns."""
    send(told, domain, ((k / rate, scan(k, k / rate, is_bad=k in bad)) for k in range(count)))


def replay(told: Path, domain: int, count: int, log: Path) -> None:
    """The first scans of a log, at its own speed."""
    send(told, domain, messages_of(count, log))


def send(told: Path, domain: int, messages: Iterable[tuple[float, Any]]) -> None:
    """messages: seconds and scan."""
    connection = Connection(Network(domain, (LOOPBACK,), LOOPBACK))
    writer, wheels = connection.writer("/scan", LASER), connection.writer("/wheels", ODOMETRY)
    readers = {name: connection.reader(f"/torchcrf_scan/{name}", kind, 1000) for name, kind in OUTPUTS.items()}
    end = time.monotonic() + PATIENCE
    while time.monotonic() < end and not all(
        [writer.get_matched_subscriptions(), *(reader.get_matched_publications() for reader in readers.values())]
    ):
        time.sleep(0.02)
    begin, answers = time.monotonic(), defaultdict(list)
    for seconds, message in messages:
        time.sleep(max(begin + seconds - time.monotonic(), 0))
        wheels.write(new(ODOMETRY, pose={"pose": {"position": {"x": seconds}, "orientation": {"w": 1.0}}}))
        time.sleep(GAP)
        writer.write(message)
        gather(readers, answers)
    came, last = 0, time.monotonic()
    while time.monotonic() - last < QUIET:
        time.sleep(0.02)
        gather(readers, answers)
        if sum(map(len, answers.values())) > came:
            came, last = sum(map(len, answers.values())), time.monotonic()
    told.write_text(json.dumps(answers))


def messages_of(count: int, log: Path) -> Iterator[tuple[float, Any]]:
    """The scans of a log whose beams are a step apart, as messages."""
    begin = None
    for reading in islice(read_scans(str(log)), count):
        begin = reading.stamp if begin is None else begin
        whole, bearings = reading.scan, reading.scan.beam_bearings
        step = (whole.bearings[-1] - whole.bearings[0]) / (whole.beam[-1] - whole.beam[0])
        first = bearings[whole.beam[0]] - step * whole.beam[0]
        header = {"stamp": {"sec": int(reading.stamp), "nanosec": int(1e9 * (reading.stamp % 1))}, "frame_id": "laser"}
        ranges = whole.to_beams(whole.ranges, np.nan).tolist()
        limits = {"range_min": whole.range_min or 0.0, "range_max": whole.range_max or 0.0}
        yield reading.stamp - begin, new(LASER, header=header, angle_min=first, angle_increment=step, ranges=ranges, **limits)


def scan(k: int, seconds: float, *, is_bad: bool) -> Any:
    told = laser(100 + seconds, room(SPEED * seconds))
    told["header"].pop("seq")
    told["ranges"] = told["ranges"].tolist()
    return new(LASER, **told | ({"angle_increment": 1.0} if is_bad else {}))


def gather(readers: dict[str, Any], answers: dict[str, list[Any]]) -> None:
    for name, reader in readers.items():
        answers[name] += [TOLD[name](message) for message in reader.take(100) if message.sample_info.valid_data]


def stamp(message: Any) -> float:
    return message.header.stamp.sec + 1e-9 * message.header.stamp.nanosec


def odometry(message: Any) -> list[float]:
    pose = message.pose.pose
    turn = 2 * np.arctan2(pose.orientation.z, pose.orientation.w)
    return [stamp(message), pose.position.x, pose.position.y, turn, message.twist.twist.linear.x, message.pose.covariance[0]]


def blanks(message: Any) -> list[float]:
    return [stamp(message), *np.flatnonzero(np.isnan(message.ranges)).tolist()]


TOLD = {
    "odometry": odometry,
    "objects": lambda message: [[marker.ns, marker.id, marker.type] for marker in message.markers],
    "obstacles": lambda message: [[one.position.x, one.velocity.x, one.size.x] for one in message.obstacles],
    "scan_static": blanks,
    "scan_moving": blanks,
    "scan_labels": lambda message: [stamp(message), *message.intensities],
}
