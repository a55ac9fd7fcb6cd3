"""The report of a benchmark: rows as JSON, and summary tables."""

from __future__ import annotations

import json
import math
import os
import platform
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict
from importlib.metadata import version
from pathlib import Path
from typing import Any

import torch

from torchcrf_scan.benchmark.limits import Rates
from torchcrf_scan.benchmark.plan import WHOLE
from torchcrf_scan.evaluation.table import Table
from torchcrf_scan.whole_file import write_whole

Row = Mapping[str, Any]
NAN = float("nan")
EVERYWHERE = ("stage", "mode", "batch", "beams", "threads", "median_ms_per_pair")  # keys of every row


def write_report(path: Path, rows: Sequence[Row], rates: Rates) -> None:
    """Writes `{"machine": ..., "rows": [...]}` atomically, with null for missing values."""
    machine = {**describe_machine(), "per_second_one_thread": asdict(rates)}
    text = json.dumps({"machine": machine, "rows": [_finite(row) for row in rows]}, indent=1, allow_nan=False) + "\n"
    write_whole(path, text)


def describe_machine() -> dict[str, Any]:
    """Processor, cores and versions."""
    return {
        "processor": _processor(),
        "cpu_count": os.cpu_count(),
        "system": platform.platform(),
        "python": platform.python_version(),
        "torch": torch.__version__,  # with its build, which its metadata may lack
        **{name: version(name) for name in ("numpy", "numba")},
    }


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return platform.processor()
    return next((line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")), platform.processor())


def _finite(row: Row) -> dict[str, Any]:
    values = {**dict.fromkeys(EVERYWHERE), **row}
    return {key: None if isinstance(value, float) and not math.isfinite(value) else value for key, value in values.items()}


def report_tables(rows: Sequence[Row], rates: Rates) -> list[Table]:
    """All tables that have rows."""
    of_stage: dict[str, list[Row]] = {}
    for row in rows:
        of_stage.setdefault(row["stage"], []).append(row)
    tables = [
        whole_table(of_stage.get(WHOLE, [])),
        recorded_table(of_stage.get(WHOLE, [])),
        registration_table(of_stage.get("registration", [])),
        chain_table(of_stage.get("chain", [])),
        growth_table(of_stage.get("growth", [])),
        fresh_table([*of_stage.get("first_call", []), *of_stage.get("peak_memory", [])]),
        training_table([row for row in rows if "seconds" in row]),
        limit_table(of_stage.get("limit", []), rates),
        beside_table(of_stage.get("beside", [])),
    ]
    return [table for table in tables if table.rows]


def _number(row: Row, key: str) -> float:
    value = row.get(key)
    return NAN if value is None else float(value)


def _values(rows: Iterable[Row], key: str) -> list[Any]:
    """Distinct values of a key, in order of appearance."""
    return list(dict.fromkeys(row[key] for row in rows))


def _pivot(rows: Sequence[Row], keys: Sequence[str], across: str, cell: str) -> tuple[list[Any], list[tuple[Any, ...]]]:
    """The distinct values of `across`, and rows of the values of `keys` (as text) with a cell for each of them."""
    columns = _values(rows, across)
    found: dict[tuple[str, ...], dict[Any, float]] = {}
    for row in rows:
        found.setdefault(tuple(str(row[key]) for key in keys), {})[row[across]] = _number(row, cell)
    return columns, [(*key, *(of.get(column, NAN) for column in columns)) for key, of in found.items()]


def _sorted(rows: Sequence[Row], keys: Sequence[str]) -> list[Row]:
    return sorted(rows, key=lambda row: tuple(row[key] for key in keys))


def whole_table(rows: Sequence[Row]) -> Table:
    """Simulated pairs: one column per number of beams."""
    keys = ("backend", "mode", "batch", "threads")
    mine = _sorted([row for row in rows if row["data"] == "simulated"], ("backend", "mode", "batch", "threads", "beams"))
    columns, cells = _pivot(_sorted(mine, ("beams",)), keys, "beams", "median_ms_per_pair")
    order = {tuple(str(row[key]) for key in keys): k for k, row in reversed(list(enumerate(mine)))}
    cells.sort(key=lambda of: order[of[: len(keys)]])
    headings = (*keys, *(f"{beams} beams" for beams in columns))
    note = (
        "Processor time of one thread, wall time of several. cold: no prior motion; warm: one as odometry gives it; -: not timed, "
        "too slow (see --full, --patience)."
    )
    return Table("Whole pair, ms per pair", headings, tuple(cells), (*[0] * len(keys), *[2] * len(columns)), note)


def recorded_table(rows: Sequence[Row]) -> Table:
    """Recorded pairs, one at a time."""
    mine = [row for row in rows if row["data"] == "recorded"]
    cells = tuple((row["backend"], row["mode"], _number(row, "beams"), _number(row, "median_ms_per_pair")) for row in mine)
    return Table("Recorded pairs, one at a time", ("backend", "mode", "beams", "ms per pair"), cells, (0, 0, 0, 2))


def _ratios(rows: Sequence[Row], suffix: str) -> list[str]:
    return [key for key in dict.fromkeys(key for row in rows for key in row) if key.endswith(suffix)]


def registration_table(rows: Sequence[Row]) -> Table:
    """Times of rivals for one rigid motion, and the ratio of the whole pair to them."""
    ratios = _ratios(rows, "_to_rival")
    headings = ("rival", "data", "mode", "ms per pair", *(f"whole pair / rival, {key.removesuffix('_to_rival')}" for key in ratios))
    cells = (
        (
            row["rival"],
            row["data"],
            row["mode"],
            _number(row, "median_ms_per_pair"),
            *(_number(row, key) for key in ratios),
            _note(row),
        )
        for row in rows
    )
    digits = (0, 0, 0, 3, *[1] * len(ratios), 0)
    return Table("Registration by others, on the same pairs", (*headings, "note"), tuple(cells), digits)


def _note(row: Row) -> str:
    return str(row.get("note") or "")


def chain_table(rows: Sequence[Row]) -> Table:
    """One chain: ours compute the max-marginals of every node, both directions."""
    ratios = _ratios(rows, "_to_this")
    headings = (
        "decoder",
        "states",
        "ms",
        *(f"ours / this, {key.removesuffix('_to_this')}" for key in ratios),
        "same labels",
        "note",
    )
    same = {True: "yes", False: "no", None: "-"}
    cells = (
        (
            *(row["decoder"], str(row["states"]), _number(row, "median_ms_per_pair")),
            *(_number(row, key) for key in ratios),
            *(same[row.get("same_labels")], _note(row)),
        )
        for row in rows
    )
    return Table("One chain of 361 nodes", headings, tuple(cells), (0, 0, 3, *[3] * len(ratios), 0, 0))


def growth_table(rows: Sequence[Row]) -> Table:
    """Exponent of the time over the number of beams."""
    cells = ((row["backend"], row["mode"], row["exponent"], f"{row['from_beams']} to {row['to_beams']}") for row in rows)
    return Table("Growth with the number of beams", ("backend", "mode", "exponent", "beams"), tuple(cells), (0, 0, 2, 0))


def fresh_table(rows: Sequence[Row]) -> Table:
    """First call after the import, and the peak of memory above the interpreter with torch loaded."""
    cells = (
        (row["backend"], row["stage"], str(row["batch"]), _number(row, "median_ms_per_pair"), _number(row, "megabytes"))
        for row in rows
    )
    return Table("In a fresh process", ("backend", "what", "batch", "ms", "MB"), tuple(cells), (0, 0, 0, 0, 0))


def training_table(rows: Sequence[Row]) -> Table:
    """Learning, in seconds of processor time."""
    cells = ((row["stage"], _number(row, "seconds"), str(row["pairs"]), _note(row)) for row in rows)
    return Table("Training", ("what", "s", "pairs", "note"), tuple(cells), (0, 1, 0, 0))


def limit_table(rows: Sequence[Row], rates: Rates) -> Table:
    """Ratio of measured times to the machine's limit."""
    backends = [key.removesuffix("_to_limit") for key in _ratios(rows, "_to_limit")]
    columns = (f"{name}{end}" for name in backends for end in (", ms", " / limit"))
    headings = ("mode", "operations (M)", "bytes (MB)", "limit, ms", *columns)
    cells = (
        (
            *(row["mode"], row["operations"] / 1e6, row["bytes"] / 1e6, row["limit_ms_per_pair"]),
            *(_number(row, f"{name}{end}") for name in backends for end in ("_ms_per_pair", "_to_limit")),
        )
        for row in rows
    )
    note = (
        f"A whole pair. One thread: {rates.bandwidth / 1e9:.1f} GB/s, {rates.matrix / 1e9:.1f} G operations/s in a matrix "
        f"product (the limit), {rates.vector / 1e9:.1f} G/s in short vectors. Counted in benchmark/limits.py."
    )
    digits = (0, 2, 2, 4, *[2, 0] * len(backends))
    return Table("How far from the limit", headings, tuple(cells), digits, note)


def beside_table(rows: Sequence[Row]) -> Table:
    """This package and another checkout of it, in turns."""
    cells = tuple((row["task"], row["ms_per_pair"], row["other_ms_per_pair"], row["ratio"]) for row in rows)
    note = "Processor time of one thread, medians."
    return Table("Beside another checkout", ("call", "ms per pair", "other, ms per pair", "ratio"), cells, (0, 2, 2, 3), note)
