"""Timing in turns: every round times every task once, so that slow moments affect all of them; medians over the rounds."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

import torch
from tqdm import tqdm

ENOUGH = 3.0  # seconds after which a task is not repeated; a longer call is made once


@dataclass(frozen=True, slots=True)
class Task:
    """A function to time.

    Attributes:
        row: entries of the report's row in addition to the times.
        run: the function to time, given the number of the round.
        pairs: pairs per call. threads: of torch. rounds: maximum number of calls.
        series: tasks of one series differ in `size` alone, to which their time is about proportional, so that it can be predicted.
    """

    row: Mapping[str, Any]
    run: Callable[[int], object]
    pairs: int = 1
    threads: int = 1
    rounds: int = 1
    series: tuple[Any, ...] = ()
    size: float = 1.0


@dataclass(frozen=True, slots=True)
class Timed:
    """A task with its times: seconds of a call by the number of its round; `foreseen` seconds if it was not called."""

    task: Task
    seconds: dict[int, float] = field(default_factory=dict)
    foreseen: float = 0.0

    @property
    def milliseconds(self) -> float:
        """Median of a call, per pair; NaN without a call."""
        return 1e3 * statistics.median(self.seconds.values()) / self.task.pairs if self.seconds else float("nan")

    def ratio(self, other: Timed) -> float:
        """Median ratio of this task's time to the other's over their common rounds, per pair; NaN without any."""
        both = [self.seconds[k] / other.seconds[k] for k in self.seconds.keys() & other.seconds.keys()]
        return statistics.median(both) * other.task.pairs / self.task.pairs if both else float("nan")

    def as_row(self) -> dict[str, Any]:
        """The row of the report; for a task that is not to be timed, with its note."""
        row = {**self.task.row, "median_ms_per_pair": self.milliseconds if self.seconds else None, "runs": len(self.seconds)}
        if self.foreseen:
            row["note"] = f"left out: a call would take about {self.foreseen:.0f} s, more than --patience"
        return row


def time_in_turns(tasks: Sequence[Task], patience: float, title: str = "rounds", enough: float = ENOUGH) -> list[Timed]:
    """Times the tasks round by round, small ones first; each until it has its rounds or `enough` seconds.

    Args:
        patience: seconds of a call; longer ones are skipped, but never the smallest of a series.
    """
    timed = [Timed(task) for task in sorted(tasks, key=lambda task: task.size)]
    with threads_kept():
        for turn in tqdm(range(max((task.rounds for task in tasks), default=0)), desc=title, unit="round", disable=None):
            for k, one in enumerate(timed):
                if turn >= one.task.rounds or one.foreseen or sum(one.seconds.values()) >= enough:
                    continue
                if turn == 0 and (seconds := _foresee(one.task, timed)) > patience:
                    timed[k] = Timed(one.task, foreseen=seconds)
                    continue
                one.seconds[turn] = _time(one.task, turn)
    return timed


@contextmanager
def threads_kept() -> Iterator[None]:
    """Context that restores the number of threads of torch at its end."""
    kept = torch.get_num_threads()
    try:
        yield
    finally:
        torch.set_num_threads(kept)


def _foresee(task: Task, timed: Sequence[Timed]) -> float:
    """Predicted seconds of a call, from the largest of the series called so far; 0 without any."""
    known = [one for one in timed if one.seconds and one.task.series == task.series]
    return known[-1].seconds[0] * task.size / known[-1].task.size if known else 0.0


def _time(task: Task, turn: int) -> float:
    """Processor time of a single thread, independent of other load; wall time if threads share the work."""
    torch.set_num_threads(task.threads)
    clock = time.process_time if task.threads == 1 else time.perf_counter
    began = clock()
    task.run(turn)
    return clock() - began


def least_seconds(run: Callable[[], object], repeats: int) -> float:
    """Minimum of the seconds of several calls, after one to warm up."""
    run()
    found = []
    for _ in range(repeats):
        began = time.perf_counter()
        run()
        found.append(time.perf_counter() - began)
    return min(found)
