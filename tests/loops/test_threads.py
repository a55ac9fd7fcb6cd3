"""Work dealt out to threads: all of it, in order, on no more threads than there may be, and errors come back."""

import os
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import torch

from torchcrf_scan.loops.jit import Array
from torchcrf_scan.loops.threads import for_each, in_parts

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(params=[1, 2, 5])
def threads(request: pytest.FixtureRequest) -> Iterator[int]:
    before = torch.get_num_threads()
    torch.set_num_threads(request.param)
    yield request.param
    torch.set_num_threads(before)


@pytest.mark.parametrize("count", [0, 1, 2, 50])
def test_every_item_is_worked_on_once_in_order(threads: int, count: int) -> None:
    workers: list[str] = []

    def square(item: int) -> int:
        workers.append(threading.current_thread().name)
        return item**2

    assert for_each(square, range(count)) == [item**2 for item in range(count)]
    assert len(workers) == count
    assert len(set(workers)) <= threads


@pytest.mark.parametrize("count", [1, 2, 3, 7, 40])
def test_parts_together_are_the_whole(threads: int, count: int) -> None:
    sizes: list[int] = []

    def stage(motions: Array) -> Array:
        sizes.append(len(motions))
        return motions.sum(1)

    motions = np.random.default_rng(0).normal(size=(count, 3))
    assert in_parts(stage, motions).tolist() == motions.sum(1).tolist()
    assert sum(sizes) == count
    assert len(sizes) == min(threads, count)
    assert max(sizes) - min(sizes) <= 1


def test_what_goes_wrong_in_a_thread_is_told(threads: int) -> None:
    def fail(item: int) -> None:
        raise ValueError(f"item {item}")

    with pytest.raises(ValueError, match="item"):
        for_each(fail, range(8))


FORK = """
import multiprocessing, torch
from torchcrf_scan.loops.threads import for_each

def squares(count):
    assert torch.nn.functional.linear(torch.ones(400, 400), torch.ones(400, 400)).mean() == 400  # on torch's own threads
    return for_each(lambda item: item**2, range(count))

torch.set_num_threads(2)
assert squares(4) == [0, 1, 4, 9]
with multiprocessing.get_context("fork").Pool(1) as pool:
    print(pool.apply_async(squares, (5,)).get(30))
"""


@pytest.mark.skipif(not hasattr(os, "fork"), reason="needs fork")
def test_a_forked_child_has_threads_of_its_own() -> None:
    done = subprocess.run([sys.executable, "-c", FORK], cwd=ROOT, capture_output=True, text=True, timeout=120, check=True)
    assert done.stdout == "[0, 1, 4, 9, 16]\n"
