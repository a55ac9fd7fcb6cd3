"""What the machine can do: its description, bandwidth and rates."""

from __future__ import annotations

import os
import platform
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import numpy as np
import torch

from torchcrf_scan.benchmark.timing import least_seconds, threads_kept

COPIED = 2**23  # numbers of a copy, far more than any cache holds
MATRIX = 512
VECTOR = 4096  # numbers that stay in the first cache
REPEATS = 15


@dataclass(frozen=True, slots=True)
class Rates:
    """Of one thread: bytes a second to and from memory; double-precision operations a second in matrices and in plain vectors."""

    bandwidth: float
    matrix: float
    vector: float


def describe_machine() -> dict[str, Any]:
    """Processor, cores and versions."""
    return {
        "processor": _processor(),
        "cpu_count": os.cpu_count(),
        "system": platform.platform(),
        "python": platform.python_version(),
        **{name: _version(name) for name in ("torch", "numpy", "numba")},
    }


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return platform.processor()
    return next((line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")), platform.processor())


def _version(name: str) -> str | None:
    try:
        return version(name)
    except PackageNotFoundError:
        return None


def measure_rates() -> Rates:
    """A large copy, a matrix product (multiply-adds count twice), and a product and a sum of short vectors."""
    with threads_kept():
        torch.set_num_threads(1)
        here, there = np.ones(COPIED), np.zeros(COPIED)
        copy = least_seconds(lambda: np.copyto(there, here), REPEATS)
        square = torch.ones(MATRIX, MATRIX, dtype=torch.float64)
        matrix = least_seconds(lambda: square @ square, REPEATS)
        a, b = np.ones(VECTOR), np.ones(VECTOR)

        def multiply_add() -> None:
            for _ in range(100):
                np.multiply(a, 0.5, out=b)
                np.add(a, b, out=b)

        vector = least_seconds(multiply_add, REPEATS)
    return Rates(2 * here.nbytes / copy, 2 * MATRIX**3 / matrix, 200 * VECTOR / vector)
