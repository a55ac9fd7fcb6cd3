"""The rows of the tables: what every method answers for a pair that its models have not seen."""

from __future__ import annotations

import copy
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TypeVar

import torch

from torchcrf_scan.baselines.register import BASELINES, Case, installed
from torchcrf_scan.batch import ScanPairBatch
from torchcrf_scan.config import ModelConfig
from torchcrf_scan.experiment.models import ENCODED, EXACT, JOINT, LATTICE, LATTICE_EXACT, Models
from torchcrf_scan.inference.pseudo_likelihood import true_plugins
from torchcrf_scan.inference.start import Start, nearest_association
from torchcrf_scan.learning.plugins import reach_of_truth
from torchcrf_scan.model import JointScanCRF
from torchcrf_scan.scan import PairPrediction, ScanPair

HELD_ROUNDS = 10  # of the model whose motions are given
TRUE_MOTIONS, TRUE_ASSOCIATIONS = "joint, true motions", "joint, true associations"
METHODS = (
    *BASELINES,
    *(JOINT, ENCODED, EXACT, LATTICE, LATTICE_EXACT, TRUE_MOTIONS, TRUE_ASSOCIATIONS),
)  # rows of every table, in this order

Result = TypeVar("Result")


@dataclass(frozen=True, slots=True)
class Answer:
    """A method's prediction and the seconds that it took, the shared start included."""

    prediction: PairPrediction
    seconds: float

    @classmethod
    def of(cls, run: Callable[[], PairPrediction], before: float = 0.0) -> Answer:
        """The answer of a method. before: seconds of what it goes on from."""
        prediction, seconds = timed(run)
        return cls(prediction, before + seconds)


@torch.no_grad()
def answer(models: Models, pair: ScanPair) -> dict[str, Answer]:
    """Every method's answer for an annotated pair, timed one by one. The truth is told to the two rows that name it alone."""
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
    """The answers of the baselines that are installed. start_seconds: that the start took."""
    found: dict[str, Answer] = {}
    for row, baseline in installed().items():
        before = found[baseline.after].seconds if baseline.after else start_seconds if baseline.from_start else 0.0
        found[row] = Answer.of(lambda baseline=baseline: baseline.match(case), before)  # type: ignore[misc]
        case.answers[row] = found[row].prediction
    return found


def answer_told(joint: JointScanCRF, pair: ScanPair, annotated: ScanPairBatch, start: Start, seconds: float) -> dict[str, Answer]:
    """The joint model with the true motions, and with the true associations: what the other half would do by itself."""
    batch, at_truth = annotated.without_truth(), with_motions_given(joint)
    told = with_config(joint, replace(joint.config, chains="clustering", coupling="motions"))
    associated = replace(start, association=annotated.truth.association)  # type: ignore[union-attr]
    return {
        TRUE_MOTIONS: Answer.of(lambda: at_truth(batch, true_start(annotated, start)).pair(0, pair)),
        TRUE_ASSOCIATIONS: Answer.of(lambda: told(batch, associated).pair(0, pair), seconds),
    }


def timed(run: Callable[[], Result]) -> tuple[Result, float]:
    """The result, and the seconds that it took."""
    began = time.perf_counter()
    result = run()
    return result, time.perf_counter() - began


def with_config(model: JointScanCRF, config: ModelConfig) -> JointScanCRF:
    """The same weights under another config."""
    other = copy.copy(model)
    other.config = config
    return other


def with_motions_given(model: JointScanCRF) -> JointScanCRF:
    """The same model, its motions held where they start; labels that swing have no motions to be damped, so its rounds are few."""
    rounds = min(model.config.inference.iterations, HELD_ROUNDS)
    inference = replace(model.config.inference, motion_metric="given", schedule="sweep", iterations=rounds)
    return with_config(model, replace(model.config, inference=inference))


def true_start(batch: ScanPairBatch, found: Start) -> Start:
    """The annotated motions of as many movers as there is room for, `batch` being annotated."""
    truth = true_plugins(batch, found.motions.shape[1])
    reach = reach_of_truth(truth, batch)
    association = nearest_association(batch, truth.motions, truth.active, reach)
    return Start(truth.motions, truth.active, association, found.target_tangents, reach)
