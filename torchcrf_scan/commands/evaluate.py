"""`torchcrf-scan evaluate`: the tables of predictions, from files or made here by a method."""

from __future__ import annotations

import json as json_format
import math
from collections.abc import Callable, Sequence
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tqdm import tqdm

from torchcrf_scan.baselines.start import match_start, match_static
from torchcrf_scan.commands.arguments import batches, find_files, load_model, make_folder
from torchcrf_scan.data.pair_file import read_pair, read_prediction
from torchcrf_scan.model import PRETRAINED, JointScanCRF
from torchcrf_scan.scan import PairPrediction, ScanPair

if TYPE_CHECKING:
    from torchcrf_scan.evaluation.metrics import PairScore

Method = Callable[[Sequence[ScanPair]], list[PairPrediction]]
Loader = Callable[[], JointScanCRF]


def one_by_one(module: str, name: str) -> Method:
    """A baseline that takes one pair, imported when it is asked for: it needs scipy."""
    match = getattr(import_module(f"torchcrf_scan.baselines.{module}"), name)
    return lambda pairs: [match(pair) for pair in pairs]


METHODS: dict[str, Callable[[Loader], Method]] = {
    "joint": lambda load: load().match_pairs,
    "start": lambda load: partial(match_start, load()),
    "static": lambda load: match_static,
    "background": lambda load: one_by_one("icp", "match_background"),
    "icp": lambda load: one_by_one("icp", "match_icp"),
    "ransac": lambda load: one_by_one("ransac", "match_ransac"),
}


def evaluate(
    files: list[str],
    *,
    predictions: str | None = None,
    method: str | None = None,
    model: str | None = None,
    json: str | None = None,
    candidates: int | None = None,
    device: str = "cpu",
    threads: int | None = None,
) -> int:
    """Prints how good predictions of annotated pairs are: an overview and the paper's Tables I to III, by sequence and in all.

    The predictions are read from files, or made here by a method.

    Args:
        files: pair files with annotation
        predictions: folder of prediction files named like the pair files, instead of a method
        method: joint (the model, where absent), start (its start and nearest points, no field), static (nothing moves), background
            (one registration, all of it background), icp (the paper's) or ransac (registration, then movers by RANSAC)
        model: folder of a saved model, or the name of one that the package ships; simulated where absent
        json: file for all figures with all digits
        candidates: target points considered for each source point, 0 for all; as the model was saved where absent
        device: device that torch computes on, e.g. cpu or cuda
        threads: number of threads that torch computes with; its own choice where absent
    """
    from torchcrf_scan.evaluation.metrics import score_pair
    from torchcrf_scan.evaluation.report import report

    if predictions is not None and (method, model) != (None, None):
        raise ValueError("--predictions: expected no --method and no --model beside it, got both")
    if json is not None:
        make_folder("--json", Path(json).parent)
    pairs = _annotated_pairs(files)
    if predictions is not None:
        name, answers = Path(predictions).resolve().name, _read_predictions(list(pairs), Path(predictions))
    else:
        name = "joint" if method is None else method
        load = partial(load_model, PRETRAINED if model is None else model, candidates, device, threads)
        answers = _run(name, load, list(pairs.values()))
    scores = [score_pair(pair, answer) for pair, answer in zip(pairs.values(), answers, strict=True)]
    print("\n".join(table.to_markdown() for table in report(_rows(name, scores))), end="")
    if json is not None:
        Path(json).write_text(json_format.dumps(_figures(name, scores), indent=2) + "\n")
    return 0


def _annotated_pairs(patterns: Sequence[str]) -> dict[Path, ScanPair]:
    pairs = {path: read_pair(path) for path in find_files(patterns)}
    for path, pair in pairs.items():
        if pair.annotation is None:
            raise ValueError(f"{path}: expected an annotated pair (keys association and cluster), got one without")
    return pairs


def _read_predictions(paths: Sequence[Path], folder: Path) -> list[PairPrediction]:
    files = [folder / f"{path.stem}.npz" for path in paths]
    missing = [file for file in files if not file.is_file()]
    if missing:
        got = f"none for {len(missing)} of {len(files)}, the first {missing[0].name}"
        raise ValueError(f"--predictions {folder}: expected a file for every pair, got {got}")
    return [read_prediction(file) for file in files]


def _run(name: str, load: Loader, pairs: Sequence[ScanPair]) -> list[PairPrediction]:
    if name not in METHODS:
        raise ValueError(f"--method: expected one of {', '.join(METHODS)}, got {name}")
    method = METHODS[name](load)
    found: list[PairPrediction] = []
    with tqdm(total=len(pairs), unit="pair", disable=None) as bar:
        for part in batches(pairs):
            found += method(part)
            bar.update(len(part))
    return found


def _by_sequence(scores: Sequence[PairScore]) -> dict[str, list[PairScore]]:
    sequences = sorted({score.sequence for score in scores})
    return {sequence: [score for score in scores if score.sequence == sequence] for sequence in sequences}


def _rows(name: str, scores: list[PairScore]) -> dict[str, list[PairScore]]:
    """Row of a table -> its scores: every sequence, where there are several, then all."""
    rows = {f"{name}, {sequence or 'no sequence'}": part for sequence, part in _by_sequence(scores).items()}
    return {**(rows if len(rows) > 1 else {}), f"{name}, all": scores}


def _figures(name: str, scores: list[PairScore]) -> dict[str, Any]:
    """What `--json` writes: `method`, `all` and `sequences`, every figure of `summarise`, null where there is nothing to tell."""
    from torchcrf_scan.evaluation.summary import summarise

    def figures(part: Sequence[PairScore]) -> dict[str, float | None]:
        return {key: None if math.isnan(value) else value for key, value in summarise(part).items()}

    return {"method": name, "all": figures(scores), "sequences": {k: figures(part) for k, part in _by_sequence(scores).items()}}
