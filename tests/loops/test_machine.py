"""Machine code on disk: found by the state of its sources, checked before it is loaded, and set aside where it is damaged."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from torchcrf_scan.loops import machine

PART = "answer"  # the smallest
LEVEL = machine.processor_level()


@pytest.fixture
def copies(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder of its own, with a copy of one part."""
    built = next(path for folder in machine.folders() if (path := machine.library(folder, PART, LEVEL)).is_file())
    for path in (built, built.with_suffix(".json")):
        shutil.copy(path, tmp_path)
    monkeypatch.setattr(machine, "folders", lambda: [tmp_path])
    return tmp_path


def test_a_part_is_loaded_with_its_layouts(copies: Path) -> None:
    code = machine.load(PART, LEVEL)
    assert code is not None
    assert all(machine.part_of(name) == PART and callable(of.code) and of.layouts for name, of in code.items())
    assert machine.load(PART, "generic") is None
    assert machine.missing(LEVEL) == [part for part in machine.PARTS if part != PART]


@pytest.mark.parametrize("suffix", [".so", ".json"])
@pytest.mark.parametrize("kept", [0.0, 0.5, 1.0])
def test_a_damaged_file_is_set_aside(copies: Path, suffix: str, kept: float, caplog: pytest.LogCaptureFixture) -> None:
    path = machine.library(copies, PART, LEVEL).with_suffix(suffix)
    whole = path.read_bytes()
    part = whole[: int(kept * len(whole))]
    path.write_bytes(part if kept < 1 else whole[:40] + bytes([whole[40] ^ 255]) + whole[41:])
    assert machine.load(PART, LEVEL) is None
    assert [record.levelname for record in caplog.records] == ["WARNING"]
    assert "damaged and set aside" in caplog.text
    assert {path.name.rpartition(".")[2] for path in copies.iterdir()} == {"damaged"}
    assert PART in machine.missing(LEVEL)  # and is built anew
    assert machine.load(PART, LEVEL) is None
    assert len(caplog.records) == 1


def test_the_name_follows_the_sources(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    shutil.copytree(machine.PACKAGE, tmp_path / "copy", ignore=shutil.ignore_patterns("machine", "weights", "__pycache__"))
    monkeypatch.setattr(machine, "PACKAGE", tmp_path / "copy")
    before = {part: machine.digest_of(modules) for part, modules in machine.PARTS.items()}

    def changed(name: str) -> set[str]:
        path = tmp_path / "copy" / name
        source = path.read_bytes()
        path.write_bytes(source + b"# changed\n")
        found = {part for part, modules in machine.PARTS.items() if machine.digest_of(modules) != before[part]}
        path.write_bytes(source)
        return found

    assert len(set(before.values())) == len(before)
    assert changed("loops/rigid.py") == set(machine.PARTS)  # imported by all
    assert changed("prepare/extension.py") == set(machine.PARTS)
    assert changed("search/cold.py") == {"pool"}
    assert changed("cli.py") == changed("loops/machine.py") == set()


def test_another_copy_of_the_package_has_another_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    beside, cache = machine.folders()
    assert tmp_path in cache.parents
    monkeypatch.setattr(machine, "PACKAGE", tmp_path / "other")
    assert not {beside, cache} & set(machine.folders())


def test_where_nothing_can_be_written_beside_the_modules_it_is_the_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "file").write_text("no folder")
    monkeypatch.setattr(machine, "folders", lambda: [tmp_path / "file" / "machine", tmp_path / "cache"])
    assert machine.writable_folder() == tmp_path / "cache"
    monkeypatch.setattr(machine, "folders", lambda: [tmp_path / "file" / "machine"])
    with pytest.raises(OSError, match="expected a folder for machine code"):
        machine.writable_folder()


def test_it_is_looked_for_once_a_second_and_used_when_it_is_there(copies: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    now, looks = [10.0], []
    monkeypatch.setattr(machine.time, "monotonic", lambda: now[0])
    monkeypatch.setattr(machine, "load", lambda part, level: looks.append(part) or (found if part == PART else None))
    found = None
    store = machine.Store()
    name = "fast.uncertainty.motion_covariance"
    for _ in range(3):
        assert store.find(name) is None
    assert len(looks) == len(machine.PARTS)
    found, now[0] = {name: machine.Code(abs, ["float"])}, 10.9
    assert store.find(name) is None
    now[0] = 11.1
    assert store.find(name) == found[name]
    assert PART not in store.waiting


def test_the_compiler_can_be_switched_off() -> None:
    program = "from torchcrf_scan.loops.machine import STORE, find; print(find('fast.decode.certain'), STORE.background.process)"
    environment = {**os.environ, "NUMBA_DISABLE_JIT": "1", "TORCHCRF_SCAN_PREPARE": "1"}
    command = [sys.executable, "-c", program]
    done = subprocess.run(command, env=environment, cwd=machine.PACKAGE.parent, capture_output=True, text=True, check=True)
    assert done.stdout == "None None\n"
