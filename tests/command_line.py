"""What the tests of the command line share: running a command, and what it leaves behind."""

import importlib.util
from collections.abc import Callable
from pathlib import Path

import pytest

from torchcrf_scan.cli import main

ROOT = Path(__file__).resolve().parents[1]


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


def load_main() -> Callable[[list[str]], int]:
    """`main` of train.py, which is no part of the package."""
    spec = importlib.util.spec_from_file_location("train", ROOT / "train.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    main: Callable[[list[str]], int] = module.main
    return main
