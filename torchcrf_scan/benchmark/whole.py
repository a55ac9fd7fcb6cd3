"""Times of whole pairs, and of third-party registration of the same pairs, in turns."""

from __future__ import annotations

import math
from collections.abc import Sequence

from torchcrf_scan.benchmark import rivals
from torchcrf_scan.benchmark.plan import GROWTH, RECORDED, SIMULATED, WHOLE, Material, Plan, Row, Setting, settings_of
from torchcrf_scan.benchmark.scenes import MODES, cycle, in_mode
from torchcrf_scan.benchmark.timing import Task, Timed, time_in_turns
from torchcrf_scan.scan import ScanPair


def time_whole(plan: Plan, material: Material) -> list[Timed]:
    """Every backend in all its settings, rivals on the centre's pairs and on recorded ones, all in turns."""
    for backend in plan.backends:
        material.model(backend).match_pairs(material.pairs(min(plan.beams), "cold")[:1])  # loads code and warms caches
    tasks = [_simulated(plan, material, b, mode, s) for b in plan.backends for mode in MODES for s in settings_of(plan, b)]
    _, beams, threads = plan.centre
    sets = {SIMULATED: {mode: material.pairs(beams, mode) for mode in MODES}}
    if plan.recorded:
        sets[RECORDED] = {mode: in_mode(plan.recorded, mode) for mode in MODES}
        for mode, pairs in sets[RECORDED].items():
            if pairs:
                tasks += [_whole(plan, material, b, mode, pairs, (1, _beams(pairs), threads), RECORDED) for b in plan.backends]
    for name, make in rivals.REGISTRATIONS.items():
        register, reason = rivals.load(make)
        for data, by_mode in sets.items():
            for mode, pairs in by_mode.items():
                if pairs:
                    places = {"mode": mode, "batch": 1, "beams": beams if data == SIMULATED else _beams(pairs), "data": data}
                    tasks.append(_rival(plan, name, register, reason, pairs, places))
    return time_in_turns(tasks, plan.patience, "whole pairs")


def _beams(pairs: Sequence[ScanPair]) -> int:
    return max(pair.source.n_beams for pair in pairs)


def _simulated(plan: Plan, material: Material, backend: str, mode: str, setting: Setting) -> Task:
    return _whole(plan, material, backend, mode, material.pairs(setting[1], mode), setting, SIMULATED)


def _whole(plan: Plan, material: Material, backend: str, mode: str, pairs: Sequence[ScanPair], setting: Setting, data: str) -> Task:
    batch, beams, threads = setting
    model = material.model(backend)
    places = {"stage": WHOLE, "backend": backend, "mode": mode, "batch": batch, "beams": beams, "threads": threads, "data": data}
    return Task(
        places,
        lambda turn: model.match_pairs(cycle(pairs, turn, batch), batch_size=batch),
        pairs=batch,
        threads=threads,
        rounds=max(plan.repeats, math.ceil(plan.repeats * len(pairs) / batch)),
        series=(backend, mode, data),
        size=batch * float(beams) ** GROWTH,
    )


def _rival(plan: Plan, name: str, register: rivals.Register | None, reason: str, pairs: Sequence[ScanPair], places: Row) -> Task:
    row = {"stage": "registration", "rival": name, **places, "threads": 1}
    if register is None:
        return Task({**row, "note": reason}, lambda turn: None, rounds=0)
    return Task(row, lambda turn: register(pairs[turn % len(pairs)]), rounds=plan.repeats * len(pairs))


def registration_rows(timed: Sequence[Timed], centre: Setting) -> list[Row]:
    """The rivals' rows, with the ratio of every backend's whole pair to them: median over the same pairs."""
    rows = []
    for rival in timed:
        if rival.task.row["stage"] != "registration":
            continue
        row = rival.as_row()
        for one in timed:
            where = one.task.row
            is_alike = all(where[key] == rival.task.row[key] for key in ("mode", "data"))
            at_centre = where["batch"] == 1 and where["threads"] == centre[2] and where["beams"] == rival.task.row["beams"]
            if where["stage"] == WHOLE and is_alike and at_centre and rival.seconds and one.seconds:
                row[f"{where['backend']}_to_rival"] = one.ratio(rival)
        rows.append(row)
    return rows
