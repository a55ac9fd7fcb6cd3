"""`listen`: answers to a robot in another process, over the loopback interface alone."""

import json
import os
import re
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from command_line import fail, run

pytest.importorskip("cyclonedds", reason="the library cyclonedds is not installed (extra `ros2`)")
pytest.importorskip("rosbags", reason="the library rosbags is not installed (extra `ros2`)")

import live_sender
from forked import begin

LOGS = Path(__file__).resolve().parents[3] / "shared" / "data" / "logs"
DOMAIN = 1 + os.getpid() % 100


LINE = r"(\d+) scans, [\d.]+ a second; 0 bad, (\d+) lost; latency ([\d.]+) ms median, [\d.]+ ms 95 %, [\d.]+ ms greatest"


def follow(folder: Path, robot: Callable[..., None], count: int, source: object, *options: str) -> tuple[int, dict[str, Any]]:
    """Listens to a robot in another process: the exit code, and what it was answered."""
    process = begin(robot, told := folder / "told.json", DOMAIN, count, source)
    code = run("listen", "--loopback=true", f"--domain={DOMAIN}", f"--scans={count}", "--seconds=50", *options)
    process.join()
    return code, json.loads(told.read_text())


def test_listen_follows_a_robot(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    code, answers = follow(tmp_path, live_sender.drive, 20, 5.0, "--report=1", "--waiting=20")
    assert code == 0
    out = capsys.readouterr().out.splitlines()
    assert out[0] == f"listening to /scan in domain {DOMAIN}"
    assert len(out) > 3
    found = re.fullmatch(LINE, out[-1])
    assert found is not None
    assert found.groups()[:2] == ("20", "0")
    _, x, y, turn, *_ = np.array(answers["odometry"]).T
    np.testing.assert_allclose(x, 0.2 * np.arange(20), atol=0.05)
    np.testing.assert_allclose(y, 0, atol=0.05)
    np.testing.assert_allclose(turn, 0, atol=0.02)


@pytest.mark.skipif(not LOGS.is_dir(), reason="the recordings are not here")
def test_listen_keeps_up_with_a_recorded_robot(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """At its own speed, 12.5 scans a second."""
    code, answers = follow(tmp_path, live_sender.replay, 100, LOGS / "datmo_overtakes.bag", "--report=0", "--waiting=20")
    last = capsys.readouterr().out.splitlines()[-1]
    print(last)
    found = re.fullmatch(LINE, last)
    assert code == 0
    assert found is not None
    assert int(found[1]) >= 97
    assert len(answers["scan_static"]) >= 97
    assert float(found[3]) < 200  # 25 on two idle cores


def test_wrong_options_are_named(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    assert "--waiting: expected at least 1 scan, got 0" in fail(capsys, "listen", "--waiting=0")
    assert "--no_return: expected metres above 0, got -1.0" in fail(capsys, "listen", "--no_return=-1")
    assert "domain: expected a number from 0 to 232, got 1000" in fail(capsys, "listen", "--domain=1000")
    message = fail(capsys, "listen", "--topic=a b", "--loopback=true", f"--domain={DOMAIN + 101}")
    assert "topic: expected a name like /scan, got 'a b'" in message
    monkeypatch.setitem(sys.modules, "cyclonedds.domain", None)
    assert "expected the library cyclonedds (extra `ros2`)" in fail(capsys, "listen")


def test_listen_ends_without_scans(capsys: pytest.CaptureFixture[str]) -> None:
    assert run("listen", "--loopback=true", f"--domain={DOMAIN + 100}", "--seconds=0.5") == 0
    assert capsys.readouterr().out.splitlines()[-1] == "no scans"
