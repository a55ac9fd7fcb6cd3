"""What the README shows runs as it stands there."""

import re
import shlex
from pathlib import Path

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
    assert namespace["loss"].isfinite()
    first, *_, last = namespace["losses"]
    assert last < 0.9 * first  # the toy network has learned something
    assert namespace["result"].status == "ok"
    assert namespace["result"].objects


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
