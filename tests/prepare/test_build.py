"""Building machine code: by one process at a time, whole files or none, and nothing that belongs to another copy is removed."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

from torchcrf_scan.loops import machine
from torchcrf_scan.prepare import build
from torchcrf_scan.prepare.build import NoCompilerError, build_missing

LEVEL = machine.processor_level()
HOLD = "import fcntl, sys; file = open(sys.argv[1], 'w'); fcntl.flock(file, fcntl.LOCK_EX); print('held', flush=True); input()"


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty folder of machine code, and builds that take no time."""

    def build_level(level: str, parts: list[str], folder: Path) -> list[str]:
        for part in parts:
            path = machine.library(folder, part, level)
            path.write_bytes(b"code of " + part.encode())
            build._list_entries(path, {f"{part}.entry": ["float"]})
            build._remove_older(path, part, level)
        return parts

    monkeypatch.setattr(machine, "folders", lambda: [tmp_path])
    monkeypatch.setattr(build, "_build_level", build_level)
    return tmp_path


def test_what_is_missing_is_built_and_told(folder: Path) -> None:
    told: list[tuple[int, int]] = []
    for levels in (["x86-64-v2"], ["x86-64-v2", "x86-64-v3"], ["x86-64-v2"]):
        build_missing(levels, lambda done, count: told.append((done, count)))
    count = len(machine.PARTS)
    assert told == [(k, count) for k in range(1, count + 1)] * 2
    for level in ("x86-64-v2", "x86-64-v3"):
        assert machine.missing(level) == []
    path = machine.library(folder, "pool", "x86-64-v3")
    assert path.read_bytes() == b"code of pool"
    assert json.loads(path.with_suffix(".json").read_bytes())["entries"] == {"pool.entry": ["float"]}
    assert not [path for path in folder.iterdir() if path.name.startswith(".")]


def test_older_code_of_this_copy_goes_and_nothing_else(folder: Path) -> None:
    now = machine.library(folder, "pool", LEVEL).name
    old = now.replace(machine.stem("pool", LEVEL), f"pool-{'0' * 16}-{LEVEL}")
    kept = [old.replace(LEVEL, "generic"), old.replace("cpython-", "cpython-9"), old.replace("pool-", "carpool-"), "notes.txt"]
    for name in [old, old.removesuffix(".so") + ".json", *kept]:
        (folder / name).write_text("old")
    build_missing([LEVEL], lambda done, count: None)
    left = {path.name for path in folder.iterdir()}
    assert left >= {now, *kept}
    assert not left & {old, old.removesuffix(".so") + ".json"}


def test_two_processes_do_not_build_at_once(folder: Path) -> None:
    pytest.importorskip("fcntl")
    holder = [sys.executable, "-c", HOLD, str(folder / build.LOCK_FILE)]
    with subprocess.Popen(holder, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as other:
        assert other.stdout is not None
        assert other.stdout.readline() == "held\n"
        build_missing([LEVEL], lambda done, count: None, wait=False)
        assert machine.missing(LEVEL) == list(machine.PARTS)
        other.communicate("\n")
    build_missing([LEVEL], lambda done, count: None, wait=False)
    assert machine.missing(LEVEL) == []


def test_without_a_compiler_one_line_says_so(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("CC", "no-such-compiler")
    with pytest.raises(NoCompilerError, match="expected a C compiler"):
        build_missing([LEVEL], lambda done, count: None)
    assert machine.missing(LEVEL) == list(machine.PARTS)
