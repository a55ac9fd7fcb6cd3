"""The rows of the tables: predictions of every method for a pair left out of its models' training."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TypeVar

import torch

from torchcrf_scan.baselines.register import BASELINES, Case, installed
from torchcrf_scan.batch import ScanPairBatch
from torchcrf_scan.experiment.models import ENCODED, EXACT, JOINT, LATTICE, LATTICE_EXACT, Models
from torchcrf_scan.inference.pseudo_likelihood import true_plugins
from torchcrf_scan.inference.start import Start, nearest_association
from torchcrf_scan.learning.plugins import reach_of_truth
from torchcrf_scan.model import JointScanCRF, with_config
from torchcrf_scan.scan import PairPrediction, ScanPair

HELD_ROUNDS = 10  # of the model with given motions
TRUE_MOTIONS, TRUE_ASSOCIATIONS = "joint, true motions", "joint, true associations"
METHODS = (
    *BASELINES,
    *(JOINT, ENCODED, EXACT, LATTICE, LATTICE_EXACT, TRUE_MOTIONS, TRUE_ASSOCIATIONS),
)  # rows of every table, in this order

Result = TypeVar("Result")


@dataclass(frozen=True, slots=True)
class Answer:
    """A method's prediction and its run time in seconds, the shared start included."""

    prediction: PairPrediction
    seconds: float

    @classmethod
    def of(cls, run: Callable[[], PairPrediction], before: float = 0.0) -> Answer:
        """The answer of a method. before: seconds of the results that it builds on."""
        prediction, seconds = timed(run)
        return cls(prediction, before + seconds)


@torch.no_grad()
def answer(models: Models, pair: ScanPair) -> dict[str, Answer]:
    """Every method's answer for an annotated pair, timed one by one. Only the two oracle rows use the annotation."""
    annotated = ScanPairBatch.collate([pair])
    batch = annotated.without_truth()
    start, seconds = timed(lambda: models.joint[JOINT].initialise(batch))
    found: dict[str, Answer] = {}
    if models.cascade is not None:
        found |= answer_baselines(Case(pair, batch, start, models.cascade, models.icp_gate), seconds)
    for name, model in models.joint.items():
        found[name] = Answer.of(lambda model=model: model(batch, start).pair(0, pair), seconds)  # type: ignore[misc]
    if models.cascade is not None:
        found |= answer_told(models.joint[JOINT], pair, annotated, start, seconds)
    return found


def answer_baselines(case: Case, start_seconds: float) -> dict[str, Answer]:
    """The answers of the installed baselines. start_seconds: run time of the start."""
    found: dict[str, Answer] = {}
    for row, baseline in installed().items():
        before = found[baseline.after].seconds if baseline.after else start_seconds if baseline.from_start else 0.0
        found[row] = Answer.of(lambda baseline=baseline: baseline.match(case), before)  # type: ignore[misc]
        case.answers[row] = found[row].prediction
    return found


def answer_told(joint: JointScanCRF, pair: ScanPair, annotated: ScanPairBatch, start: Start, seconds: float) -> dict[str, Answer]:
    """The joint model with the true motions, and with the true associations: oracles that isolate one half of the problem."""
    batch, at_truth = annotated.without_truth(), with_motions_given(joint)
    told = with_config(joint, replace(joint.config, chains="clustering", coupling="motions"))
    associated = replace(start, association=annotated.truth.association)  # type: ignore[union-attr]
    return {
        TRUE_MOTIONS: Answer.of(lambda: at_truth(batch, true_start(annotated, start)).pair(0, pair)),
        TRUE_ASSOCIATIONS: Answer.of(lambda: told(batch, associated).pair(0, pair), seconds),
    }


def timed(run: Callable[[], Result]) -> tuple[Result, float]:
    """The result, and its run time in seconds."""
    began = time.perf_counter()
    result = run()
    return result, time.perf_counter() - began


def with_motions_given(model: JointScanCRF) -> JointScanCRF:
    """The same model with motions fixed at the start; few rounds, as oscillating labels cannot be damped through motions."""
    rounds = min(model.config.inference.iterations, HELD_ROUNDS)
    inference = replace(model.config.inference, motion_metric="given", schedule="sweep", iterations=rounds)
    return with_config(model, replace(model.config, inference=inference))


def true_start(batch: ScanPairBatch, found: Start) -> Start:
    """The annotated motions as a start, of as many movers as it has slots."""
    truth = true_plugins(batch, found.motions.shape[1])
    reach = reach_of_truth(truth, batch)
    association = nearest_association(batch, truth.motions, truth.active, reach)
    return Start(truth.motions, truth.active, association, found.target_tangents, reach)
