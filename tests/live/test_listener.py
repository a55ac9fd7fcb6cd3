"""Two processes on the loopback interface: one sends scans, the other answers."""

import json
import logging
import os
import signal
import tempfile
import threading
import time
from multiprocessing.connection import Connection as Connected
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("cyclonedds", reason="the library cyclonedds is not installed (extra `ros2`)")
pytest.importorskip("rosbags", reason="the library rosbags is not installed (extra `ros2`)")

import live_sender
from cyclonedds.qos import Policy
from cyclonedds.sub import DataReader
from forked import CONTEXT, begin

from torchcrf_scan.live.listener import OUTPUTS, Answered, Listener
from torchcrf_scan.live.network import LOOPBACK, Connection, Network, _quality
from torchcrf_scan.result import MovingObject, ScanResult
from torchcrf_scan.scan import Floats, Scan

DOMAIN = 1 + os.getpid() % 200
ALL = 1000  # scans may wait, so that a slow machine loses none


class Straight:
    """Says that the sensor goes 0.1 m with every scan, and that beams 10 to 19 move."""

    def __init__(self, slow: float = 0.0, fails_at: int | None = None) -> None:
        self.stamps: list[float] = []
        self.odometry: list[Floats | None] = []
        self.slow, self.fails_at = slow, fails_at

    def feed(self, scan: Scan, stamp: float, odometry: Floats | None = None) -> ScanResult:
        if len(self.stamps) == self.fails_at:
            self.fails_at = None
            raise ZeroDivisionError("nobody thought of that")
        self.stamps.append(stamp)
        self.odometry.append(odometry)
        time.sleep(self.slow)
        track = np.where((np.arange(scan.n_beams) // 10) == 1, 3, 0)
        one = MovingObject(3, np.array([1.0, 2.0]), np.array([0.5, 0.0]), np.eye(4), 0.0, (4.0, 2.0), 10, 1.0)
        pose = np.array([0.0, 0.1 * len(self.stamps), 0.0])
        return ScanResult(
            scan, stamp, pose, 0.01 * np.eye(3), np.array([0.0, 1.0, 0.0]), np.eye(3), track > 0, track, (one,), "ok", ""
        )


def listen(stream: Any, domain: int, count: int, rate: float, *bad: int, **options: Any) -> tuple[list[Answered], dict[str, Any]]:
    """The scans that came, and what the other process was answered."""
    listener = Listener(Connection(Network(domain, (LOOPBACK,), LOOPBACK)), stream, **options)
    with tempfile.TemporaryDirectory() as folder:
        process = begin(live_sender.drive, told := Path(folder) / "told.json", domain, count, rate, *bad)
        answered = list(listener.listen(lambda: not process.is_alive()))
        assert process.exitcode == 0
        return answered, json.loads(told.read_text())


@pytest.fixture(scope="module")
def answers() -> tuple[list[Answered], dict[str, Any], Straight]:
    stream = Straight()
    return (*listen(stream, DOMAIN, 60, 40.0, depth=ALL), stream)


def test_every_scan_is_answered_on_every_topic(answers: tuple[list[Answered], dict[str, Any], Straight]) -> None:
    answered, told, stream = answers
    assert len(answered) == len(stream.stamps) == 60
    np.testing.assert_allclose(stream.stamps, 100 + np.arange(60) / 40, atol=1e-6)
    assert {name: len(told[name]) for name in OUTPUTS} == dict.fromkeys(OUTPUTS, 60)


def test_answers_say_what_the_stream_does(answers: tuple[list[Answered], dict[str, Any], Straight]) -> None:
    _, told, _ = answers
    stamp, x, y, turn, speed, variance = told["odometry"][9]
    assert (stamp, x, y, turn, speed, variance) == pytest.approx((100 + 9 / 40, 1.0, 0.0, 0.0, 1.0, 0.01))
    assert told["objects"][0] == [["objects", 3, 1], ["velocities", 3, 0]]
    assert told["obstacles"][0] == [[1.0, 0.5, 4.0]]
    assert told["scan_static"][0][1:] == list(range(10, 20))  # the first beam of the room returned inf, which stays
    assert told["scan_moving"][0][1:] == [*range(10), *range(20, 181)]
    assert told["scan_labels"][0][1:] == [*[0] * 10, *[3] * 10, *[0] * 161]


def test_a_bad_scan_stops_nothing(caplog: pytest.LogCaptureFixture) -> None:
    stream = Straight(fails_at=20)
    with caplog.at_level(logging.WARNING):
        answered, told = listen(stream, DOMAIN + 1, 40, 40.0, 5, 6, depth=ALL)
    bad = [k for k, one in enumerate(answered) if one.result is None]
    assert bad == [5, 6, 22]
    assert len(told["odometry"]) == 37
    warnings = [record.message for record in caplog.records]
    assert len(warnings) == 2  # the same fault is told once
    assert "a scan: TorchCRFScanError: bearings: expected radians of one turn" in warnings[0]
    assert "nobody thought of that" in warnings[1]


def test_scans_that_come_too_fast_are_left_out() -> None:
    stream = Straight(slow=0.1)
    answered, told = listen(stream, DOMAIN + 2, 60, 40.0, depth=2)
    assert len(answered) < 40
    assert stream.stamps[-1] == pytest.approx(100 + 59 / 40)
    assert len(told["odometry"]) == len(answered)


def test_odometry_is_the_first_guess() -> None:
    stream = Straight()
    listen(stream, DOMAIN + 3, 20, 20.0, odometry="/wheels", depth=ALL)
    known = [pose[1] if pose is not None else np.nan for pose in stream.odometry]
    np.testing.assert_allclose(known[5:], np.arange(5, 20) / 20, atol=0.051)  # perhaps that of the scan before
    assert stream.stamps == pytest.approx(100 + np.arange(20) / 20)


def hang(domain: int, got_all: Connected) -> None:
    """A process that asked for every message, reliably, and then does nothing more."""
    connection = Connection(Network(domain, (LOOPBACK,), LOOPBACK))
    reliable = Policy.Reliability.Reliable(10**9)
    readers = [
        DataReader(connection.participant, connection._topic(f"/torchcrf_scan/{name}", kind), qos=_quality(kind, 100, reliable))
        for name, kind in OUTPUTS.items()
    ]
    while not all(reader.take(1) for reader in readers):
        time.sleep(0.01)
    got_all.send(os.getpid())
    time.sleep(100)


def test_a_subscriber_that_hangs_slows_nothing(tmp_path: Path) -> None:
    domain, stream = DOMAIN + 4, Straight()
    listener = Listener(Connection(Network(domain, (LOOPBACK,), LOOPBACK)), stream, depth=ALL)
    told, (got_all, says_so) = tmp_path / "told.json", CONTEXT.Pipe(duplex=False)
    hanging = begin(hang, domain, says_so)
    stopper = threading.Thread(target=lambda: os.kill(got_all.recv(), signal.SIGSTOP))
    stopper.start()
    try:
        process = begin(live_sender.drive, told, domain, 100, 40.0)
        answered = list(listener.listen(lambda: not process.is_alive()))
        assert not stopper.is_alive(), "it did not hang"
        assert hanging.is_alive()
    finally:
        hanging.kill()
    assert len(json.loads(told.read_text())["scan_static"]) == 100
    assert len(answered) == 100
