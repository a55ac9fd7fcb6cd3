"""A command that serves the page, in a process of its own."""

import re
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from serving import ROOT, Serve

from torchcrf_scan.data.pair_file import write_pair
from torchcrf_scan.data.simulate import simulate_pairs
from torchcrf_scan.data.worlds import SimulatorConfig
from torchcrf_scan.scan import ScanPair


@pytest.fixture(scope="session")
def pairs() -> list[ScanPair]:
    """Three simulated pairs of a street, with their truth."""
    return simulate_pairs(SimulatorConfig(beams=181), 3, 1, 5)


@pytest.fixture(scope="session")
def pair_files(pairs: list[ScanPair], tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("to_annotate")
    for pair in pairs:
        write_pair(folder / f"{pair.name}.npz", pair)
    return folder


@contextmanager
def serving(pair_files: Path) -> Iterator[Serve]:
    """Begins to serve the pairs and returns the process and the page's address; ends what has begun."""
    pytest.importorskip("bokeh", reason="the library bokeh is not installed (extra `annotate`)")
    started: list[subprocess.Popen[str]] = []

    def start(output: Path, *options: str, files: Path = pair_files, full: Path | None = None) -> tuple[subprocess.Popen[str], str]:
        """full: a file; while it is there the disk is full."""
        program = ["-m", "torchcrf_scan"] if full is None else [str(Path(__file__).with_name("full_disk.py")), str(full)]
        command = [sys.executable, *program, "annotate", str(files), "--output", str(output), "--threads=1", *options]
        process = subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, text=True)
        started.append(process)
        assert process.stdout is not None
        found = re.search(r"http://127\.0\.0\.1:\d+/", process.stdout.readline())
        assert found is not None, process.poll()
        return process, found.group()

    yield start
    for process in started:
        process.kill()
        process.communicate()


@pytest.fixture
def serve(pair_files: Path) -> Iterator[Serve]:
    """To begin servers of one's own with."""
    with serving(pair_files) as start:
        yield start


@pytest.fixture(scope="session")
def address(pair_files: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """The page of a server that nothing is changed at."""
    with serving(pair_files) as start:
        yield start(tmp_path_factory.mktemp("served"))[1]
