"""`torchcrf-scan bench`: costs of the model, compared with rivals and with the limit of the machine."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from torchcrf_scan.commands.arguments import listed
from torchcrf_scan.errors import TorchCRFScanError
from torchcrf_scan.pretrained import PRETRAINED
from torchcrf_scan.whole_file import make_folder

if TYPE_CHECKING:
    from torchcrf_scan.benchmark.limits import Rates
    from torchcrf_scan.benchmark.plan import Plan, Row


def bench(
    output: str,
    *,
    model: str = PRETRAINED,
    pairs: tuple[str, ...] | str = (),
    backends: tuple[str, ...] | str = (),
    beams: tuple[int, ...] = (181, 361, 721, 1441, 2881),
    batches: tuple[int, ...] = (1, 8, 32),
    threads: tuple[int, ...] = (1, 2),
    repeats: int = 3,
    simulated: int = 8,
    training_pairs: int = 30,
    patience: float = 15.0,
    full: bool = False,
    beside: str = "",
) -> int:
    """Times whole pairs, learning and rivals, measures memory, and gives the distance from the limit of this machine.

    Everything is timed in turns and given as medians, on simulated streets, cold (no prior motion) and warm (the true one with
    the errors of odometry). Installed rivals run in the same turns (`pip install torchcrf-scan[bench]`). Tables are
    printed, all rows are written.

    Args:
        output: JSON file of the report
        model: folder of a saved model, or the name of one that the package ships
        pairs: annotated pair files, folders or glob patterns, to time recorded pairs as well
        backends: compiled, eager; by default all that run here
        beams: numbers of beams, as a list [181,361]
        batches: numbers of pairs at once
        threads: numbers of threads of torch
        repeats: times that every pair is timed, within three seconds
        simulated: simulated pairs of every number of beams
        training_pairs: pairs that one fold is fitted on, 0: no learning
        patience: maximum seconds of a call; longer ones are skipped
        full: the reference (eager) in all sizes too, by default only in those that differ in one value
        beside: folder of another checkout of the package; then only the calls common to both are timed, in turns
    """
    from torchcrf_scan.benchmark.limits import measure_rates
    from torchcrf_scan.benchmark.plan import Plan, choose_backends
    from torchcrf_scan.benchmark.report import report_tables, write_report
    from torchcrf_scan.data.dataset import PairFiles

    for name, values in {"beams": beams, "batches": batches, "threads": threads}.items():
        if not values or min(values) < 1:
            raise TorchCRFScanError(f"--{name}: expected numbers of at least 1, got {list(values)}")
    for name, value in {"repeats": repeats, "simulated": simulated}.items():
        if value < 1:
            raise TorchCRFScanError(f"--{name}: expected at least 1, got {value}")
    path = Path(output)
    make_folder("--output", path.parent)
    recorded = tuple(PairFiles(*listed(pairs))) if pairs else ()
    plan = Plan(model, choose_backends(listed(backends)), beams, batches, threads, repeats, simulated, patience, recorded, full)
    rates = measure_rates()
    rows = _compare(plan, Path(beside)) if beside else _measure(plan, rates, training_pairs)
    write_report(path, rows, rates)
    print("\n".join(table.to_markdown() for table in report_tables(rows, rates)), end="")
    print(f"\nall rows: {output}")
    return 0


def _compare(plan: Plan, other: Path) -> list[Row]:
    """The rows of the comparison with another checkout."""
    from torchcrf_scan.benchmark.beside import compare
    from torchcrf_scan.benchmark.scenes import street_pairs

    return compare(street_pairs(plan.centre[1], plan.pairs), plan.model, other, plan.repeats)


def _measure(plan: Plan, rates: Rates, training_pairs: int) -> list[Row]:
    """All rows of this package alone."""
    from torchcrf_scan.benchmark.scenes import street_pairs
    from torchcrf_scan.benchmark.study import run_study
    from torchcrf_scan.benchmark.training import time_training
    from torchcrf_scan.config import ModelConfig
    from torchcrf_scan.learning.settings import LearningConfig

    rows = run_study(plan, rates)
    if training_pairs:
        rows += time_training(street_pairs(plan.centre[1], training_pairs), ModelConfig(), LearningConfig())
    return rows
