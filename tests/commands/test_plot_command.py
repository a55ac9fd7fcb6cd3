"""`plot`: a picture with what there is."""

from functools import partial
from pathlib import Path

import pytest
from command_line import fail, run

from torchcrf_scan import PairPrediction, ScanPair
from torchcrf_scan.data.pair_file import write_prediction
from torchcrf_scan.viz import plots


def test_plot_draws_pair_prediction_and_model(
    pairs_dir: Path, predictions_dir: Path, model_dir: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(plots, "save_figure", partial(plots.save_figure, dpi=15))  # drawing takes time
    pair = pairs_dir / "sim_s0_000.npz"
    for name, options in {"a": [], "b": ["--prediction", predictions_dir / pair.name], "c": ["--model", model_dir]}.items():
        assert run("plot", pair, "--output", tmp_path / "new" / f"{name}.png", *options) == 0
    pictures = [(tmp_path / "new" / f"{name}.png").read_bytes() for name in "abc"]
    assert all(picture.startswith(b"\x89PNG") for picture in pictures)
    assert pictures[0] != pictures[1] == pictures[2]


def test_plot_draws_a_pair_of_a_log(
    log_file: Path, model_dir: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(plots, "save_figure", partial(plots.save_figure, dpi=15))
    picture = tmp_path / "a.png"
    assert run("plot", log_file, "--number=3", "--model", model_dir, "--output", picture) == 0
    assert capsys.readouterr().out == f"room_00003 drawn in {picture}\n"
    assert picture.read_bytes().startswith(b"\x89PNG")


def test_plot_asks_for_the_number_of_a_logs_pair(
    log_file: Path, pairs_dir: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    def message(*arguments: object) -> str:
        return fail(capsys, "plot", *arguments, "--output", tmp_path / "a.png")

    for options, got in (([], "None"), (["--number=4"], "4"), (["--number=-1"], "-1")):
        assert f"--number: expected which pair of {log_file}, 0 to 3, got {got}" in message(log_file, *options)
    assert "--number: expected none but with a log" in message(pairs_dir / "sim_s0_000.npz", "--number=0")
    assert "topic: expected none, as this is a pair file, got /scan" in message(pairs_dir / "sim_s0_000.npz", "--topic=/scan")
    assert "nowhere.log" in message(tmp_path / "nowhere.log", "--number=0")


def test_plot_names_the_bad_argument(
    pairs_dir: Path,
    predictions_dir: Path,
    tmp_path: Path,
    moving_pair: tuple[ScanPair, PairPrediction],
    capsys: pytest.CaptureFixture[str],
) -> None:
    pair = pairs_dir / "sim_s0_000.npz"
    picture = tmp_path / "a.png"
    assert "--output: expected a name ending in .png" in fail(capsys, "plot", pair, "--output", tmp_path / "a.pdf")
    both = ["--prediction", predictions_dir / pair.name, "--model", "simulated"]
    assert "--prediction" in fail(capsys, "plot", pair, "--output", picture, *both)
    assert "nowhere.npz" in fail(capsys, "plot", tmp_path / "nowhere.npz", "--output", picture)
    write_prediction(tmp_path / "p.npz", moving_pair[1])
    assert "association: expected" in fail(capsys, "plot", pair, "--output", picture, "--prediction", tmp_path / "p.npz")
    assert not picture.exists()
