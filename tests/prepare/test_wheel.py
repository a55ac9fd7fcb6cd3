"""The wheel's tag: for every platform, or for this one where machine code is in it."""

from pathlib import Path

import pytest
from setuptools import Distribution

from torchcrf_scan.prepare.wheel import MachineWheel


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
