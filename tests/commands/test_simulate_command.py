"""`simulate`: the files it writes, and those it leaves alone."""

from pathlib import Path

import pytest
from command_line import contents, fail, run

from torchcrf_scan.data.dataset import PairFiles


def test_same_seed_same_bytes(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for name, seed in (("a", 1), ("b", 1), ("c", 2)):
        assert (
            run("simulate", "--output", tmp_path / name, "--pairs=2", "--sequences=1", f"--seed={seed}", "--simulator.beams=31")
            == 0
        )
    assert contents(tmp_path / "a") == contents(tmp_path / "b") != contents(tmp_path / "c")
    assert capsys.readouterr().out.startswith("2 pairs of 1 sequences in ")
    assert run("simulate", "--output", tmp_path / "c", "--pairs=2", "--sequences=1", "--seed=1", "--simulator.beams=31") == 0
    assert contents(tmp_path / "c") == contents(tmp_path / "a")


def test_simulator_options_arrive(tmp_path: Path) -> None:
    options = ["--pairs=1", "--sequences=1", "--simulator.beams=31", "--simulator.dt=0.5", "--simulator.range_max=30"]
    assert run("simulate", "--output", tmp_path, *options) == 0
    pair = PairFiles(tmp_path)[0]
    assert (pair.dt, pair.source.range_max) == (0.5, 30.0)
    assert len(pair.source) <= 31
    assert pair.annotation is not None


def test_simulate_never_mixes_with_other_files(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "mine.npz").write_bytes(b"precious")
    message = fail(capsys, "simulate", "--output", tmp_path, "--pairs=1", "--sequences=1", "--simulator.beams=11")
    assert "mine.npz" in message
    assert contents(tmp_path) == {"mine.npz": b"precious"}


@pytest.mark.parametrize(("option", "name"), [("--pairs=0", "pairs"), ("--simulator.scene=moon", "scene"), ("--seed=-1", "seed")])
def test_simulate_names_the_bad_value(tmp_path: Path, option: str, name: str, capsys: pytest.CaptureFixture[str]) -> None:
    message = fail(capsys, "simulate", "--output", tmp_path, option)
    assert f"{name}: expected" in message
    assert "got" in message
