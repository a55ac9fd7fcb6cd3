"""A robot in a process of its own: sends scans over the loopback interface, and tells in JSON which answers came.

python live_sender.py DOMAIN COUNT RATE [BAD ...]; BAD: numbers of scans whose bearings are of many turns.
"""

import json
import sys
import time
from collections import defaultdict
from typing import Any

import numpy as np
from bags import LASER, ODOMETRY, laser, room

from torchcrf_scan.live.listener import OUTPUTS
from torchcrf_scan.live.network import LOOPBACK, Connection, Network
from torchcrf_scan.live.types import new

GAP = 0.002  # seconds between odometry and scan
SPEED = 1.0  # metres a second
PATIENCE, QUIET = 20.0, 2.0  # seconds to find each other, and without answers until there will be none


def main(domain: int, count: int, rate: float, *bad: int) -> None:
    connection = Connection(Network(domain, (LOOPBACK,), LOOPBACK))
    writer = connection.writer("/scan", LASER)
    readers = {name: connection.reader(f"/torchcrf_scan/{name}", kind, 1000) for name, kind in OUTPUTS.items()}
    wheels = connection.writer("/wheels", ODOMETRY)
    end = time.monotonic() + PATIENCE
    while time.monotonic() < end and not all(
        [writer.get_matched_subscriptions(), *(reader.get_matched_publications() for reader in readers.values())]
    ):
        time.sleep(0.02)
    begin, answers = time.monotonic(), defaultdict(list)
    for k in range(count):
        time.sleep(max(begin + k / rate - time.monotonic(), 0))
        wheels.write(new(ODOMETRY, pose={"pose": {"position": {"x": k / rate}, "orientation": {"w": 1.0}}}))
        time.sleep(GAP)
        writer.write(scan(k, k / rate, is_bad=k in bad))
        gather(readers, answers)
    came, last = 0, time.monotonic()
    while time.monotonic() - last < QUIET:
        time.sleep(0.02)
        gather(readers, answers)
        if sum(map(len, answers.values())) > came:
            came, last = sum(map(len, answers.values())), time.monotonic()
    print(json.dumps(answers))


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

if __name__ == "__main__":
    domain, count, rate, *bad = sys.argv[1:]
    main(int(domain), int(count), float(rate), *map(int, bad))
