"""What the README shows runs as it stands there."""

import re
import shlex
from pathlib import Path

import pytest

from torchcrf_scan.cli import main

README = (Path(__file__).parents[1] / "README.md").read_text()


def blocks(language: str) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```", README, re.MULTILINE | re.DOTALL)


def test_the_python_blocks_run_one_after_the_other():
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


def test_the_commands_run_one_after_the_other(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.chdir(tmp_path)
    lines = [line.split("#")[0] for block in blocks("bash") for line in block.splitlines() if line.startswith("torchcrf-scan")]
    assert len(lines) >= 4
    for line in lines:
        assert main(shlex.split(line)[1:]) == 0, line
    assert (tmp_path / "pair.png").stat().st_size > 10_000
    assert len(list((tmp_path / "predictions").glob("*.npz"))) == 8


def test_every_config_that_the_readme_names_exists():
    named = set(re.findall(r"configs/\w+\.yaml", README))
    assert named
    assert all((Path(__file__).parents[1] / name).is_file() for name in named)
