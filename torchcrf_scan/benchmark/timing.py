"""Timing in turns: every round times every task once, so that a slow moment falls on all of them; medians over the rounds."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

import torch
from tqdm import tqdm

ENOUGH = 3.0  # seconds that a task is timed for in all; a call that takes longer is made once


@dataclass(frozen=True, slots=True)
class Task:
    """Something to time.

    Attributes:
        row: what the report's row says beside the times.
        run: what is timed, given the number of the round.
        pairs: pairs that one call handles. threads: of torch. rounds: calls at most.
        series: tasks of one series differ in `size` alone, to which their time is about proportional: so a call can be foreseen.
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
    """A task and what it took: seconds of a call by the number of its round; `foreseen` seconds where it was not made."""

    task: Task
    seconds: dict[int, float] = field(default_factory=dict)
    foreseen: float = 0.0

    @property
    def milliseconds(self) -> float:
        """Median of a call, per pair; NaN without a call."""
        return 1e3 * statistics.median(self.seconds.values()) / self.task.pairs if self.seconds else float("nan")

    def ratio(self, other: Timed) -> float:
        """Median over the rounds that both have of this one's time over the other's, per pair; NaN where there is none."""
        both = [self.seconds[k] / other.seconds[k] for k in self.seconds.keys() & other.seconds.keys()]
        return statistics.median(both) * other.task.pairs / self.task.pairs if both else float("nan")

    def as_row(self) -> dict[str, Any]:
        """The row of the report; of a task that was not to be timed, with its own note."""
        row = {**self.task.row, "median_ms_per_pair": self.milliseconds if self.seconds else None, "runs": len(self.seconds)}
        if self.foreseen:
            row["note"] = f"left out: a call would take about {self.foreseen:.0f} s, more than --patience"
        return row


def time_in_turns(tasks: Sequence[Task], patience: float, title: str = "rounds", enough: float = ENOUGH) -> list[Timed]:
    """Times the tasks round by round, small ones first; each until it has its rounds or `enough` seconds.

    patience: seconds that a call may take; one that would take longer is left out, but never the smallest of a series.
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
    """Whatever number of threads torch is told to use in between, it has its own again afterwards."""
    kept = torch.get_num_threads()
    try:
        yield
    finally:
        torch.set_num_threads(kept)


def _foresee(task: Task, timed: Sequence[Timed]) -> float:
    """Seconds of a call, from the largest of the series that has been made; 0 where none has."""
    known = [one for one in timed if one.seconds and one.task.series == task.series]
    return known[-1].seconds[0] * task.size / known[-1].task.size if known else 0.0


def _time(task: Task, turn: int) -> float:
    """Processor time where there is one thread, whatever else the cores do; the wall's where threads share the work."""
    torch.set_num_threads(task.threads)
    clock = time.process_time if task.threads == 1 else time.perf_counter
    began = clock()
    task.run(turn)
    return clock() - began


def least_seconds(run: Callable[[], object], repeats: int) -> float:
    """Least seconds of a call: what is possible. The first call is left out."""
    run()
    found = []
    for _ in range(repeats):
        began = time.perf_counter()
        run()
        found.append(time.perf_counter() - began)
    return min(found)
