"""Bad input has one family of errors, which is a `ValueError`."""

import ast
from pathlib import Path

import pytest

import torchcrf_scan
from torchcrf_scan import JointScanCRF, Scan, TorchCRFScanError
from torchcrf_scan.data.formats import read_scans
from torchcrf_scan.data.pair_file import read_pair

PACKAGE = Path(torchcrf_scan.__file__).parent
SOURCES = sorted(PACKAGE.rglob("*.py"))


def test_no_module_makes_a_bare_value_error() -> None:
    assert len(SOURCES) > 300
    calls = [(path, node) for path in SOURCES for node in ast.walk(ast.parse(path.read_text())) if isinstance(node, ast.Call)]
    bare = [(path, node.lineno) for path, node in calls if getattr(node.func, "id", "") == "ValueError"]
    assert bare == []


def test_every_door_has_the_same_family(tmp_path: Path) -> None:
    (tmp_path / "text").write_text("no recording\n")
    doors = (
        lambda: Scan.from_ranges([1.0]),
        lambda: torchcrf_scan.InferenceConfig(clusters=1),
        lambda: JointScanCRF.from_pretrained(tmp_path),
        lambda: read_pair(tmp_path / "text"),
        lambda: list(read_scans(tmp_path / "text")),
    )
    for door in doors:
        with pytest.raises(TorchCRFScanError, match="expected"):
            door()
    assert issubclass(TorchCRFScanError, ValueError)
