"""`torchcrf-scan evaluate --causes`: where the wrong points of the model's answers come from, and pictures of the worst pairs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from torchcrf_scan.batch import batches
from torchcrf_scan.commands.arguments import BATCH
from torchcrf_scan.errors import TorchCRFScanError
from torchcrf_scan.evaluation.causes.trace import SearchTrace
from torchcrf_scan.model import JointScanCRF
from torchcrf_scan.safe_names import file_name
from torchcrf_scan.scan import PairPrediction, ScanPair
from torchcrf_scan.whole_file import make_folder, write_whole

if TYPE_CHECKING:
    from torchcrf_scan.evaluation.metrics import PairScore
    from torchcrf_scan.evaluation.table import Table

REPORT = "causes.md"


@dataclass(frozen=True, slots=True)
class Traced:
    """Annotated pairs with the model's answers, the traces of its search, and the answers' scores."""

    model: JointScanCRF
    pairs: Sequence[ScanPair]
    answers: Sequence[PairPrediction]
    traces: Sequence[SearchTrace]
    scores: Sequence[PairScore]


def check(output: str | None, worst: int, causes: bool) -> None:
    """Raises TorchCRFScanError for options that need `--causes`."""
    if not causes and output is not None:
        raise TorchCRFScanError(f"--output: expected none without --causes, got {output}")
    if worst < 0:
        raise TorchCRFScanError(f"--worst: expected a number of pairs, 0 or more, got {worst}")


def trace(model: JointScanCRF, pairs: Sequence[ScanPair]) -> Traced:
    """The answers of a model with the traces of its search; raises TorchCRFScanError for a model that cannot be traced."""
    from torchcrf_scan.evaluation.metrics import score_pairs

    found = [both for part in batches(pairs, BATCH) for both in model.trace_pairs(part)]
    answers, traces = [answer for answer, _ in found], [of for _, of in found]
    return Traced(model, pairs, answers, traces, score_pairs(pairs, answers))


def explain(model: JointScanCRF, pairs: Sequence[ScanPair], worst: int, output: str | None) -> tuple[list[Table], dict[str, Any]]:
    """Tables and figures of the causes; with `output` also written to a folder, with pictures of the worst pairs."""
    from torchcrf_scan.evaluation.causes import tables
    from torchcrf_scan.evaluation.causes.blame import blame

    traced = trace(model, pairs)
    blames = [blame(*of) for of in zip(pairs, traced.answers, traced.traces, traced.scores, strict=True)]
    oracles, gates = _oracles(traced), tables.gates_of(_cases(traced))
    found = [
        tables.causes_table(blames),
        tables.fates_table(blames),
        tables.oracles_table(sum(of.wrong for of in blames), oracles),
        tables.gates_table(gates),
        tables.worst_table(blames, worst),
    ]
    if output is not None:
        folder = make_folder("--output", output)
        write_whole(folder / REPORT, "\n".join(table.to_markdown() for table in found))
        _draw(traced, tables.worst_of(blames, worst), folder)
    return found, {"causes": tables.figures(blames, oracles, gates)}


def _oracles(traced: Traced) -> dict[str, int]:
    """Wrong points with a part of the truth in hand."""
    from torchcrf_scan.baselines.oracle import match_all
    from torchcrf_scan.evaluation.calibration import rightness
    from torchcrf_scan.evaluation.causes.blame import wrong_points
    from torchcrf_scan.evaluation.causes.outliers import with_true_outliers

    decided = [with_true_outliers(pair, answer) for pair, answer in zip(traced.pairs, traced.answers, strict=True)]
    answers = {"right outlier decisions": decided, **match_all(traced.model, traced.pairs, traced.traces)}

    def wrong(of: Sequence[PairPrediction]) -> int:
        return sum(int(wrong_points(rightness(pair, answer)).sum()) for pair, answer in zip(traced.pairs, of, strict=True))

    return {name: wrong(of) for name, of in answers.items()}


def _cases(traced: Traced) -> dict[str, list[Any]]:
    """The outlier decisions by sequence, if there are several, and of all pairs."""
    from torchcrf_scan.evaluation.causes.outliers import OutlierCase

    cases = [OutlierCase.of(pair, answer) for pair, answer in zip(traced.pairs, traced.answers, strict=True)]
    names = sorted({pair.sequence for pair in traced.pairs})
    rows = {
        name or "no sequence": [case for case, pair in zip(cases, traced.pairs, strict=True) if pair.sequence == name]
        for name in names
    }
    return {**(rows if len(rows) > 1 else {}), "all, one gate": cases}


def _draw(traced: Traced, numbers: Sequence[int], folder: Path) -> None:
    """Pictures of some pairs, named by their rank and name."""
    from torchcrf_scan.viz.plots import plot_pair, save_figure

    for rank, b in enumerate(numbers, 1):
        pair = traced.pairs[b]
        save_figure(plot_pair(pair, traced.answers[b]), str(folder / f"{rank:02d}_{file_name(pair.name)}.png"))
