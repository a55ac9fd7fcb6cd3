"""Scores of a prediction of one pair: counts and errors (spec 8, A-21 to A-23, A-27). `summary` averages over pairs.

Only valid annotated returns are scored. Indices are beams, as in pair and prediction files. Movers are matched to the true
ones by maximum overlap, background and outlier are fixed.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from rapidfuzz.distance import Levenshtein

from torchcrf_scan.errors import TorchCRFScanError
from torchcrf_scan.evaluation.calibration import Sureness
from torchcrf_scan.evaluation.counterparts import annotation_of, beams_apart, match_movers, relabel
from torchcrf_scan.evaluation.measures import EVERY, Count, Labelled
from torchcrf_scan.geometry import se2
from torchcrf_scan.scan import BACKGROUND, OUTLIER, Annotation, Bools, Floats, Ints, PairPrediction, ScanPair

MOVER_MIN_POINTS = 5  # movers with fewer inlier points are not counted in the detection rate
FOUND_IOU = 0.5


@dataclass(frozen=True, slots=True)
class LabelScore:
    """Predicted labels compared with the true ones, in points.

    Attributes:
        points: scored points.
        right: points with the true label, the outlier being a label (spec 8.1, 8.2).
        sed1, sed2: edit distances of the strings with substitutions at cost 1 and 2 (spec 8.3).
        outliers_predicted, outliers_true, outliers_both: predicted outliers, true outliers, and both (spec 8.4).
    """

    points: int
    right: int
    sed1: int
    sed2: int
    outliers_predicted: int
    outliers_true: int
    outliers_both: int


@dataclass(frozen=True, slots=True)
class MotionError:
    """Error of one rigid motion.

    Attributes:
        rotation: radians.
        translation: metres, at the sensor's origin.
        centroid: error of the object's moved centroid, metres (independent of the choice of origin).
    """

    rotation: float
    translation: float
    centroid: float


@dataclass(frozen=True, slots=True)
class ObjectScore:
    """A true object (background or mover) and the predicted cluster matched to it.

    Attributes:
        cluster: the true object's number, 0 for the background.
        points: its inlier points.
        predicted_points: points of the matched cluster, 0 without a match.
        overlap: points of both.
        error: None when the true or the predicted motion is unknown.
    """

    cluster: int
    points: int
    predicted_points: int
    overlap: int
    error: MotionError | None

    @property
    def is_mover(self) -> bool:
        """Whether it is not the background."""
        return self.cluster != BACKGROUND

    @property
    def is_counted(self) -> bool:
        """Whether it is a mover large enough to count in the detection rate."""
        return self.is_mover and self.points >= MOVER_MIN_POINTS

    @property
    def is_found(self) -> bool:
        """Whether the matched cluster has an IoU of at least 0.5."""
        return self.overlap >= FOUND_IOU * (self.points + self.predicted_points - self.overlap)

    @property
    def is_correct(self) -> bool:
        """Whether recall and precision of the matched cluster are at least 0.5 (A-23)."""
        return self.overlap > 0 and 2 * self.overlap >= max(self.points, self.predicted_points)


@dataclass(frozen=True, slots=True)
class PairScore:
    """All scores of one pair; `summary.summarise` averages them over pairs.

    Attributes:
        association: score of the associations.
        cluster: score of the cluster labels after matching.
        within_1, within_2: points at most 1, 2 target beams off; true outliers must be predicted as outliers.
        counts: numerator and denominator of each of `measures.EVERY`.
        moving_both, moving_either: points moving by truth and prediction, by truth or prediction, among those of known `body`.
        has_ego_truth: whether the background's true motion is known.
        ego_rotation, ego_translation: error of the background motion, radians and metres; NaN when it or its truth is unknown.
        objects: background and movers that have inlier points.
        sureness: confidences and whether the labels were right. Ignored in comparisons.
        name, sequence: of the pair.
    """

    association: LabelScore
    cluster: LabelScore
    within_1: int
    within_2: int
    counts: dict[str, Count] = field(hash=False)
    moving_both: int
    moving_either: int
    has_ego_truth: bool
    ego_rotation: float
    ego_translation: float
    objects: tuple[ObjectScore, ...]
    sureness: Sureness = field(compare=False, repr=False)
    name: str = ""
    sequence: str = ""

    def has_ego_within(self, translation: float, rotation: float) -> bool:
        """Whether the error of the ego motion is within these bounds, metres and radians; False when unknown."""
        return self.ego_translation < translation and self.ego_rotation < rotation


def score_pairs(pairs: Sequence[ScanPair], predictions: Sequence[PairPrediction]) -> list[PairScore]:
    """Scores the predictions of annotated pairs, as many as pairs; raises TorchCRFScanError as `score_pair`."""
    return [score_pair(pair, prediction) for pair, prediction in zip(pairs, predictions, strict=True)]


def score_pair(pair: ScanPair, prediction: PairPrediction) -> PairScore:
    """Scores the prediction of an annotated pair.

    Raises:
        TorchCRFScanError: a pair without annotation, or a prediction with another number of beams or with invalid target beams.
    """
    truth = _checked_annotation(pair, prediction)
    keep = pair.source.beam[~truth.ignore[pair.source.beam]]  # counter-clockwise, whatever the beams' order
    association, predicted_association = truth.association[keep], prediction.association[keep]
    cluster, predicted_cluster = truth.cluster[keep], prediction.cluster[keep]
    points = pair.source.to_beams(pair.source.points, np.nan)[keep]

    offset = beams_apart(pair.target, association, predicted_association)
    labels = Labelled(pair, association, cluster, truth.body[keep], predicted_association, predicted_cluster)
    matched = match_movers(cluster, predicted_cluster)
    moving = _moving(truth.body[keep], predicted_cluster)
    has_ego_truth, rotation, translation = _ego_error(truth.motions[0], _motion(prediction, BACKGROUND))
    return PairScore(
        association=_label_score(association, predicted_association),
        cluster=_label_score(cluster, relabel(predicted_cluster, cluster, matched)),
        within_1=int((offset <= 1).sum()),
        within_2=int((offset <= 2).sum()),
        counts={key: measure.count(labels) for key, measure in EVERY.items()},
        moving_both=moving[0],
        moving_either=moving[1],
        has_ego_truth=has_ego_truth,
        ego_rotation=rotation,
        ego_translation=translation,
        objects=_object_scores(truth, prediction, cluster, predicted_cluster, points, matched),
        sureness=Sureness.of(pair, prediction),
        name=pair.name,
        sequence=pair.sequence,
    )


def edit_distance(labels: Ints, others: Ints, substitution: int) -> int:
    """Edit distance of two label strings, insertion and deletion at cost 1 (spec 8.3; 2 N - 2 LCS for `substitution` = 2)."""
    return int(Levenshtein.distance((labels + 1).tolist(), (others + 1).tolist(), weights=(1, 1, substitution)))


def _checked_annotation(pair: ScanPair, prediction: PairPrediction) -> Annotation:
    truth, n, m = annotation_of(pair), pair.source.n_beams, pair.target.n_beams
    if prediction.association.shape != (n,) or prediction.cluster.shape != (n,):
        got = f"association {prediction.association.shape} and cluster {prediction.cluster.shape}"
        raise TorchCRFScanError(f"prediction of pair {pair.name!r}: expected labels of all ({n},) source beams, got {got}")
    if n and int(prediction.association.max()) >= m:
        raise TorchCRFScanError(
            f"prediction of pair {pair.name!r}: expected association below {m}, got {prediction.association.max()}"
        )
    return truth


def _label_score(labels: Ints, predicted: Ints) -> LabelScore:
    is_outlier, is_predicted = labels < 0, predicted < 0
    return LabelScore(
        points=len(labels),
        right=int((labels == predicted).sum()),
        sed1=edit_distance(labels, predicted, 1),
        sed2=edit_distance(labels, predicted, 2),
        outliers_predicted=int(is_predicted.sum()),
        outliers_true=int(is_outlier.sum()),
        outliers_both=int((is_outlier & is_predicted).sum()),
    )


def _moving(body: Ints, predicted: Ints) -> tuple[int, int]:
    """Points moving by truth and prediction, and by either; a point of unknown body counts if predicted as moving."""
    is_moving, is_predicted = body > BACKGROUND, predicted > BACKGROUND
    return int((is_moving & is_predicted).sum()), int((is_moving | is_predicted).sum())


def _motion(prediction: PairPrediction, cluster: int) -> Floats | None:
    """The predicted motion of a cluster; None if missing or not finite."""
    motions = prediction.motions
    return motions[cluster] if cluster < len(motions) and np.isfinite(motions[cluster]).all() else None


def _ego_error(truth: Floats, predicted: Floats | None) -> tuple[bool, float, float]:
    has_truth = bool(np.isfinite(truth).all())
    if not has_truth or predicted is None:
        return has_truth, float("nan"), float("nan")
    rotation, translation = se2.distance(predicted, truth)
    return has_truth, float(rotation), float(translation)


def _object_scores(
    truth: Annotation, prediction: PairPrediction, cluster: Ints, predicted: Ints, points: Floats, matched: dict[int, int]
) -> tuple[ObjectScore, ...]:
    counterparts = matched | {BACKGROUND: BACKGROUND}
    scores = []
    for number in (k for k in np.unique(cluster).tolist() if k != OUTLIER):
        is_true = cluster == number
        other = counterparts.get(number)
        is_predicted: Bools = predicted == other if other is not None else np.zeros(len(cluster), dtype=bool)
        motion = None if other is None else _motion(prediction, other)
        error = _motion_error(truth.motions[number], motion, points[is_true].mean(axis=0))
        overlap = int((is_true & is_predicted).sum())
        scores.append(ObjectScore(number, int(is_true.sum()), int(is_predicted.sum()), overlap, error))
    return tuple(scores)


def _motion_error(truth: Floats, predicted: Floats | None, centroid: Floats) -> MotionError | None:
    if predicted is None or not np.isfinite(truth).all():
        return None
    rotation, translation = se2.distance(predicted, truth)
    apart = se2.apply(predicted, centroid[None]) - se2.apply(truth, centroid[None])
    return MotionError(float(rotation), float(translation), float(np.linalg.norm(apart)))
