"""`match`: a file and a line for every pair, whatever happens to the others."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from command_line import contents, fail, run

from torchcrf_scan import JointScanCRF, PairPrediction, ScanPair
from torchcrf_scan.commands.match import describe, mover_speeds
from torchcrf_scan.data.dataset import PairFiles
from torchcrf_scan.data.pair_file import read_pair, read_prediction


def test_match_writes_what_the_model_says(pairs_dir: Path, predictions_dir: Path, model_dir: Path) -> None:
    pairs = PairFiles(pairs_dir)
    assert sorted(path.name for path in predictions_dir.iterdir()) == [path.name for path in pairs.paths]
    for pair, expected in zip(pairs, JointScanCRF.from_pretrained(model_dir).match_pairs(list(pairs)), strict=True):
        found = read_prediction(predictions_dir / f"{pair.name}.npz")
        assert (found.association == expected.association).all()
        assert (found.cluster == expected.cluster).all()
        assert np.allclose(found.motions, expected.motions, atol=1e-6)


def test_match_takes_files_and_patterns_once_each(
    pairs_dir: Path, model_dir: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    other_spelling = pairs_dir / ".." / pairs_dir.name / "sim_s0_000.npz"
    files = [pairs_dir / "sim_s0_000.npz", other_spelling, f"{pairs_dir}/*s1_001.npz"]
    assert run("match", *files, "--output", tmp_path, "--model", model_dir, "--candidates=4") == 0
    out = capsys.readouterr().out.splitlines()
    assert [line.split(":")[0] for line in out] == ["sim_s0_000", "sim_s1_001", f"2 of 2 pairs matched, predictions in {tmp_path}"]
    assert "sensor" in out[0]
    assert sorted(path.name for path in tmp_path.iterdir()) == ["sim_s0_000.npz", "sim_s1_001.npz"]


def test_match_refuses_two_files_of_one_name(pairs_dir: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    copy = tmp_path / "sim_s0_000.npz"
    copy.write_bytes((pairs_dir / copy.name).read_bytes())
    message = fail(capsys, "match", pairs_dir, copy, "--output", tmp_path / "out")
    assert str(copy) in message
    assert not (tmp_path / "out").exists()


def test_match_never_replaces_a_pair(pairs_dir: Path, model_dir: Path, capsys: pytest.CaptureFixture[str]) -> None:
    before = contents(pairs_dir)
    assert "nothing but predictions" in fail(capsys, "match", pairs_dir, "--output", pairs_dir, "--model", model_dir)
    assert contents(pairs_dir) == before


def test_match_again_replaces_predictions(pairs_dir: Path, model_dir: Path, tmp_path: Path) -> None:
    for candidates in (1, 8):
        options = ["--output", tmp_path, "--model", model_dir, f"--candidates={candidates}"]
        assert run("match", pairs_dir / "sim_s0_000.npz", *options) == 0
    pair = read_pair(pairs_dir / "sim_s0_000.npz")
    expected = JointScanCRF.from_pretrained(model_dir).match_pairs([pair])[0]
    assert (read_prediction(tmp_path / "sim_s0_000.npz").association == expected.association).all()


def test_broken_files_do_not_lose_the_others(
    pairs_dir: Path, model_dir: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    broken, empty = tmp_path / "a_broken.npz", tmp_path / "z_empty.npz"
    broken.write_bytes((pairs_dir / "sim_s0_000.npz").read_bytes()[:300])
    empty.touch()
    assert run("match", broken, pairs_dir / "sim_s0_000.npz", empty, "--output", tmp_path / "out", "--model", model_dir) == 1
    out, err = capsys.readouterr()
    assert "1 of 3 pairs matched" in out
    assert [str(path) in line for path, line in zip((broken, empty), err.splitlines(), strict=True)] == [True, True]
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["sim_s0_000.npz"]


def test_a_pair_that_the_model_cannot_take_does_not_lose_the_others(
    pairs_dir: Path, model_dir: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = JointScanCRF.match_pairs

    def picky(model: JointScanCRF, pairs: list[ScanPair]) -> list[PairPrediction]:
        if any(pair.name == "sim_s0_001" for pair in pairs):
            raise RuntimeError("too large")
        return whole(model, pairs)

    monkeypatch.setattr(JointScanCRF, "match_pairs", picky)
    files = [pairs_dir / f"sim_s0_00{i}.npz" for i in (0, 1)]
    assert run("match", *files, "--output", tmp_path, "--model", model_dir) == 1
    assert f"{files[1]}: too large" in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["sim_s0_000.npz"]


def test_match_names_the_bad_argument(pairs_dir: Path, model_dir: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    def message(*options: object) -> str:
        return fail(capsys, "match", pairs_dir, "--output", tmp_path / "out", *options)

    assert "nowhere" in fail(capsys, "match", tmp_path / "nowhere", "--output", tmp_path / "out")
    assert "--model no_such_model" in message("--model", "no_such_model")
    assert "--threads: expected at least 1" in message("--model", model_dir, "--threads=0")
    assert "candidates: expected 0 or more" in message("--model", model_dir, "--candidates=-1")
    assert "--device: expected" in message("--model", model_dir, "--device=abacus")
    assert not (tmp_path / "out").exists()


def test_speeds_are_over_ground(moving_pair: tuple[ScanPair, PairPrediction]) -> None:
    pair, prediction = moving_pair
    assert mover_speeds(pair, prediction) == pytest.approx([2.0])


def test_a_pair_is_described_in_one_line(moving_pair: tuple[ScanPair, PairPrediction]) -> None:
    pair, prediction = moving_pair
    moving = "corner: sensor +1.00 m ahead, +0.00 m left, +90.0 deg; 1 moving: 2.00 m/s (2 points); 0 of 4 points outliers"
    assert describe(pair, prediction) == moving
    lost = np.full(5, -1)
    still = replace(prediction, association=lost, cluster=lost, motions=np.zeros((1, 3)), converged=False)
    expected = "corner: sensor +0.00 m ahead, +0.00 m left, +0.0 deg; nothing moving; 4 of 4 points outliers; not converged"
    assert describe(pair, still) == expected
