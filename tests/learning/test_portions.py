"""Batches for first-order training: the same from workers as from here."""

import os
import subprocess
import sys
import time
from pathlib import Path

import pytest
import small_run
import torch
from support import assert_close

from torchcrf_scan.batch import ScanPairBatch
from torchcrf_scan.learning.objectives import known_nodes, start_of
from torchcrf_scan.learning.portions import Collate, Portion, as_portion, load_portions
from torchcrf_scan.learning.settings import AugmentConfig, GradientConfig
from torchcrf_scan.learning.stream import PairStream, Parts
from torchcrf_scan.model import JointScanCRF

MOVED = AugmentConfig(mirror=0.0, dropout=0.0, noise=0.0, frame_rotation=0.3, frame_translation=0.1)


def stream(**settings: object) -> PairStream:
    return PairStream(GradientConfig(fresh=0.0, **settings), small_run.small_pairs()[0])  # type: ignore[arg-type]


def test_workers_bring_what_would_be_made_here() -> None:
    parts = Parts(4, 2, 0, 2)
    collate = Collate(disturbance=0.5, seed=3, surveys=True)
    here, there = (list(load_portions(stream(), parts, collate, workers)) for workers in (0, 1))
    assert len(here) == len(there) == 4
    for one, other in zip(here, there, strict=True):
        assert torch.equal(one.batch.source, other.batch.source)
        assert torch.equal(one.batch.target, other.batch.target)
        assert one.batch.truth is not None
        assert other.batch.truth is not None
        assert torch.equal(one.batch.truth.association, other.batch.truth.association)
        model = JointScanCRF(small_run.small_config().model)
        assert torch.equal(start_of(model, one).motions, start_of(model, other).motions)


def test_frames_are_displaced_with_their_truth() -> None:
    moved = stream(augment=MOVED)
    samples = [moved[k] for k in range(3)]
    batch = Collate()(samples).batch
    plain = ScanPairBatch.collate([sample.pair for sample in samples])
    offset = torch.stack([torch.from_numpy(sample.offset) for sample in samples]).float()
    expected = plain.displaced(offset)
    assert expected.truth is not None
    assert batch.truth is not None
    assert_close(batch.target, expected.target)
    assert_close(batch.truth.motions, expected.truth.motions)
    assert not torch.equal(batch.target, plain.target)


def test_disturbance_depends_on_the_first_index_alone() -> None:
    plain = stream()
    samples = [plain[k] for k in (4, 5)]
    once, again = (Collate(disturbance=0.7)(samples).batch.source for _ in range(2))
    assert torch.equal(once, again)
    assert not torch.equal(once, Collate()(samples).batch.source)
    assert not torch.equal(once, Collate(disturbance=0.7, seed=1)(samples).batch.source)


def test_surveys_lead_to_the_start_that_the_model_would_find() -> None:
    model = JointScanCRF(small_run.small_config().model)
    portion = as_portion(small_run.small_pairs()[0][:2])
    surveyed, looked_for = start_of(model, portion), start_of(model, Portion(portion.batch))
    assert_close(surveyed.motions, looked_for.motions)
    assert torch.equal(surveyed.active, looked_for.active)
    assert torch.equal(surveyed.association, looked_for.association)


def test_known_nodes_are_counted() -> None:
    portion = as_portion(small_run.small_pairs()[0])
    truth = portion.batch.truth
    assert truth is not None
    assert int(known_nodes(portion.batch)) == int(truth.known.sum()) > 0
    with pytest.raises(AssertionError):
        known_nodes(portion.batch.without_truth())


def test_a_worker_ends_with_its_parent() -> None:
    """A process starts a child that watches it, tells its number and is killed; the child goes too."""
    watch = "from torchcrf_scan.learning.portions import calm_worker; calm_worker(0); print(1, flush=True)"
    child = f"import time; {watch}; time.sleep(300)"
    program = (
        "import subprocess, sys, time\n"
        f"child = subprocess.Popen([sys.executable, '-c', {child!r}], stdout=subprocess.PIPE)\n"
        "child.stdout.readline()\n"
        "print(child.pid, flush=True)\n"
        "time.sleep(300)\n"
    )
    parent = subprocess.Popen([sys.executable, "-c", program], stdout=subprocess.PIPE, text=True)
    assert parent.stdout is not None
    number = int(parent.stdout.readline())
    os.kill(number, 0)  # it is there
    parent.kill()
    parent.communicate()
    assert has_gone(number)


def has_gone(process: int, within: float = 20.0) -> bool:
    """Whether a process ends in time; one that nobody has fetched yet (a zombie) has ended."""
    ends = time.monotonic() + within
    while time.monotonic() < ends:
        try:
            os.kill(process, 0)
        except ProcessLookupError:
            return True
        status = Path(f"/proc/{process}/stat")
        if status.exists() and status.read_text().rpartition(")")[2].split()[0] == "Z":
            return True
        time.sleep(0.2)
    return False
