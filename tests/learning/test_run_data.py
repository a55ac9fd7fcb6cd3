"""What a run learns from and tests: recordings without annotation among it, and no sequence twice."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import pytest

from torchcrf_scan.data.pair_file import write_pair
from torchcrf_scan.data.simulate import simulate_pairs
from torchcrf_scan.data.worlds import SimulatorConfig
from torchcrf_scan.learning import run_data
from torchcrf_scan.learning.ranks import ALONE
from torchcrf_scan.learning.run_data import load
from torchcrf_scan.learning.settings import Config, DataConfig, GradientConfig
from torchcrf_scan.model import JointScanCRF
from torchcrf_scan.scan import ScanPair
from torchcrf_scan.stream.config import StreamConfig

PAIRS = [replace(pair, sequence="hall", dt=0.3) for pair in simulate_pairs(SimulatorConfig(beams=31), 3, 1, 5)]


@pytest.fixture
def asked(monkeypatch: pytest.MonkeyPatch) -> list[tuple[list[str], int, float]]:
    """Every call for labels of recordings, which gives the three pairs of the sequence `hall`."""
    calls: list[tuple[list[str], int, float]] = []

    def label(model: JointScanCRF, paths: Sequence[str], most: int, seconds: float) -> list[ScanPair]:
        calls.append((list(paths), most, seconds))
        return PAIRS

    monkeypatch.setattr(run_data, "label_recordings", label)
    return calls


def data(**settings: object) -> DataConfig:
    return DataConfig(**{"simulate_train": (), "simulate_test": (), "pairs": 2, "sequences": 2, **settings})  # type: ignore[arg-type]


def test_recordings_without_annotation_are_learned_from(asked: list[tuple[list[str], int, float]], tmp_path: Path) -> None:
    alone = load(Config(data=data(unlabelled="hall.log", unlabelled_pairs=7)), ALONE)
    assert asked == [(["hall.log"], 7, StreamConfig().lag)]
    assert (alone.train, alone.uncertain, alone.learned) == ([], PAIRS, PAIRS)
    assert alone.trained_on.sequences == ("hall",)
    for k, pair in enumerate(PAIRS):
        write_pair(tmp_path / f"{k}.npz", replace(pair, sequence="yard"))
    both = load(Config(data=data(train=str(tmp_path), unlabelled=("a.log", "b.log"))), ALONE)
    assert asked[1] == (["a.log", "b.log"], 60, pytest.approx(0.3))  # as far apart as the annotated ones
    assert len(both.learned) == 6
    assert both.trained_on.sequences == ("hall", "yard")


def test_their_sequences_are_not_tested(asked: list[tuple[list[str], int, float]], tmp_path: Path) -> None:
    write_pair(tmp_path / "test.npz", PAIRS[0])
    with pytest.raises(ValueError, match=r"data\.unlabelled: expected no sequence in both training and test pairs, got hall"):
        load(Config(data=data(test=str(tmp_path), unlabelled="hall.log")), ALONE)


def test_they_are_never_held_out(asked: list[tuple[list[str], int, float]]) -> None:
    config = Config(
        data=data(simulate_train=("street",), unlabelled="hall.log"),
        gradient=GradientConfig(objective="likelihood", validation=0.5),
    )
    found = load(config, ALONE)
    assert len(found.held_out) == len(found.train) == 1
    assert found.uncertain == PAIRS


def test_none_are_made_unasked_or_where_one_pair_is_overfitted(asked: list[tuple[list[str], int, float]]) -> None:
    assert load(Config(data=data(simulate_train=("street",))), ALONE).uncertain == []
    single = load(Config(data=data(simulate_train=("street",), unlabelled="hall.log"), overfit=True), ALONE)
    assert single.train == single.test
    assert single.uncertain == []
    assert asked == []


def test_nothing_to_learn_from_is_refused() -> None:
    with pytest.raises(ValueError, match=r"data\.simulate_train: expected a world at least"):
        load(Config(data=data()), ALONE)
