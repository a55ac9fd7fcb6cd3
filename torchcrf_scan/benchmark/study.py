"""All measurements of `torchcrf-scan bench` except learning: the rows of the report."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from itertools import product

import numpy as np
import torch

from torchcrf_scan.batch import ScanPairBatch
from torchcrf_scan.benchmark import limits, rivals
from torchcrf_scan.benchmark.fresh import ask_fresh_process
from torchcrf_scan.benchmark.limits import Rates
from torchcrf_scan.benchmark.plan import SIMULATED, WHOLE, Material, Plan, Row, place_of
from torchcrf_scan.benchmark.scenes import MODES, cycle
from torchcrf_scan.benchmark.timing import Task, Timed, time_in_turns
from torchcrf_scan.benchmark.whole import registration_rows, time_whole

FITTED_FROM = 361  # beams from which the growth is fitted


# --- chains -------------------------------------------------------------------------------------------------------------------


def time_chains(plan: Plan) -> list[Row]:
    """One chain of a scan, 16 and 17 states, by this package and by others in turns; ratios to each of ours."""
    rows: list[Row] = []
    for states in rivals.STATES:
        unary, transition = rivals.make_chain(rivals.NODES, states)
        best = rivals.chain_of_numpy(unary, transition)()
        tasks = []
        for name, (make, note) in rivals.CHAINS.items():
            if name in rivals.OUR_CHAINS and name not in plan.backends:
                continue
            decode, reason = rivals.load(make, unary, transition)
            row: Row = {"stage": "chain", "decoder": name, "batch": 1, "beams": rivals.NODES, "states": states, "threads": 1}
            row["note"] = reason or note
            if decode is None:
                tasks.append(Task(row, lambda turn: None, rounds=0))
                continue
            answer = decode()
            if name not in rivals.WITHOUT_LABELS:
                row["same_labels"] = bool((np.asarray(answer) == best).all())
            tasks.append(Task(row, partial(_call, decode), rounds=plan.repeats * plan.pairs))
        timed = time_in_turns(tasks, plan.patience, f"chain of {states} states")
        ours = [one for one in timed if one.task.row["decoder"] in rivals.OUR_CHAINS]
        for one in timed:
            ratios = {f"{mine.task.row['decoder']}_to_this": mine.ratio(one) for mine in ours if one.seconds}
            rows.append({**one.as_row(), **ratios})
    return rows


def _call(decode: rivals.Decode, turn: int) -> object:
    return decode()


# --- growth, memory, first call, limit ------------------------------------------------------------------------------------------


def growth_rows(timed: Sequence[Timed], plan: Plan) -> list[Row]:
    """Exponent of the time over the number of beams: slope of a straight line through the logarithms."""
    batch, _, threads = plan.centre
    rows = []
    for backend, mode in product(plan.backends, MODES):
        found = {
            one.task.row["beams"]: one.milliseconds
            for one in timed
            if one.seconds and place_of(one.task.row) == (backend, mode, batch, one.task.row["beams"], threads)
            if one.task.row.get("data") == SIMULATED and one.task.row["beams"] >= FITTED_FROM
        }
        if len(found) > 1:
            slope = float(np.polyfit(np.log(list(found)), np.log(list(found.values())), 1)[0])
            rows.append(
                {"stage": "growth", "backend": backend, "mode": mode, "batch": batch, "threads": threads}
                | {"exponent": slope, "from_beams": min(found), "to_beams": max(found)}
            )
    return rows


def fresh_rows(plan: Plan, material: Material) -> list[Row]:
    """First call and peak of memory of the largest batch at the centre's beams, each backend in a process of its own."""
    beams, batch = plan.centre[1], max(plan.batches)
    pairs = cycle(material.pairs(beams, "cold"), 0, batch)
    rows = []
    for backend in plan.backends:
        told = ask_fresh_process(plan.model, backend, "cold", pairs)
        row = {"backend": backend, "mode": "cold", "beams": beams, "threads": torch.get_num_threads()}
        rows.append({"stage": "first_call", **row, "batch": 1, "median_ms_per_pair": told["first_call_ms"]})
        rows.append({"stage": "peak_memory", **row, "batch": batch, "megabytes": told["peak_mb"]})
    return rows


def limit_rows(plan: Plan, material: Material, timed: Sequence[Row], rates: Rates) -> list[Row]:
    """Work of a whole pair at the centre, the time at the machine's limit, and the ratio of measured times to it."""
    batch, beams, threads = plan.centre
    rows = []
    for mode in MODES:
        size = size_of(material, beams, mode)
        work = limits.count_work(size)
        at_limit = work.milliseconds(rates)
        row: Row = {"stage": "limit", "mode": mode, "batch": 1, "beams": beams, "threads": 1, "points": size.points}
        row |= {"operations": work.operations, "bytes": work.bytes, "limit_ms_per_pair": at_limit}
        for one in timed:
            is_there = one.get("data") == SIMULATED and one["median_ms_per_pair"] is not None
            if is_there and place_of(one)[1:] == (mode, batch, beams, threads):
                row[f"{one['backend']}_ms_per_pair"] = one["median_ms_per_pair"]
                row[f"{one['backend']}_to_limit"] = one["median_ms_per_pair"] / at_limit
        rows.append(row)
    return rows


@torch.no_grad()
def size_of(material: Material, beams: int, mode: str) -> limits.Size:
    """Typical numbers of points, rounds and motions of the pairs of one size."""
    pairs, model = material.pairs(beams, mode), material.model("compiled")
    answers = model(ScanPairBatch.collate(pairs).without_truth())
    points = round(float(np.mean([len(pair.source) for pair in pairs])))
    inference = model.config.inference
    return limits.Size(
        points=points,
        candidates=inference.candidates or points,
        clusters=inference.clusters,
        motions=float(answers.active.sum(-1).float().mean()),
        rounds=float(answers.iterations.float().mean()),
        stumps=model.config.features.stumps,
        is_warm=mode == "warm",
    )


def run_study(plan: Plan, rates: Rates) -> list[Row]:
    """All rows except those of learning."""
    material = Material(plan)
    timed = time_whole(plan, material)
    times = [one.as_row() for one in timed if one.task.row["stage"] == WHOLE]
    return [
        *times,
        *registration_rows(timed, plan.centre),
        *time_chains(plan),
        *growth_rows(timed, plan),
        *fresh_rows(plan, material),
        *limit_rows(plan, material, times, rates),
    ]
