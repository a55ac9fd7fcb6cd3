"""Work shared by as many threads as torch may use: compiled code holds no lock while it runs."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from itertools import pairwise
from typing import TypeVar

import numpy as np
import torch

from torchcrf_scan.loops.jit import Array

T = TypeVar("T")
R = TypeVar("R")


@cache
def _helpers(count: int) -> ThreadPoolExecutor:
    """Worker threads beside the caller's own; kept, because starting one takes longer than many a stage."""
    return ThreadPoolExecutor(count, thread_name_prefix="torchcrf_scan")


def _begin_anew() -> None:
    """In a forked child of a process that has used several threads: none of them exists there, torch's own neither."""
    if _helpers.cache_info().currsize:
        _helpers.cache_clear()
        torch.set_num_threads(1)  # more would wait for ever for the threads of the parent's OpenMP


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_begin_anew)


def for_each(function: Callable[[T], R], items: Sequence[T]) -> list[R]:
    """function(item) of every item, in order, on `torch.get_num_threads()` threads.

    An item that is taken by no other thread yet is done by the next one that is free, so that no thread waits for a long one.
    """
    threads = min(torch.get_num_threads(), len(items))
    if threads < 2:
        return [function(item) for item in items]
    results: list[R | None] = [None] * len(items)
    waiting = iter(range(len(items)))

    def work() -> None:
        for k in waiting:  # one iterator for all: a step of it is one operation of the interpreter
            results[k] = function(items[k])

    others = [_helpers(threads - 1).submit(work) for _ in range(threads - 1)]
    work()
    for other in others:
        other.result()
    return results  # type: ignore[return-value]


def in_parts(stage: Callable[[Array], Array], motions: Array) -> Array:
    """stage(motions), of as many parts of the motions as there are threads at once; stages work on every motion for itself."""
    threads = min(torch.get_num_threads(), len(motions))
    if threads < 2:
        return stage(motions)
    bounds = np.linspace(0, len(motions), threads + 1).round().astype(int)
    parts = [motions[low:high] for low, high in pairwise(bounds)]
    return np.concatenate(for_each(stage, parts))
