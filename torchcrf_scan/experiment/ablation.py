"""Table of the variants of a model, each compared with the model itself on the pairs that both were tested on."""

from __future__ import annotations

import statistics
from collections.abc import Callable, Mapping, Sequence

from torchcrf_scan.evaluation.bootstrap import paired_intervals
from torchcrf_scan.evaluation.metrics import PairScore
from torchcrf_scan.evaluation.report import DIFFERENCES, OVERVIEW
from torchcrf_scan.evaluation.summary import summarise
from torchcrf_scan.evaluation.table import Cell, Table
from torchcrf_scan.scan import Ints

NOTE = "Differences: variant minus model, percentage points on the same pairs [95 % interval]; * where it excludes zero."


def ablation_table(
    scores: Mapping[str, Sequence[PairScore]],
    seconds: Mapping[str, Sequence[float]],
    resample: Callable[[Sequence[PairScore]], Ints],
) -> Table:
    """One row per variant.

    Args:
        scores: variant -> its scores; the first is the model itself, tested on all pairs that any variant was tested on.
        seconds: variant -> the times of its pairs.
        resample: bootstrap weights (R, P) of P scores, see `bootstrap.by_sequence`.
    """
    model, *variants = scores
    reference = {one.name: one for one in scores[model]}
    rows: list[tuple[Cell, ...]] = []
    for name in (model, *variants):
        theirs = [reference[one.name] for one in scores[name]]
        intervals = paired_intervals(scores[name], theirs, resample(theirs))
        summary = summarise(scores[name])
        differences: list[Cell] = ["-" if name == model else intervals[key] for _, key in DIFFERENCES]
        times = 1e3 * statistics.median(seconds[name])
        rows.append((name, float(len(theirs)), *(summary[key] for _, key, _ in OVERVIEW), times, *differences))
    headings = [heading for heading, _, _ in OVERVIEW]
    columns = ("variant", "pairs", *headings, "time (ms)", *(f"difference: {heading}" for heading, _ in DIFFERENCES))
    digits = (0, 0, *(digits for _, _, digits in OVERVIEW), 0, *[1] * len(DIFFERENCES))
    return Table("Ablations", columns, tuple(rows), digits, NOTE)
