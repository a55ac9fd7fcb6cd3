"""Times of learning: one fold of the experiment, all folds, and a pass over a thousand pairs."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from typing import Any, TypeVar

import torch

from torchcrf_scan.batch import ScanPairBatch
from torchcrf_scan.benchmark.timing import threads_kept
from torchcrf_scan.config import ModelConfig
from torchcrf_scan.experiment.cross_validation import cores
from torchcrf_scan.learning.calibration_fit import calibrate
from torchcrf_scan.learning.fit import fit
from torchcrf_scan.learning.material import collect
from torchcrf_scan.learning.settings import LearningConfig
from torchcrf_scan.model import JointScanCRF
from torchcrf_scan.scan import ScanPair

T = TypeVar("T")
FOLDS = 31
PASS = 1000
ROUNDS, BATCHES = 3, (1, 32)  # of the unrolled layer, motions soft


def time_training(pairs: Sequence[ScanPair], config: ModelConfig, learning: LearningConfig) -> list[dict[str, Any]]:
    """Rows of `stage`, `seconds` and `pairs`, on one thread, as folds run; each part is timed once.

    Pairs are surveyed once for all folds; a fold fits the movers' score, scales, boosters, weights, the potential of movers and
    the calibration. A training pass is the pseudo-likelihood and its gradient. The rows of all folds and of the pass are scaled.
    """
    with threads_kept():
        torch.set_num_threads(1)
        return _rows(pairs, config, learning)


def _rows(pairs: Sequence[ScanPair], config: ModelConfig, learning: LearningConfig) -> list[dict[str, Any]]:
    collection, looking = _timed(lambda: collect(pairs, learning))

    def fit_fold() -> JointScanCRF:
        everything = range(len(collection))
        model = JointScanCRF(config)
        model.hypothesis_score = collection.fit_score(everything)
        material = collection.material(everything, model.hypothesis_score, config.inference.clusters - 1, learning)
        fit(model, material, learning)
        calibrate(model, material)
        return model

    model, fold = _timed(fit_fold)
    size = learning.batch_size
    parts = [collection.batch[begin : begin + size] for begin in range(0, len(pairs), size)]

    def look_once() -> None:
        for part in parts:
            (-model.pseudo_log_likelihood(part).sum()).backward()

    _, once = _timed(look_once)
    per_pair, count = looking / len(pairs), len(pairs)
    everywhere = per_pair * FOLDS / cores(0) + math.ceil(FOLDS / cores(0)) * fold
    projected = f"projected from fit_fold on {count} pairs: {FOLDS} folds on {cores(0)} cores, without baselines and tables"
    rows = [
        ("look_at_pair", per_pair, 1, "InitialiseRT and the views of the movers' score"),
        ("fit_fold", fold, count, "without looking at the pairs, which all folds share"),
        (f"leave_one_out_{FOLDS}", everywhere, FOLDS, projected),
        (f"training_pass_{PASS}", once * PASS / count, PASS, f"pseudo-likelihood and its gradient, scaled from {count} pairs"),
        *(
            (f"rounds_{size}", _rounds(pairs, size), size, f"{ROUNDS} rounds forward and backward, from a given start")
            for size in BATCHES
        ),
    ]
    return [dict(zip(("stage", "seconds", "pairs", "note"), row, strict=True), threads=1) for row in rows]


def _rounds(pairs: Sequence[ScanPair], size: int) -> float:
    """Seconds of the unrolled rounds with gradient for a batch of a given size; the second of two calls."""
    model = JointScanCRF.from_pretrained(motion_weights="soft", stop_early=False, iterations=ROUNDS)
    batch = ScanPairBatch.collate([pairs[k % len(pairs)] for k in range(size)]).without_truth()
    start = model.initialise(batch)

    def once() -> None:
        answer = model(batch, start)
        (answer.log_cluster[batch.source_mask].exp().sum() + answer.motions.square().sum()).backward()

    once()
    return _timed(once)[1]


def _timed(run: Callable[[], T]) -> tuple[T, float]:
    began = time.process_time()
    made = run()
    return made, time.process_time() - began
