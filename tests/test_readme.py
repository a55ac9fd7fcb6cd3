"""What the README shows runs as it stands there."""

import re
import shlex
import sys
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import ClassVar

import numpy as np
import pytest

from torchcrf_scan.cli import main

README = (Path(__file__).parents[1] / "README.md").read_text()


def blocks(language: str) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```", README, re.MULTILINE | re.DOTALL)


def commands() -> list[list[str]]:
    lines = [line.split("#")[0] for block in blocks("bash") for line in block.splitlines() if line.startswith("torchcrf-scan")]
    return [shlex.split(line)[1:] for line in lines]


def test_the_python_blocks_run_one_after_the_other(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.chdir(tmp_path)
    assert main(commands()[0]) == 0  # the log that they read
    namespace: dict[str, object] = {}
    for block in blocks("python"):
        exec(compile(block, "README.md", "exec"), namespace)
    theta, x, y = namespace["answer"].motions[0]
    assert abs(theta) < 0.01
    assert abs(x + 0.3) < 0.05
    assert abs(y) < 0.05
    first, *_, last = namespace["losses"]
    assert last < 0.9 * first  # the toy network has learned something
    told = re.search(r"# ((?:\d\.\d\d ?){12})$", blocks("python")[-1], re.MULTILINE)
    np.testing.assert_allclose(namespace["losses"], np.array(told[1].split(), float), atol=0.02)
    assert namespace["result"].status == "ok"
    assert namespace["result"].objects


class Message(SimpleNamespace):
    """A stand-in for a message of ROS: any field is there, and those of fields."""

    def __getattr__(self, name: str) -> "Message":
        field = Message()
        setattr(self, name, field)
        return field


class Node:
    """A stand-in for `rclpy.node.Node`."""

    published: ClassVar[list[Message]] = []
    taken: ClassVar[list[Callable[[Message], None]]] = []

    def __init__(self, name: str) -> None:
        self.name = name

    def create_publisher(self, kind: type, topic: str, depth: int) -> SimpleNamespace:
        return SimpleNamespace(publish=self.published.append)

    def create_subscription(self, kind: type, topic: str, callback: Callable[[Message], None], profile: object) -> None:
        self.taken.append(callback)


def spin(node: Node) -> None:
    """Sends a scan of a room from every 5 cm of a way along it."""
    angles = np.radians(np.arange(-180, 180))
    for k in range(6):
        with np.errstate(divide="ignore"):
            ahead = np.where(np.cos(angles) > 0, 5 - 0.05 * k, -3 - 0.05 * k) / np.cos(angles)
            ranges = np.minimum(np.abs(4 / np.sin(angles)), ahead)
        header = Message(stamp=Message(sec=7, nanosec=k * 100_000_000), frame_id="laser")
        limits = {"range_min": 0.1, "range_max": 30.0, "time_increment": 0.0}
        node.taken[0](Message(header=header, ranges=ranges, angle_min=-np.pi, angle_increment=np.radians(1), **limits))


def test_the_node_publishes_where_the_laser_is(monkeypatch: pytest.MonkeyPatch):
    modules = {
        "rclpy": {"init": lambda: None, "spin": spin},
        "rclpy.node": {"Node": Node},
        "rclpy.qos": {"qos_profile_sensor_data": object()},
        "nav_msgs.msg": {"Odometry": Message},
        "sensor_msgs.msg": {"LaserScan": Message},
    }
    for name, content in modules.items():
        monkeypatch.setitem(sys.modules, name, SimpleNamespace(**content))
    (node,) = blocks("py")
    exec(compile(node, "README.md", "exec"), {})
    last = Node.published[-1]
    assert len(Node.published) == 6
    assert last.header.frame_id == "odom"
    assert last.pose.pose.position.x == pytest.approx(0.25, abs=0.02)
    assert last.pose.pose.position.y == pytest.approx(0.0, abs=0.02)
    assert last.pose.pose.orientation.w == pytest.approx(1.0, abs=0.01)


def test_the_commands_run_one_after_the_other(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.chdir(tmp_path)
    assert len(commands()) >= 6
    for command in commands():
        assert main(command) == 0, command
    assert {path.name for path in (tmp_path / "drive").iterdir()} >= {"poses.tum", "tracks.csv", "summary.png"}
    assert (tmp_path / "pair.png").stat().st_size > 10_000
    assert len(list((tmp_path / "predictions").glob("*.npz"))) == 8


def test_every_config_that_the_readme_names_exists():
    named = set(re.findall(r"configs/\w+\.yaml", README))
    assert named
    assert all((Path(__file__).parents[1] / name).is_file() for name in named)
