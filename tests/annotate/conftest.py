"""A command that serves the page, in a process of its own."""

import re
import time
from collections.abc import Iterator
from contextlib import contextmanager
from multiprocessing.context import ForkServerProcess
from pathlib import Path

import pytest
from forked import begin
from serving import Serve, run_command

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
    started: list[ForkServerProcess] = []

    def start(output: Path, *options: str, files: Path = pair_files, full: Path | None = None) -> tuple[ForkServerProcess, str]:
        """full: a file; while it is there the disk is full."""
        told = output.with_name(f"{output.name}-{len(started)}.txt")
        process = begin(run_command, ["annotate", str(files), "--output", str(output), "--threads=1", *options], told, full)
        started.append(process)
        while True:
            found = re.search(r"http://127\.0\.0\.1:\d+/", told.read_text() if told.exists() else "")
            if found is not None:
                return process, found.group()
            assert process.is_alive(), process.exitcode
            time.sleep(0.05)

    yield start
    for process in started:
        process.kill()
        process.join()


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
