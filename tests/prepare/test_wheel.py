"""The wheel's tag: for every platform, or for this one where machine code is in it; and what sources are packed."""

from pathlib import Path

import pytest
from setuptools import Distribution

from torchcrf_scan.prepare.wheel import MachineWheel, Sources


@pytest.mark.parametrize("folder", [None, "torchcrf_scan/machine", "build/lib/torchcrf_scan/machine"])
def test_a_wheel_with_machine_code_is_for_one_platform(folder: str | None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    if folder is not None:
        (tmp_path / folder).mkdir(parents=True)
        (tmp_path / folder / "pool-0-x86-64-v2.json").write_text("{}")
    command = MachineWheel(Distribution({"name": "torchcrf-scan", "version": "1"}))
    command.ensure_finalized()
    tag = command.get_tag()
    assert (tag == ("py3", "none", "any")) == (folder is None)


def test_sources_hold_neither_machine_code_nor_tests(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    files = ["pyproject.toml", "tests/test_model.py", "torchcrf_scan/machine/pool-0.so", "torchcrf_scan/model.py"]
    for file in files:
        (tmp_path / file).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / file).touch()
    Sources(Distribution({"name": "torchcrf-scan", "version": "1"})).make_release_tree("packed", files)
    packed = {str(path.relative_to("packed")) for path in Path("packed").rglob("*") if path.is_file()}
    assert packed >= {"pyproject.toml", "torchcrf_scan/model.py"}
    assert not [file for file in packed if "machine" in file or "tests" in file]
