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
