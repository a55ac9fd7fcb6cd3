"""`evaluate --rounds`: the course of the joint objective over the rounds."""

import json
from dataclasses import replace
from pathlib import Path

import pytest
from command_line import fail, run

from torchcrf_scan import JointScanCRF, ModelConfig
from torchcrf_scan.commands.rounds import watch
from torchcrf_scan.data.pair_file import read_pair


def test_the_course_is_printed_and_written(pairs_dir: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    figures = tmp_path / "figures.json"
    assert run("evaluate", pairs_dir, "--rounds", "--json", figures) == 0
    out = capsys.readouterr().out
    found = json.loads(figures.read_text())["rounds"]
    assert len(found) == 4
    for title in ("The joint objective by round", "The joint objective by step", "Rounds", "Bound minus score, the largest"):
        assert f"**{title}**" in out
    for name, of in found.items():
        assert f"| {name} | {len(of['clustering'])} |" in out
        assert max(abs(gap) for both in of["gaps"] for gap in both) < 1e-3
        assert abs(of["lattice_gap"]) < 1e-3
        assert of["lattice_gain"] > -1e-3  # the best labels of both chains, so no other ones have a larger score


def test_the_rounds_watched_are_those_of_the_answer(pairs_dir: Path) -> None:
    model = JointScanCRF.from_pretrained(iterations=2)
    pairs = [read_pair(path) for path in sorted(pairs_dir.glob("*.npz"))]
    courses, answers = [watch(model, pair) for pair in pairs], model.match_pairs(pairs)
    assert [of.has_settled for of in courses] == [answer.converged for answer in answers]
    assert {len(of.scores) for of in courses} <= {1, 2}


@pytest.mark.parametrize(
    "config",
    [
        ModelConfig(coupling="lattice"),
        ModelConfig(chains="matching"),
        ModelConfig(inference=replace(ModelConfig().inference, iterations=0)),
    ],
)
def test_models_without_an_alternation_are_refused(
    config: ModelConfig, pairs_dir: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    JointScanCRF(config).save_pretrained(tmp_path)
    assert "--rounds: expected a model with rounds" in fail(capsys, "evaluate", pairs_dir, "--rounds", "--model", tmp_path)


def test_other_methods_have_no_rounds(pairs_dir: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert "--rounds: expected --method joint" in fail(capsys, "evaluate", pairs_dir, "--rounds", "--method", "icp")
