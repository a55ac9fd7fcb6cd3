"""Fixtures of all tests: fixed seeds, and the recordings that lie beside the repository but never in it."""

import gc
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, settings

LONG = {"test_export.py", "test_readme.py", "test_run_command.py"}
SHARED = Path(__file__).resolve().parents[2] / "shared"

if "PYTEST_XDIST_WORKER" in os.environ:  # one of as many processes as there are cores: it has one, and so have its programs
    torch.set_num_threads(1)
    os.environ |= {"OMP_NUM_THREADS": "1", "LOKY_MAX_CPU_COUNT": "1"}

os.environ["TORCHCRF_SCAN_PREPARE"] = "0"  # nothing is built behind the tests
gc.disable()  # while half a million objects are made that stay: modules and tests

settings.register_profile(  # the same examples in every run, and no failure because the machine is busy
    "repository", derandomize=True, max_examples=50, deadline=None, suppress_health_check=[HealthCheck.too_slow]
)
settings.load_profile("repository")


def pytest_sessionstart() -> None:
    """The machine code is built once, before the processes start that share the tests."""
    if "PYTEST_XDIST_WORKER" not in os.environ:
        subprocess.run([sys.executable, "-m", "torchcrf_scan.cli", "prepare"], cwd=Path(__file__).parents[1], check=True)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Files with tests of many seconds come first: nobody waits for them at the end, when the other tests are done."""
    items.sort(key=lambda item: item.path.name not in LONG)


def pytest_collection_finish() -> None:
    """From now on garbage is collected, but not searched for among what stays."""
    gc.freeze()
    gc.enable()


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
