"""`torchcrf-scan evaluate`: the tables of predictions, read from files or made by a method."""

from __future__ import annotations

import json as json_format
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import torch
from tqdm import tqdm

from torchcrf_scan.baselines.register import by_command
from torchcrf_scan.baselines.start import match_start, match_static
from torchcrf_scan.batch import batches
from torchcrf_scan.commands import frames
from torchcrf_scan.commands.arguments import BATCH, annotated_pairs, load_model
from torchcrf_scan.commands.causes import check as check_causes
from torchcrf_scan.commands.causes import explain
from torchcrf_scan.commands.frames import FrameOffset, Turn, match_displaced
from torchcrf_scan.commands.rounds import tell_rounds
from torchcrf_scan.commands.sequences import by_sequence, figures_of, rows_of, without_nan
from torchcrf_scan.data.pair_file import read_prediction
from torchcrf_scan.errors import TorchCRFScanError
from torchcrf_scan.model import JointScanCRF
from torchcrf_scan.pretrained import PRETRAINED
from torchcrf_scan.scan import PairPrediction, ScanPair
from torchcrf_scan.whole_file import make_folder, write_whole

if TYPE_CHECKING:
    from torchcrf_scan.evaluation.metrics import PairScore
    from torchcrf_scan.evaluation.neighbours import NeighbourScore
    from torchcrf_scan.evaluation.table import Table

Item = TypeVar("Item")
Method = Callable[[Sequence[ScanPair]], list[PairPrediction]]
Loader = Callable[[], JointScanCRF]

FAR_TRANSLATION, FAR_ROTATION = 0.2, 0.02  # metres, radians: success bounds of the ego motion with displaced frames


def one_by_one(match: Callable[[ScanPair], PairPrediction]) -> Callable[[Loader], Method]:
    """A method from a baseline of single pairs."""
    return lambda load: lambda pairs: [match(pair) for pair in pairs]


METHODS: dict[str, Callable[[Loader], Method]] = {
    "joint": lambda load: load().match_pairs,
    "start": lambda load: partial(match_start, load()),
    "static": lambda load: match_static,
    **{name: one_by_one(match) for name, match in by_command().items()},
}


def evaluate(
    pair_files: list[str],
    *,
    predictions: str | None = None,
    method: str | None = None,
    model: str | None = None,
    json: str | None = None,
    frame_offset: float | None = None,
    frame_turn: Turn | None = None,
    seed: int = 0,
    causes: bool = False,
    rounds: bool = False,
    worst: int = 6,
    output: str | None = None,
    candidates: int | None = None,
    outlier_distance: float | None = None,
    device: str = "cpu",
    threads: int | None = None,
) -> int:
    """Scores predictions of annotated pairs: overview, the paper's Tables I to III, calibration, flow; by sequence and in all.

    The predictions are read from files, or made by a method. With `--frame_offset` or `--frame_turn` the method (joint or start)
    gets every second scan in another frame, unknowingly; a table shows how often the ego motion is right all the same.

    Args:
        pair_files: pair files with annotation
        predictions: folder of prediction files named like the pair files, instead of a method
        method: joint (the model, default), start (its start and nearest points, no field), static (nothing moves), background
            (one registration, all of it background), icp (the paper's) or ransac (registration, then movers by RANSAC)
        model: folder of a saved model, or the name of one that the package ships; encoder by default
        json: file for all metrics with all digits
        frame_offset: metres by which the second scan's frame is displaced, exactly, in a random direction
        frame_turn: radians by which it is turned, exactly, to a random side; or any, uniform over the whole circle
        seed: seed of the random directions and sides
        causes: also where wrong points come from (joint alone)
        rounds: also the course of the joint objective over the rounds, and whether they converge (joint alone)
        worst: with --causes, number of pairs with the most wrong points to name
        output: with --causes, folder for its tables (causes.md) and pictures of the worst pairs
        candidates: target points considered for each source point, 0 for all; by default as the model was saved
        outlier_distance: metres; points farther from all target points under their own motion are outliers; default: as saved
        device: device that torch computes on, e.g. cpu or cuda
        threads: number of threads that torch computes with; by default its own choice
    """
    _check_read(predictions, (method, model), (candidates, outlier_distance))
    displacement = _displacement(frame_offset, frame_turn, predictions)
    check_causes(output, worst, causes)
    _check_joint({"--causes": causes, "--rounds": rounds}, method, (predictions, displacement))
    if json is not None:
        make_folder("--json", Path(json).parent)
    pairs = annotated_pairs(pair_files)
    load = partial(load_model, PRETRAINED if model is None else model, candidates, device, threads, outlier_distance)
    name = "joint" if method is None else method
    if predictions is not None:
        name, answers = Path(predictions).resolve().name, _read_predictions(list(pairs), Path(predictions))
    else:
        answers = _run(name, load, list(pairs.values()), displacement, seed)
    tables, figures = _score(name, list(pairs.values()), answers, displacement, seed)
    more, counts = _looks(load, list(pairs.values()), (causes, rounds), worst, output)
    _tell(tables + more, figures | counts, json)
    return 0


