"""The build that is begun for want of machine code: once, unless it is switched off, and what it comes to is told."""

import subprocess
import sys
from pathlib import Path

import pytest

from torchcrf_scan.loops import background
from torchcrf_scan.loops.background import LOG_FILE, PROGRESS_FILE, SWITCH, Background


@pytest.fixture
def begun(monkeypatch: pytest.MonkeyPatch) -> list[list[str]]:
    """The commands that are begun; in their place, a process that ends at once, badly."""
    commands: list[list[str]] = []
    real = subprocess.Popen

    def popen(command: list[str], **options: object) -> "subprocess.Popen[bytes]":
        commands.append(command)
        return real([sys.executable, "-c", "raise SystemExit('first line\\nthe reason')"], **options)

    monkeypatch.setattr(background.subprocess, "Popen", popen)
    monkeypatch.setenv(SWITCH, "1")
    return commands


def test_a_build_is_begun_once_and_its_failure_is_told(
    begun: list[list[str]], tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    build = Background()
    build.care(tmp_path)
    assert begun[0][-2:] == ["-m", "torchcrf_scan.prepare"]
    assert build.process is not None
    build.process.wait()
    for _ in range(3):
        build.care(tmp_path)
    assert len(begun) == 1
    assert [record.getMessage() for record in caplog.records][1:] == ["no machine code, slow loops go on: the reason"]
    assert (tmp_path / LOG_FILE).read_text().startswith("first line")


def test_progress_is_told_once_a_step(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture) -> None:
    monkeypatch.setenv(SWITCH, "1")
    build = Background()
    build.process = subprocess.Popen([sys.executable, "-c", "input()"], stdin=subprocess.PIPE)
    try:
        build.care(tmp_path)
        for text in ("1 of 2 parts built", "1 of 2 parts built", "2 of 2 parts built"):
            (tmp_path / PROGRESS_FILE).write_text(text)
            build.care(tmp_path)
        build.complete()
        build.complete()
    finally:
        build.process.communicate(b"\n")
    told = [record.getMessage() for record in caplog.records]
    assert told == [f"machine code: {k} of 2 parts built" for k in (1, 2)] + ["machine code is ready and used from now on"]


def test_without_a_compiler_nothing_is_begun(
    begun: list[list[str]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setenv("CC", "no-such-compiler -O2")
    build = Background()
    for _ in range(3):
        build.care(tmp_path)
    assert begun == []
    assert len(caplog.records) == 1
    assert "expected a C compiler" in caplog.text


def test_it_can_be_switched_off(begun: list[list[str]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(SWITCH, "0")
    Background().care(tmp_path)
    assert begun == []
