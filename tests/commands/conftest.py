"""Simulated pairs, a model and its predictions, made once by the commands themselves; a log and a pair made by hand."""

import gzip
from pathlib import Path

import numpy as np
import pytest
from forked import CONTEXT

from torchcrf_scan import JointScanCRF, ModelConfig, PairPrediction, Scan, ScanPair
from torchcrf_scan.cli import main
from torchcrf_scan.commands import apart
from torchcrf_scan.data.carmen import bearings_of


@pytest.fixture(scope="session")
def pairs_dir(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Four simulated pairs of two sequences."""
    folder = tmp_path_factory.mktemp("simulated") / "pairs"
    assert main(["simulate", "--output", str(folder), "--pairs=4", "--sequences=2", "--seed=3", "--simulator.beams=61"]) == 0
    return folder


@pytest.fixture(scope="session")
def model_dir(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("model")
    JointScanCRF(ModelConfig()).save_pretrained(folder)
    return folder


@pytest.fixture(scope="session")
def predictions_dir(pairs_dir: Path, model_dir: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The predictions of the four pairs."""
    folder = tmp_path_factory.mktemp("matched") / "predictions"
    assert main(["match", str(pairs_dir), "--output", str(folder), "--model", str(model_dir), "--threads=1"]) == 0
    return folder


@pytest.fixture(scope="session")
def log_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A log of five readings, 0.1 m apart along a room 8 m wide, one of its 60 beams without return."""
    bearings = bearings_of(60)
    lines = []
    for k in range(5):
        ranges = np.minimum(4 / np.maximum(np.abs(np.sin(bearings)), 1e-6), (12 - 0.1 * k) / np.maximum(np.cos(bearings), 1e-6))
        ranges[7] = 81.9
        lines.append(f"FLASER 60 {' '.join(f'{value:.3f}' for value in ranges)} {0.1 * k} 0 0 {0.1 * k} 0 0 {k} host {k}\n")
    file = tmp_path_factory.mktemp("logs") / "room.log.gz"
    file.write_bytes(gzip.compress("".join(lines).encode()))
    return file


@pytest.fixture(scope="session")
def real_logs_dir() -> Path:
    """The folder of recorded logs."""
    folder = Path(__file__).resolve().parents[3] / "shared" / "data" / "logs"
    if not any(folder.glob("*.log.gz")):
        pytest.skip(f"needs the recorded logs, which are not part of the repository: nothing in {folder}")
    return folder


@pytest.fixture
def fast_start(monkeypatch: pytest.MonkeyPatch) -> None:
    """Outputs apart are made in processes that begin at once; to begin one as users do takes seconds."""
    monkeypatch.setattr(apart.multiprocessing, "get_context", lambda kind: CONTEXT)


@pytest.fixture
def moving_pair() -> tuple[ScanPair, PairPrediction]:
    """The sensor goes 1 m ahead while turning by 90 degrees; points 0 and 1 stand still, 2 and 3 go 0.2 m to the left in 0.1 s."""
    scan = Scan.from_ranges([5.0, 5.0, 5.0, 5.0, np.nan], [-0.4, -0.2, 0.0, 0.2, 0.3])
    background, mover = [-np.pi / 2, 0.0, 1.0], [-np.pi / 2, 0.2, 1.0]
    ones = np.ones(5)
    labels = np.array([0, 0, 1, 1, -1])
    return ScanPair(scan, scan, 0.1, name="corner"), PairPrediction(labels, labels, np.array([background, mover]), ones, ones, True)