def _looks(
    load: Loader, pairs: Sequence[ScanPair], asked: tuple[bool, bool], worst: int, output: str | None
) -> tuple[list[Table], dict[str, Any]]:
    """Tables and entries of `--json` of `--causes` and of `--rounds`, if asked for."""
    tables, figures = explain(load(), pairs, worst, output) if asked[0] else ([], {})
    more, courses = tell_rounds(load(), pairs) if asked[1] else ([], {})
    return tables + more, figures | courses


def _tell(tables: Sequence[Table], figures: dict[str, Any], path: str | None) -> None:
    """Prints the tables; writes the figures."""
    print("\n".join(table.to_markdown() for table in tables), end="")
    if path is not None:
        write_whole(Path(path), json_format.dumps(figures, indent=2) + "\n")


def _score(
    name: str, pairs: Sequence[ScanPair], answers: Sequence[PairPrediction], displacement: FrameOffset | None, seed: int
) -> tuple[list[Table], dict[str, Any]]:
    """All tables and the entries of `--json`."""
    from torchcrf_scan.evaluation.metrics import score_pairs
    from torchcrf_scan.evaluation.neighbours import NeighbourScore, neighbour_tables
    from torchcrf_scan.evaluation.report import report

    scores = score_pairs(pairs, answers)
    beside = [NeighbourScore.of(pair, answer) for pair, answer in zip(pairs, answers, strict=True)]
    tables, figures = [*report(rows_of(name, scores)), *neighbour_tables(rows_of(name, beside))], _figures(name, scores, beside)
    if displacement is not None:
        tables.append(_displaced_table(displacement, rows_of(name, scores)))
        figures |= _displaced_figures(displacement, seed, scores)
    return tables, figures


def _check_read(predictions: str | None, method: tuple[str | None, ...], settings: tuple[float | None, ...]) -> None:
    """Refuses what has no meaning for predictions that are read. method: also the model. settings: of the model."""
    if predictions is not None and any(given is not None for given in method):
        raise TorchCRFScanError("--predictions: expected no --method and no --model beside it, got both")
    if predictions is not None and any(given is not None for given in settings):
        raise TorchCRFScanError(
            "--predictions: expected no --candidates and no --outlier_distance beside it, as nothing is computed"
        )


def _check_joint(asked: dict[str, bool], method: str | None, others: tuple[object, ...]) -> None:
    """Refuses what is told of the model's own answers alone, by option, beside another method. others: must be None."""
    for option in [name for name, is_asked in asked.items() if is_asked]:
        if method not in (None, "joint") or any(other is not None for other in others):
            raise TorchCRFScanError(
                f"{option}: expected --method joint, no --predictions and no displaced frames beside it, got others"
            )


