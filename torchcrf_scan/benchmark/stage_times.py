"""Times of the stages, and how often decoding calls them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from itertools import product

import torch

from torchcrf_scan.batch import ScanPairBatch
from torchcrf_scan.benchmark.plan import GROWTH, SIMULATED, Material, Plan, Row, around_centre, place_of
from torchcrf_scan.benchmark.scenes import MODES, cycle
from torchcrf_scan.benchmark.stages import TABLES, WHOLE, Stages, calls_per_pair
from torchcrf_scan.benchmark.timing import Task, Timed, time_in_turns
from torchcrf_scan.model import JointScanCRF
from torchcrf_scan.scan import ScanPair

STATES_TIMED = 3  # pairs whose stages are timed at the centre; elsewhere one
STAGES_ENOUGH = 1.0  # seconds that a stage is timed for
STAGES_SHARE = 0.25  # of the patience: where a pair takes longer, its stages are not timed, which need several to get ready


def time_stages(plan: Plan, material: Material, whole: Sequence[Timed]) -> list[Timed]:
    """The stages around the centre, where the whole pair could be timed."""
    quick = [one for one in whole if one.seconds and one.task.row["data"] == SIMULATED and one.task.row["stage"] == WHOLE]
    timed_whole = {place_of(one.task.row) for one in quick if one.seconds[0] <= STAGES_SHARE * plan.patience}
    tasks = []
    for backend, mode, setting in product(plan.backends, MODES, around_centre(plan)):
        batch, beams, threads = setting
        if (backend, mode, *setting) not in timed_whole:
            continue
        pairs = material.pairs(beams, mode)
        several = min(STATES_TIMED, len(pairs)) if setting == plan.centre else 1
        states = [_make_stages(backend, material.model(backend), cycle(pairs, k, batch)) for k in range(several)]
        for name in states[0]:
            row = {"stage": name, "backend": backend, "mode": mode, "batch": batch, "beams": beams, "threads": threads}
            tasks.append(
                Task(
                    {**row, "data": SIMULATED},
                    partial(_run_stage, states, name),
                    pairs=batch,
                    threads=threads,
                    rounds=plan.repeats * several,
                    series=(backend, mode, name, threads),
                    size=batch * float(beams) ** GROWTH,
                )
            )
    return time_in_turns(tasks, plan.patience, "stages", STAGES_ENOUGH)


def _make_stages(backend: str, model: JointScanCRF, pairs: Sequence[ScanPair]) -> Stages:
    stages = TABLES[backend](model, pairs)
    for call in stages.values():
        call()  # the first call compiles, or allocates
    return stages


def _run_stage(states: Sequence[Stages], name: str, turn: int) -> object:
    return states[turn % len(states)][name]()


@dataclass(frozen=True, slots=True)
class Course:
    """How decoding goes on average: rounds of a pair, and motions in it."""

    rounds: float
    motions: float


@torch.no_grad()
def follow(material: Material, mode: str, beams: int) -> Course:
    """Of some pairs, by the first backend, for all decode alike."""
    model = material.model(material.plan.backends[0])
    batch = ScanPairBatch.collate(material.pairs(beams, mode)[:STATES_TIMED], model.association_weights["sequence"].dtype)
    found = model(batch.without_truth())
    return Course(float(found.iterations.double().mean()), float(found.active.sum(-1).double().mean()))


def stage_rows(timed: Sequence[Timed], courses: dict[str, Course]) -> list[Row]:
    """The stages' rows, a call each; `calls_per_pair` tells how many there are."""
    rows = []
    for one in timed:
        calls = calls_per_pair(courses[one.task.row["mode"]].rounds)
        rows.append({**one.as_row(), "calls_per_pair": calls[one.task.row["stage"]]})
    return rows
