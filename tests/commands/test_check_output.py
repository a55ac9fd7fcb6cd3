"""Outputs never replace what they are made of."""

from pathlib import Path

import pytest
from command_line import fail, run
from results import carmen_log

from torchcrf_scan.commands.odometry import odometry
from torchcrf_scan.commands.play import play
from torchcrf_scan.commands.track import track


@pytest.mark.parametrize("command", [odometry, track, play])
def test_the_log_is_not_replaced(tmp_path: Path, command) -> None:  # type: ignore[no-untyped-def]
    log = tmp_path / "room.gif"
    log.write_text("as it was")
    with pytest.raises(ValueError, match="expected another file than the log"):
        command(str(log), str(log))
    assert log.read_text() == "as it was"


@pytest.mark.parametrize("command", [odometry, track])
def test_a_folder_is_no_output(tmp_path: Path, command) -> None:  # type: ignore[no-untyped-def]
    with pytest.raises(ValueError, match="a folder"):
        command("room.log", str(tmp_path))


def test_run_does_not_replace_its_log(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    log = tmp_path / "tracks.csv"
    assert run("simulate", "--output", log, "--drive=3", "--simulator.beams=31") == 0
    before = log.read_bytes()
    capsys.readouterr()
    assert "expected another file than the log" in fail(capsys, "run", log, "--output", tmp_path)
    assert log.read_bytes() == before


def test_nor_does_its_clean_log_or_the_file_for_the_viewer(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    log = carmen_log(tmp_path / "clean.log")
    before = log.read_bytes()
    assert "expected another file than the log" in fail(capsys, "run", log, "--output", tmp_path, "--clean")
    assert "--rerun: expected another file than the log" in fail(
        capsys, "odometry", log, "--output", tmp_path / "poses.tum", "--rerun", log
    )
    assert log.read_bytes() == before
