"""Pairs and answers that cost nothing, for tests of how an experiment is run."""

from collections.abc import Sequence

import numpy as np

from torchcrf_scan.experiment import cross_validation
from torchcrf_scan.experiment.methods import Answer
from torchcrf_scan.experiment.models import JOINT, Models
from torchcrf_scan.experiment.study import Study
from torchcrf_scan.scan import Annotation, PairPrediction, Scan, ScanPair

BEAMS = 12
RIVAL = "start + gated NN"


def make_pairs(*sequences: str) -> list[ScanPair]:
    """One pair for each name; half of the points stand still, the others move half a metre to the left."""
    association = np.append(np.arange(BEAMS - 1), -1)
    cluster = np.where(association < 0, -1, (np.arange(BEAMS) >= BEAMS // 2).astype(np.int64))
    motions = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 0.5]])
    pairs = []
    for k, sequence in enumerate(sequences):
        source = Scan.from_ranges(5.0 + 0.1 * np.sin(np.arange(BEAMS) + k), np.linspace(-0.5, 0.5, BEAMS))
        annotation = Annotation(association, cluster, motions, np.maximum(cluster, 0), np.zeros(BEAMS, dtype=bool))
        pairs.append(ScanPair(source, source, annotation=annotation, sequence=sequence, name=f"pair {k}"))
    return pairs


def guess(pair: ScanPair, mistakes: int, number: float = 0.0) -> PairPrediction:
    """The truth but for some clusters; `number` is hidden in the background's motion."""
    truth = pair.annotation
    assert truth is not None
    cluster = truth.cluster.copy()
    cluster[:mistakes] = 1
    motions = truth.motions.copy()
    motions[0, 1] = number
    ones = np.ones(BEAMS)
    return PairPrediction(truth.association, cluster, motions, ones, ones, True)


def make_study(pairs: Sequence[ScanPair]) -> Study:
    return Study(tuple(pairs), None, np.zeros((len(pairs), 1)))  # type: ignore[arg-type]


class Recorder:
    """Takes the place of fitting and answering; remembers which folds it was asked for, and fails where it is told to."""

    def __init__(self, fail_at: str = "") -> None:
        self.trained: list[tuple[int, ...]] = []
        self.asked: list[str] = []
        self.variants: list[bool] = []
        self.fail_at = fail_at

    def fit_models(self, study: Study, train: Sequence[int], config: object, variants: bool) -> Models:
        self.trained.append(tuple(train))
        self.variants.append(variants)
        return Models({})

    def answer(self, models: Models, pair: ScanPair) -> dict[str, Answer]:
        self.asked.append(pair.name)
        if pair.name == self.fail_at:
            raise KeyboardInterrupt
        number = float(pair.name.split()[-1])
        return {RIVAL: Answer(guess(pair, 1, number), 0.1 + number), JOINT: Answer(guess(pair, int(number)), 1.0 + number)}

    def install(self, monkeypatch: object = None) -> None:
        """Into the module under test; for good without a monkeypatch."""
        patch = monkeypatch.setattr if monkeypatch is not None else setattr  # type: ignore[attr-defined]
        patch(cross_validation, "fit_models", self.fit_models)
        patch(cross_validation, "answer", self.answer)
