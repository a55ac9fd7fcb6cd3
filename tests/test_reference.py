"""The pages of the reference: built from the docstrings without a warning, every public name is told there."""

import inspect
import re
import subprocess
import sys
from html import unescape
from pathlib import Path

import pytest

import torchcrf_scan

pytest.importorskip("pdoc", reason="the pages need pdoc (extra `docs`)")
README = Path(__file__).resolve().parents[1] / "README.md"


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> str:
    """The text of the page of the package, made by the command of the README."""
    folder = tmp_path_factory.mktemp("reference")
    (command,) = re.findall(r"python -m (pdoc .*?) -o ", README.read_text())
    subprocess.run([sys.executable, "-W", "error", "-m", *command.split(), "-o", str(folder)], check=True)
    html = (folder / "torchcrf_scan.html").read_text()
    return unescape(re.sub(r"<[^>]+>", "", html))


def test_every_public_name_is_told(page: str) -> None:
    for name in torchcrf_scan.__all__:
        kind = getattr(torchcrf_scan, name)
        if name.startswith("__"):
            continue
        assert inspect.getdoc(kind), name
        assert f"class {name}" in page, name
        for member, value in vars(kind).items():
            if not member.startswith("_") and callable(value):
                assert inspect.getdoc(value), f"{name}.{member}"
                assert f"def {member}" in page, f"{name}.{member}"
