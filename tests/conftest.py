"""Fixtures of all tests: fixed seeds, and the recordings that lie beside the repository but never in it."""

from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, settings

SHARED = Path(__file__).resolve().parents[2] / "shared"

settings.register_profile(  # the same examples in every run, and no failure because the machine is busy
    "repository", derandomize=True, max_examples=50, deadline=None, suppress_health_check=[HealthCheck.too_slow]
)
settings.load_profile("repository")


@pytest.fixture(autouse=True)
def seeded() -> None:
    """The same global random state for every test."""
    torch.manual_seed(0)
    np.random.seed(0)


@pytest.fixture(scope="session")
def real_pairs_dir() -> Path:
    """The folder of annotated real pairs."""
    folder = SHARED / "data" / "pairs"
    if not any(folder.glob("*.npz")):
        pytest.skip(f"needs the real pairs, which are not part of the repository: nothing in {folder}")
    return folder