def _displacement(metres: float | None, turn: Turn | None, predictions: str | None) -> FrameOffset | None:
    """The displacement from `--frame_offset` and `--frame_turn`, a missing one being 0; None without either."""
    if metres is None and turn is None:
        return None
    if predictions is not None:
        raise TorchCRFScanError("--frame_offset, --frame_turn: expected no --predictions beside them, got both")
    return FrameOffset(metres or 0.0, turn or 0.0)


def _read_predictions(paths: Sequence[Path], folder: Path) -> list[PairPrediction]:
    files = [folder / f"{path.stem}.npz" for path in paths]
    missing = [file for file in files if not file.is_file()]
    if missing:
        got = f"none for {len(missing)} of {len(files)}, the first {missing[0].name}"
        raise TorchCRFScanError(f"--predictions {folder}: expected a file for every pair, got {got}")
    return [read_prediction(file) for file in files]


def _run(name: str, load: Loader, pairs: Sequence[ScanPair], displacement: FrameOffset | None, seed: int) -> list[PairPrediction]:
    if name not in METHODS:
        raise TorchCRFScanError(f"--method: expected one of {', '.join(METHODS)}, got {name}")
    if displacement is None:
        return _in_batches(METHODS[name](load), pairs)
    if name not in frames.METHODS:
        raise TorchCRFScanError(
            f"--method: expected one of {', '.join(frames.METHODS)} with --frame_offset or --frame_turn, got {name}"
        )
    offsets = displacement.draw(len(pairs), torch.Generator().manual_seed(seed))
    return _in_batches(partial(match_displaced, name, load()), list(zip(pairs, offsets, strict=True)))


def _in_batches(method: Callable[[Sequence[Item]], list[PairPrediction]], items: Sequence[Item]) -> list[PairPrediction]:
    found: list[PairPrediction] = []
    with tqdm(total=len(items), unit="pair", disable=None) as bar:
        for part in batches(items, BATCH):
            found += method(part)
            bar.update(len(part))
    return found


def _displaced_table(displacement: FrameOffset, rows: dict[str, list[PairScore]]) -> Table:
    """Share of ego motions found with displaced frames."""
    from torchcrf_scan.evaluation.table import Table

    heading = f"ego within {100 * FAR_TRANSLATION:.0f} cm and {FAR_ROTATION:g} rad (%)"
    shares = tuple((name, _found_from_afar(scores)) for name, scores in rows.items())
    return Table(f"The second scan's frame {displacement}", ("method", heading), shares, (0, 1))


def _displaced_figures(displacement: FrameOffset, seed: int, scores: Sequence[PairScore]) -> dict[str, Any]:
    """Additional entries of `--json`: the displacement and the share of ego motions found."""
    sequences = {sequence: _found_from_afar(part) for sequence, part in by_sequence(scores).items()}
    found = {"all": _found_from_afar(scores), "sequences": sequences}
    return {"displaced": {"metres": displacement.metres, "turn": displacement.turn, "seed": seed, "ego_success": found}}


def _found_from_afar(scores: Sequence[PairScore]) -> float:
    """Percentage of the known ego motions found within `FAR_TRANSLATION` and `FAR_ROTATION`."""
    known = [score for score in scores if score.has_ego_truth]
    return 100 * sum(score.has_ego_within(FAR_TRANSLATION, FAR_ROTATION) for score in known) / max(len(known), 1)


def _figures(name: str, scores: Sequence[PairScore], beside: Sequence[NeighbourScore]) -> dict[str, Any]:
    """Entries of `--json`: `method`, `all` and `sequences`, all metrics of both summaries, `ranges`; null for missing values."""
    from torchcrf_scan.evaluation.neighbours import errors_by_range, summarise_neighbours
    from torchcrf_scan.evaluation.summary import summarise

    ours, theirs = figures_of(scores, summarise), figures_of(beside, summarise_neighbours)
    sequences = {sequence: figures | theirs["sequences"][sequence] for sequence, figures in ours["sequences"].items()}
    ranges = {name: without_nan(row) for name, row in errors_by_range(beside).items()}
    return {"method": name, "all": ours["all"] | theirs["all"], "sequences": sequences, "ranges": ranges}
