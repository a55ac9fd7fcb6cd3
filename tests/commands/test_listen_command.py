"""`listen`: answers to a robot in another process, over the loopback interface alone."""

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from command_line import fail, run

pytest.importorskip("cyclonedds", reason="the library cyclonedds is not installed (extra `ros2`)")
pytest.importorskip("rosbags", reason="the library rosbags is not installed (extra `ros2`)")

TESTS = Path(__file__).resolve().parents[1]
DOMAIN = 1 + os.getpid() % 100


def test_listen_follows_a_robot(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = os.pathsep.join([str(TESTS.parent), str(TESTS)])
    command = [sys.executable, str(TESTS / "live_sender.py"), str(DOMAIN), "20", "5"]
    options = ["--loopback=true", f"--domain={DOMAIN}", "--scans=20", "--seconds=40", "--every=1", "--waiting=20"]
    environment = os.environ | {"PYTHONPATH": path}
    with open(tmp_path / "told.json", "w") as told, subprocess.Popen(command, stdout=told, env=environment):
        assert run("listen", *options) == 0
    out = capsys.readouterr().out.splitlines()
    assert out[0] == f"listening to /scan in domain {DOMAIN}"
    assert len(out) > 3
    found = re.fullmatch(
        r"20 scans, ([\d.]+) a second; 0 bad, 0 lost; latency ([\d.]+) ms median, ([\d.]+) ms 95 %, ([\d.]+) ms greatest", out[-1]
    )
    assert found is not None
    answers = json.loads((tmp_path / "told.json").read_text())
    _, x, y, turn, *_ = np.array(answers["odometry"]).T
    np.testing.assert_allclose(x, 0.2 * np.arange(20), atol=0.05)
    np.testing.assert_allclose(y, 0, atol=0.05)
    np.testing.assert_allclose(turn, 0, atol=0.02)


def test_wrong_options_are_named(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    assert "--waiting: expected at least 1 scan, got 0" in fail(capsys, "listen", "--waiting=0")
    assert "domain: expected a number from 0 to 232, got 1000" in fail(capsys, "listen", "--domain=1000")
    message = fail(capsys, "listen", "--topic=a b", "--loopback=true", f"--domain={DOMAIN + 101}")
    assert "topic: expected a name like /scan, got 'a b'" in message
    monkeypatch.setitem(sys.modules, "cyclonedds.domain", None)
    assert "expected the library cyclonedds (extra `ros2`)" in fail(capsys, "listen")


def test_listen_ends_without_scans(capsys: pytest.CaptureFixture[str]) -> None:
    assert run("listen", "--loopback=true", f"--domain={DOMAIN + 100}", "--seconds=0.5") == 0
    assert capsys.readouterr().out.splitlines()[-1] == "no scans"
