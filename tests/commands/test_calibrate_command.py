"""`calibrate`: a table of what each part gains, and a model that the other commands load."""

from pathlib import Path

import numpy as np
import pytest
from command_line import fail, run

from torchcrf_scan import JointScanCRF, ModelConfig
from torchcrf_scan.data.dataset import PairFiles
from torchcrf_scan.data.pair_file import read_prediction
from torchcrf_scan.learning.leaks import TrainedOn


def test_calibrate_writes_a_model_that_match_loads(pairs_dir: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    made, found = tmp_path / "own", tmp_path / "found"
    JointScanCRF(ModelConfig()).save_pretrained(made)  # an earlier model, which is replaced
    assert run("calibrate", pairs_dir, "--output", made, "--model", "simulated", "--threads=1") == 0
    assert JointScanCRF.from_pretrained(made).config == JointScanCRF.from_pretrained("simulated").config
    table = capsys.readouterr().out
    assert all(f"| {part} |" in table for part in ("outlier distance", "scales", "movers' worth", "confidences"))
    assert "4 pairs left out in turn" in table
    assert run("match", pairs_dir, "--output", found, "--model", made, "--threads=1") == 0
    pair = next(iter(PairFiles(pairs_dir)))
    expected = JointScanCRF.from_pretrained(made).match_pairs([pair])[0]
    assert {one.sequence for one in PairFiles(pairs_dir)} < set(TrainedOn.of_model(str(made)).sequences)
    np.testing.assert_array_equal(read_prediction(found / f"{pair.name}.npz").association, expected.association)


def test_calibrate_replaces_nothing_but_models(pairs_dir: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "notes.txt").write_text("mine")
    assert "expected a new folder or one of a saved model" in fail(capsys, "calibrate", pairs_dir, "--output", tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["notes.txt"]


def test_calibrate_needs_two_annotated_pairs(pairs_dir: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    one = pairs_dir / "sim_s0_000.npz"
    assert "expected two or more annotated pairs, got 1" in fail(capsys, "calibrate", one, "--output", tmp_path / "m")


@pytest.mark.parametrize("command", ["match", "evaluate"])
def test_the_distance_of_outliers_is_an_option(
    command: str, pairs_dir: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    where = ["--output", tmp_path / "far"] if command == "match" else []
    told = []
    for metres in ("1e-6", "1e6"):
        assert run(command, pairs_dir, *where, "--model=simulated", f"--outlier_distance={metres}") == 0
        told.append(capsys.readouterr().out)
    assert told[0] != told[1]
    for wrong in ("-1", "0"):
        message = fail(capsys, command, pairs_dir, *where, "--model=simulated", f"--outlier_distance={wrong}")
        assert "--outlier_distance: expected nothing or a finite number above 0" in message
