"""Labels to draw: by source beam, movers numbered as the true ones, with the mistakes to mark."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from torchcrf_scan.errors import TorchCRFScanError
from torchcrf_scan.evaluation.counterparts import annotation_of, beams_apart, match_movers
from torchcrf_scan.scan import BACKGROUND, OUTLIER, Annotation, Bools, Floats, Ints, PairPrediction, ScanPair

ASSOCIATION_TOLERANCE = 2  # beams; associations within this distance are drawn as right


@dataclass(frozen=True, slots=True)
class Labels:
    """Labels of a pair by source beam, movers numbered as the annotation's if they match; unknown motions are NaN."""

    association: Ints
    cluster: Ints
    motions: Floats

    @property
    def movers(self) -> Ints:
        """(K,) numbers of the movers that occur, ascending."""
        return np.unique(self.cluster[self.cluster > BACKGROUND])

    def motion(self, cluster: int) -> Floats:
        """(3,) the motion of a cluster, NaN where it is unknown."""
        return self.motions[cluster] if cluster < len(self.motions) else np.full(3, np.nan)


@dataclass(frozen=True, slots=True)
class Answer:
    """Labels with a name and masks of wrong associations and clusters; None without an annotation."""

    name: str
    labels: Labels
    wrong_association: Bools | None = None
    wrong_cluster: Bools | None = None


def true_labels(pair: ScanPair) -> Labels | None:
    """The annotated labels, None without an annotation."""
    return None if pair.annotation is None else _labels(pair, "annotation", pair.annotation)


def predicted_labels(pair: ScanPair, name: str, prediction: PairPrediction, truth: Labels | None) -> Labels:
    """The predicted labels, movers numbered as the true ones; raises TorchCRFScanError if they do not fit the pair."""
    labels = _labels(pair, name, prediction)
    return labels if truth is None else _renumber(labels, truth)


def _labels(pair: ScanPair, name: str, given: Annotation | PairPrediction) -> Labels:
    association, cluster = np.asarray(given.association), np.asarray(given.cluster)
    motions = np.asarray(given.motions, dtype=np.float64)
    for key, values in (("association", association), ("cluster", cluster)):
        if values.shape != (pair.source.n_beams,):
            raise TorchCRFScanError(f"{name}.{key}: expected shape ({pair.source.n_beams},), got {values.shape}")
    if (association >= pair.target.n_beams).any():
        raise TorchCRFScanError(f"{name}.association: expected indices below {pair.target.n_beams}, got {association.max()}")
    return Labels(association, cluster, motions.reshape(-1, 3))


def _renumber(labels: Labels, truth: Labels) -> Labels:
    """Gives every mover the number of the true one it overlaps most (one to one, maximum total overlap), others new numbers."""
    matched = {theirs: ours for ours, theirs in match_movers(truth.cluster, labels.cluster).items()}
    first_new = max([len(truth.motions) - 1, *truth.movers.tolist(), 0]) + 1
    new = {k: first_new + i for i, k in enumerate(k for k in labels.movers.tolist() if k not in matched)}
    cluster, motions = labels.cluster.copy(), np.full((first_new + len(new), 3), np.nan)
    motions[BACKGROUND] = labels.motion(BACKGROUND)
    for old, number in (matched | new).items():
        cluster[labels.cluster == old] = number
        motions[number] = labels.motion(old)
    return Labels(labels.association, cluster, motions)


def judge(name: str, drawn: Labels, pair: ScanPair, guess: Labels, truth: Labels) -> Answer:
    """The labels `drawn` with the mistakes of `guess`; unannotated points are never mistakes."""
    known = ~annotation_of(pair).ignore
    known &= pair.source.to_beams(np.ones(len(pair.source), dtype=bool), False)
    near = beams_apart(pair.target, guess.association, truth.association) <= ASSOCIATION_TOLERANCE
    return Answer(name, drawn, known & ~near, known & (guess.cluster != truth.cluster))


def all_answers(pair: ScanPair, predictions: Mapping[str, PairPrediction], before: Labels | None = None) -> list[Answer]:
    """The methods' labels in their order, then the true ones; raises TorchCRFScanError if there are none.

    before: true labels that the pair's are numbered after, see `carried_on`; None: numbers of the annotation.
    """
    truth = true_labels(pair)
    if truth is None and not predictions:
        raise TorchCRFScanError("predictions: expected at least one method for a pair without annotation, got none")
    if truth is not None and before is not None:
        truth = _renumber(truth, before)
    answers = []
    for name, prediction in predictions.items():
        guess = predicted_labels(pair, name, prediction, truth)
        answers.append(Answer(name, guess) if truth is None else judge(name, guess, pair, guess, truth))
    return answers if truth is None else [*answers, Answer("truth", truth)]


def carried_on(labels: Labels, pair: ScanPair) -> Labels:
    """The labels by target beam, as the associations carry them: those that the next pair's source should get."""
    associated = labels.association >= 0
    cluster = np.full(pair.target.n_beams, OUTLIER, dtype=labels.cluster.dtype)
    cluster[labels.association[associated]] = labels.cluster[associated]
    return Labels(np.full_like(cluster, OUTLIER), cluster, labels.motions)
