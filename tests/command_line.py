"""What the tests of the command line share: running a command, and what it leaves behind."""

from pathlib import Path

import pytest

from torchcrf_scan.cli import main


def run(*arguments: object) -> int:
    return main([str(argument) for argument in arguments])


def fail(capsys: pytest.CaptureFixture[str], *arguments: object) -> str:
    """The one line on stderr of a command that exits with 1."""
    assert run(*arguments) == 1
    out, err = capsys.readouterr()
    assert err.count("\n") == 1, err
    assert err.startswith(f"torchcrf-scan {arguments[0]}: error: ")
    assert out == ""
    return err


def contents(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir()}
