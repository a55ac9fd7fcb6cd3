"""Damaged files, for minutes: `pytest -m fuzz`. FUZZ_SECONDS: of processor time, for recorded files; FUZZ_RUNS: of every reader."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

KINDS = ("pair", "prediction", "carmen", "csv", "ros1", "ros2", "mcap", "poses", "tracks", "numbers", "config")
WORKER = Path(__file__).with_name("mutants.py")


@pytest.mark.fuzz
@pytest.mark.skipif(sys.platform != "linux", reason="limits its memory as Linux counts it")
def test_recorded_files_with_something_wrong_are_answered_or_refused(real_pairs_dir: Path, tmp_path: Path) -> None:
    seconds, seed = os.environ.get("FUZZ_SECONDS", "600"), os.environ.get("FUZZ_SEED", "0")
    folder = tmp_path / "mutants"
    folder.mkdir()
    command = [sys.executable, WORKER, real_pairs_dir.parent, folder, seed, seconds]
    environment = os.environ | {"OMP_NUM_THREADS": "1", "PYTHONPATH": os.pathsep.join(sys.path)}
    done = subprocess.run(command, capture_output=True, text=True, env=environment, cwd=tmp_path, check=False)
    assert done.returncode == 0, f"{sorted(folder.iterdir())}\n{done.stderr[-3000:]}"
    counts = json.loads(done.stdout.splitlines()[-1])
    print(counts)
    assert {outcome.split()[1] for outcome in counts} == {"answered", "refused"}
    assert list(tmp_path.iterdir()) == [folder]
    assert not list(folder.iterdir())


@pytest.mark.fuzz
@pytest.mark.parametrize("kind", KINDS)
def test_readers_answer_or_refuse_what_reaches_new_lines(kind: str, tmp_path: Path) -> None:
    pytest.importorskip("atheris", reason="atheris, which finds what reaches new lines, is not installed")
    runs, seed = os.environ.get("FUZZ_RUNS", "10000"), os.environ.get("FUZZ_SEED", "1")
    command = [sys.executable, WORKER.with_name("covered.py"), kind, tmp_path / "covered", f"-runs={runs}", f"-seed={seed}"]
    environment = os.environ | {"OMP_NUM_THREADS": "1", "TORCHCRF_SCAN_PREPARE": "0", "PYTHONPATH": os.pathsep.join(sys.path)}
    done = subprocess.run(command, capture_output=True, text=True, env=environment, cwd=tmp_path, check=False)
    assert done.returncode == 0, done.stderr[-5000:]
    assert f"Done {runs} runs" in done.stderr
