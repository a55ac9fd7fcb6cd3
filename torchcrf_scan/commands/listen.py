"""`torchcrf-scan listen`: answers to the scans of a running robot, over DDS as ROS 2 uses it."""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Callable

import numpy as np

from torchcrf_scan.commands.arguments import listed, load_model
from torchcrf_scan.errors import TorchCRFScanError
from torchcrf_scan.live.listener import Answered, Listener
from torchcrf_scan.live.network import LOOPBACK, Connection, Network
from torchcrf_scan.pretrained import PRETRAINED
from torchcrf_scan.stream.config import StreamConfig
from torchcrf_scan.stream.stream import ScanStream

KEPT = 10_000  # latencies that are remembered


def listen(
    stream: StreamConfig,
    *,
    topic: str = "/scan",
    odometry: str | None = None,
    no_return: float = math.inf,
    prefix: str = "/torchcrf_scan",
    world: str = "odom",
    waiting: int = 2,
    domain: int | None = None,
    peers: tuple[str, ...] | str = (),
    interface: str = "",
    loopback: bool = False,
    report: float = 5.0,
    seconds: float | None = None,
    scans: int | None = None,
    model: str = PRETRAINED,
    device: str = "cpu",
    threads: int = 1,
) -> int:
    """Subscribes to sensor_msgs/LaserScan of ROS 2 and publishes odometry, moving objects and the scan without them.

    ROS need not be installed: messages go over DDS (library cyclonedds). Scans are read best effort, answers fit any subscriber,
    and a slow one is never waited for. Published under the prefix: odometry (nav_msgs/Odometry), objects
    (visualization_msgs/MarkerArray), obstacles (nav2_dynamic_msgs/ObstacleArray), scan_static and scan_moving (the LaserScan with
    NaN for movers' beams, and for all others) and scan_labels (with the labels as intensities: 0 background, k object k, -1
    outlier). Runs until it is interrupted. Tried with cyclonedds on both sides; other vendors' DDS is untested.

    Args:
        stream: settings of ego motion and objects
        topic: of the scans
        odometry: topic of nav_msgs/Odometry whose last pose is the first guess of the motion
        no_return: readings in metres from there on mean that nothing came back, beside what the scans say
        prefix: of the topics that are published
        world: frame of the published odometry and objects, that of the first scan
        waiting: scans that may wait for an answer; when more come, the oldest are left out
        domain: number of the DDS domain; by default the environment's ROS_DOMAIN_ID, or 0
        peers: address, or a list of them, to look for others at, without multicast
        interface: address of the network interface
        loopback: this machine alone, without multicast
        report: seconds between lines about rate and latency, 0 for none
        seconds: ends after so many
        scans: ends after so many scans
        model: folder of a saved model, or the name of one that the package ships
        device: device that torch computes on, e.g. cpu or cuda
        threads: number of threads that torch computes with; scans come one after the other, so more only wait for each other
    """
    if waiting < 1:
        raise TorchCRFScanError(f"--waiting: expected at least 1 scan, got {waiting}")
    if not no_return > 0:
        raise TorchCRFScanError(f"--no_return: expected metres above 0, got {no_return}")
    network = Network(domain, (LOOPBACK,), LOOPBACK) if loopback else Network(domain, listed(peers), interface)
    answering = ScanStream(load_model(model, None, device, threads), stream)
    names = {"topic": topic, "prefix": prefix, "world": world}
    listener = Listener(Connection(network), answering, odometry=odometry, no_return=no_return, depth=waiting, **names)
    print(f"listening to {topic} in domain {network.number}", flush=True)
    _count(listener, Report(report), seconds, scans)
    return 0


def _count(listener: Listener, report: Report, seconds: float | None, scans: int | None) -> None:
    """Listens for so long, or to so many scans, and tells how it goes."""
    try:
        for answered in listener.listen(_limit(report, seconds, scans)):
            report.add(answered)
    finally:
        print(report.line(), flush=True)


def _limit(report: Report, seconds: float | None, scans: int | None) -> Callable[[], bool]:
    end = time.monotonic() + seconds if seconds is not None else np.inf
    return lambda: time.monotonic() > end or (scans is not None and report.scans >= scans)


class Report:
    """Counts and latencies, told every few seconds.

    Attributes:
        scans: that came. bad: of these, without an answer. lost: answered, but not placed.
    """

    def __init__(self, every: float) -> None:
        self.scans = self.bad = self.lost = 0
        self._every, self._latencies = every, deque[float](maxlen=KEPT)
        self._began = self._told = time.monotonic()

    def add(self, answered: Answered) -> None:
        """Counts a scan, and prints a line if it is time."""
        if self.scans == 0:
            self._began = self._told = time.monotonic()
        self.scans += 1
        self.bad += answered.result is None
        self.lost += answered.result is not None and answered.result.status == "lost"
        self._latencies.append(answered.seconds)
        if self._every > 0 and time.monotonic() - self._told > self._every:
            self._told = time.monotonic()
            print(self.line(), flush=True)

    def line(self) -> str:
        """What came so far; latencies from the sending of a scan to the last message about it."""
        if not self._latencies:
            return "no scans"
        rate = (self.scans - 1) / max(time.monotonic() - self._began, 1e-9)
        middle, high, most = 1e3 * np.quantile(np.array(self._latencies), (0.5, 0.95, 1.0))
        counts = f"{self.scans} scans, {rate:.1f} a second; {self.bad} bad, {self.lost} lost"
        return f"{counts}; latency {middle:.1f} ms median, {high:.1f} ms 95 %, {most:.1f} ms greatest"
