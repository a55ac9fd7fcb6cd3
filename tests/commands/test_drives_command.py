"""`torchcrf-scan drives` on a short drive."""

from __future__ import annotations

import json
import re
import sys
from pathlib import Path

import pytest
from command_line import fail, run

pytest.importorskip("trackeval", reason="needs trackeval (extra tracking)")


def test_a_short_drive_is_scored(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    code = run("drives", "--worlds", "cars_240", "--scans", "12", "--count", "1", "--json", str(tmp_path / "new" / "rows.json"))
    assert code == 0
    header, line, row = capsys.readouterr().out.splitlines()
    assert header.startswith("| world | movers | found by pairs, % |")
    assert row.startswith("| cars_240 |")
    assert header.count("|") == line.count("|") == row.count("|")
    values = json.loads((tmp_path / "new" / "rows.json").read_text())["cars_240"]
    assert values["scans_per_second"] > 0
    assert 0 <= values["false_moving"] < 20
    assert 0 <= values["hota"] <= 100


def test_without_trackeval_it_says_so_at_once(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setitem(sys.modules, "trackeval", None)
    assert "expected the library trackeval, which scores tracks (extra `tracking`), got" in fail(capsys, "drives")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--worlds", "[street,moon]"], "--worlds: expected some of street, .* got moon"),
        (["--worlds", "moon"], "--worlds: expected some of street, .* got moon$"),
        (["--worlds", "[]"], "--worlds: expected some of street, .* got none$"),
        (["--scans", "1"], "--scans: expected at least 2, got 1"),
        (["--count", "0"], "--count: expected at least 1, got 0"),
    ],
)
def test_wrong_options_are_named(arguments: list[str], message: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert run("drives", *arguments) == 1
    assert re.search(message, capsys.readouterr().err)
