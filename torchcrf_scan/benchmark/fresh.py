"""Measurements in a fresh process: the first call after the import, and the peak of memory."""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from torchcrf_scan.benchmark.plan import with_backend
from torchcrf_scan.benchmark.scenes import in_mode
from torchcrf_scan.data.pair_file import read_pair, write_pair
from torchcrf_scan.errors import TorchCRFScanError
from torchcrf_scan.model import JointScanCRF
from torchcrf_scan.scan import ScanPair

STATUS = "/proc/self/status"
CHILD = f"""
import sys, torch
before = open({STATUS!r}).read()
from torchcrf_scan.benchmark.fresh import tell
tell(before, *sys.argv[1:])
"""


def ask_fresh_process(model: str, backend: str, mode: str, pairs: Sequence[ScanPair]) -> dict[str, Any]:
    """Matches annotated pairs as one batch in a process of its own.

    Returns:
        `first_call_ms`, of the first pair alone; `peak_mb`, peak memory in MB above that of the interpreter with torch loaded.

    Raises:
        TorchCRFScanError: the process fails.
    """
    with tempfile.TemporaryDirectory() as folder:
        files = [Path(folder) / f"{k}.npz" for k in range(len(pairs))]
        for file, pair in zip(files, pairs, strict=True):
            write_pair(file, pair)
        command = [sys.executable, "-c", CHILD, model, backend, mode, *map(str, files)]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        raise TorchCRFScanError(f"fresh process: expected an answer, got {done.stderr.strip().splitlines()[-1:]}")
    told: dict[str, Any] = json.loads(done.stdout)
    return told


def tell(before: str, model: str, backend: str, mode: str, *files: str) -> None:
    """Runs in the child: prints the results of `ask_fresh_process`. before: the process's status with torch loaded."""
    network = with_backend(JointScanCRF.from_pretrained(model), backend)
    pairs = in_mode([read_pair(file) for file in files], mode)
    began = time.perf_counter()
    network.match_pairs(pairs[:1])
    first = time.perf_counter() - began
    network.match_pairs(pairs, batch_size=len(pairs))
    peak = high_water_mark(Path(STATUS).read_text()) - high_water_mark(before)
    print(json.dumps({"first_call_ms": 1e3 * first, "peak_mb": peak}))


def high_water_mark(status: str) -> float:
    """Peak memory of the process in MB, from its Linux status file."""
    kilobytes = next(line.split()[1] for line in status.splitlines() if line.startswith("VmHWM:"))
    return int(kilobytes) / 1024
