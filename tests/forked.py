"""Processes that begin at once: forked from one that has imported what takes seconds, and does nothing else."""

import multiprocessing
import os
import socket
from collections.abc import Callable, Mapping
from multiprocessing.context import ForkServerProcess

import torch

IMPORTED = (
    "torchcrf_scan.cli",
    "torchcrf_scan.experiment.cross_validation",
    "torchcrf_scan.learning.gradient",
    "torchcrf_scan.live.listener",
    "torchcrf_scan.viz.frames",
    "matplotlib.figure",
    "matplotlib.backends.backend_agg",
)
CONTEXT = multiprocessing.get_context("forkserver")
CONTEXT.set_forkserver_preload([*IMPORTED])


def begin(run: Callable[..., object], *arguments: object, environment: Mapping[str, str] | None = None) -> ForkServerProcess:
    """Calls a function of a module in a process of its own, with one thread and these changes to the environment."""
    process = CONTEXT.Process(target=_call, args=(run, arguments, dict(environment or {})))
    process.start()
    return process


def run_ranks(run: Callable[..., object], *arguments: object) -> list[int | None]:
    """Exit codes of two processes in the environment that `torchrun` gives to those of one machine."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = str(free.getsockname()[1])
    shared = {"WORLD_SIZE": "2", "LOCAL_WORLD_SIZE": "2", "MASTER_ADDR": "127.0.0.1", "MASTER_PORT": port}
    ranks = [begin(run, *arguments, environment=shared | {"RANK": rank, "LOCAL_RANK": rank}) for rank in "01"]
    try:
        for process in ranks:
            process.join(300)
        return [process.exitcode for process in ranks]
    finally:
        for process in ranks:
            process.kill()


def _call(run: Callable[..., object], arguments: tuple[object, ...], environment: dict[str, str]) -> None:
    os.environ |= environment
    torch.set_num_threads(1)
    run(*arguments)
