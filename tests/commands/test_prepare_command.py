"""`torchcrf-scan prepare`: says where the machine code lies, and names what it does not know."""

import pytest
from command_line import fail, run

from torchcrf_scan.loops import machine


def test_it_says_where_the_machine_code_lies(capsys: pytest.CaptureFixture[str]) -> None:
    assert run("prepare") == 0
    out = capsys.readouterr().out
    assert out == f"machine code is ready in {machine.writable_folder()}\n"
    assert machine.missing(machine.processor_level()) == []


@pytest.mark.parametrize("levels", ["avx9", "[avx9]", "[generic,avx9]"])
def test_an_unknown_level_is_an_error(capsys: pytest.CaptureFixture[str], levels: str) -> None:
    assert "expected some of x86-64-v2, x86-64-v3, generic, got avx9" in fail(capsys, "prepare", f"--levels={levels}")


def test_a_closed_stdout_is_no_error(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sys.stdout", None)
    assert run("prepare") == 0
