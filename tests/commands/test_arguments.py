"""Folders and models that are not what they should be."""

import re
from pathlib import Path

import pytest
from command_line import fail

from torchcrf_scan.cli import main


def test_output_must_not_be_a_file(tmp_path: Path, model_dir: Path, pairs_dir: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "file").touch()
    assert "--output: expected a folder" in fail(capsys, "simulate", "--output", tmp_path / "file", "--pairs=1", "--sequences=1")
    assert "--output: expected a folder" in fail(capsys, "match", pairs_dir, "--output", tmp_path / "file", "--model", model_dir)


@pytest.mark.parametrize("command", ["match", "run", "plot"])
def test_an_empty_file_is_told_as_such(tmp_path: Path, command: str, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "run.bag").touch()
    assert main([command, str(tmp_path / "run.bag"), "--output", str(tmp_path / "out.png")]) == 1
    assert re.search(r"run\.bag: expected one of pair file, .*, got an empty file\n$", capsys.readouterr().err)


@pytest.mark.parametrize("name", ["config.json", "model.safetensors"])
def test_a_damaged_model_is_one_clear_line(
    pairs_dir: Path, model_dir: Path, tmp_path: Path, name: str, capsys: pytest.CaptureFixture[str]
) -> None:
    for path in model_dir.iterdir():
        (tmp_path / path.name).write_bytes(path.read_bytes()[: 100 if path.name == name else None])
    assert f"--model {tmp_path}" in fail(capsys, "match", pairs_dir, "--output", tmp_path / "out", "--model", tmp_path)
