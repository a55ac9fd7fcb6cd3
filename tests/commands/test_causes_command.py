"""`evaluate --causes`: tables, figures and pictures of where wrong points come from."""

import json
from pathlib import Path

import pytest
from command_line import fail, run


def test_causes_are_printed_written_and_drawn(pairs_dir: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder, figures = tmp_path / "report", tmp_path / "figures.json"
    assert run("evaluate", pairs_dir, "--causes", "--worst", 2, "--output", folder, "--json", figures) == 0
    out = capsys.readouterr().out
    report = (folder / "causes.md").read_text()
    assert out.endswith(report)
    for title in ("Where wrong points come from", "What became of the movers", "What oracles would save", "The worst pairs"):
        assert f"**{title}**" in report
    found = json.loads(figures.read_text())
    causes = found["causes"]
    assert causes["all"]["wrong"] == sum(causes["all"]["causes"].values()) > 0
    assert len(causes["pairs"]) == 4
    assert causes["all"]["fates"]["found"] == round(found["all"]["movers_found"] * found["all"]["movers"] / 100)
    worst = sorted(causes["pairs"], key=lambda name: -causes["pairs"][name]["wrong"])[:2]
    pictures = sorted(path.name for path in folder.glob("*.png"))
    assert pictures == [f"01_{worst[0]}.png", f"02_{worst[1]}.png"]


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (("--output", "somewhere"), "--output: expected none without --causes"),
        (("--causes", "--worst", -1), "--worst: expected a number of pairs, 0 or more, got -1"),
        (("--causes", "--method", "icp"), "--causes: expected --method joint"),
        (("--causes", "--frame_offset", 1.0), "--causes: expected --method joint"),
    ],
)
def test_options_that_do_not_go_together(
    pairs_dir: Path, options: tuple[object, ...], words: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert words in fail(capsys, "evaluate", pairs_dir, *options)
