"""The command line as its users meet it: help, one clear line for every mistake, and a package that imports fast."""

import re
import shutil
import subprocess
import sys
from dataclasses import fields
from pathlib import Path

import pytest
from command_line import run

import torchcrf_scan
from torchcrf_scan import cli
from torchcrf_scan.commands.evaluate import METHODS
from torchcrf_scan.data.worlds import SimulatorConfig

ROOT = Path(__file__).resolve().parents[1]


# --- the package --------------------------------------------------------------------------------------------------------------


def test_imports_stay_light() -> None:
    code = (
        "import sys, torchcrf_scan; heavy = 'matplotlib sklearn scipy tensorboard rosbags numba'.split();"
        "print([name for name in [*heavy, 'jsonargparse'] if name in sys.modules]);"
        "import torchcrf_scan.cli; print([name for name in heavy if name in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
    assert done.stdout == "[]\n[]\n"


def test_public_names_are_there() -> None:
    assert all(hasattr(torchcrf_scan, name) for name in torchcrf_scan.__all__)


# --- usage --------------------------------------------------------------------------------------------------------------------


def help_of(capsys: pytest.CaptureFixture[str], *command: str, option: str = "--help") -> str:
    with pytest.raises(SystemExit) as stop:
        run(*command, option)
    assert stop.value.code == 0
    return capsys.readouterr().out


def test_help_tells_every_option(capsys: pytest.CaptureFixture[str]) -> None:
    commands, match, plot = (help_of(capsys, *of) for of in ((), ("match",), ("plot",)))
    assert all(name in commands for name in cli.COMMANDS)
    simulate = help_of(capsys, "simulate")
    assert all(f"--simulator.{field.name}" in simulate for field in fields(SimulatorConfig))
    assert all(f"--{name}" in match for name in ("output", "every", "model", "candidates", "device", "threads"))
    evaluate = help_of(capsys, "evaluate")
    assert all(f"--{name}" in evaluate for name in ("predictions", "method", "model", "json", "frame_offset", "frame_turn", "seed"))
    assert all(name in evaluate for name in METHODS)
    assert all(f"--{name}" in plot for name in ("number", "prediction", "model", "output"))


@pytest.mark.parametrize(
    ("arguments", "hint"),
    [
        (["match", "a.npz", "--outptu", "b"], "(did you mean --output instead of --outptu?)"),
        (["evaluate", "a.npz", "--metod=icp"], "(did you mean --method instead of --metod?)"),
        (["experiment", "--confg", "a.yaml"], "(did you mean --config instead of --confg?)"),
        (["simulate", "--output", "b", "--simulator.beamz", "5"], "--simulator.beams instead of --simulator.beamz"),
        (["match", "a.npz", "--output", "b", "--xyzzy"], None),
    ],
)
def test_a_mistyped_option_is_told_with_the_right_one(
    arguments: list[str], hint: str | None, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit):
        run(*arguments)
    said = capsys.readouterr().err
    assert "did you mean" not in said if hint is None else hint in said


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ([], "command"),
        (["fly"], "fly"),
        (["match", "a.npz"], "output"),
        (["match", "--output", "b"], "files"),
        (["match", "a.npz", "--output", "b", "--candidates", "many"], "candidates"),
        (["match", "a.log", "--output", "b", "--every", "1.5"], "--every: expected a whole number, got 1.5"),
        (["evaluate"], "pair_files"),
        (["evaluate", "a.npz", "--frame_turn", "some"], "frame_turn"),
        (["plot", "a.log", "--number", "last", "--output", "c.png"], "number"),
        (["match", "a.npz", "--output", "b", "--speed", "3"], "--speed"),
        (["simulate", "--output", "b", "--simulator.beams", "1.5"], "simulator.beams"),
        (["simulate", "--output", "b", "--simulator.beamz", "5"], "simulator.beamz"),
        (["plot", "a.npz", "b.npz", "--output", "c.png"], "b.npz"),
    ],
)
def test_bad_usage_exits_with_2(arguments: list[str], message: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stop:
        run(*arguments)
    assert stop.value.code == 2
    said = capsys.readouterr().err
    assert message in said
    assert len(said.splitlines()) == 1
    assert said.startswith("torchcrf-scan")


def test_a_shell_completes_commands_and_options(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    pytest.importorskip("shtab", reason="completion needs shtab (extra `completion`)")
    bash = shutil.which("bash")
    if bash is None:
        pytest.skip("no bash")
    script = tmp_path / "completion.bash"
    script.write_text(help_of(capsys, option="--print_completion=shtab-bash"))

    def completed(*words: str) -> set[str]:
        (function,) = re.findall(r"^complete .*-F (\S+) torchcrf-scan$", script.read_text(), re.MULTILINE)
        line = f"source {script}; COMP_WORDS=({' '.join(map(repr, words))}); COMP_CWORD={len(words) - 1}; {function}"
        done = subprocess.run(
            [bash, "-c", f'{line} torchcrf-scan; printf "%s\\n" "${{COMPREPLY[@]}}"'], capture_output=True, text=True
        )
        return set(done.stdout.split())

    assert completed("torchcrf-scan", "ma") == {"match"}
    assert "--outlier_distance" in completed("torchcrf-scan", "match", "--out")
