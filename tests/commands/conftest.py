"""Simulated pairs, a model and its predictions, made once by the commands themselves, and a pair made by hand."""

from pathlib import Path

import numpy as np
import pytest

from torchcrf_scan import JointScanCRF, ModelConfig, PairPrediction, Scan, ScanPair
from torchcrf_scan.cli import main


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


@pytest.fixture
def moving_pair() -> tuple[ScanPair, PairPrediction]:
    """The sensor goes 1 m ahead while turning by 90 degrees; points 0 and 1 stand still, 2 and 3 go 0.2 m to the left in 0.1 s."""
    scan = Scan.from_ranges([5.0, 5.0, 5.0, 5.0, np.nan], [-0.4, -0.2, 0.0, 0.2, 0.3])
    background, mover = [-np.pi / 2, 0.0, 1.0], [-np.pi / 2, 0.2, 1.0]
    ones = np.ones(5)
    labels = np.array([0, 0, 1, 1, -1])
    return ScanPair(scan, scan, 0.1, name="corner"), PairPrediction(labels, labels, np.array([background, mover]), ones, ones, True)
