"""How good a prediction is: counts and errors of one pair, and their summary over many (spec 8, A-21 to A-23, A-27).

Only valid returns that somebody annotated are scored. Indices are beams, as in the files, so the figures are those of the
pair and prediction files themselves. Movers are matched to the true ones by maximum overlap, background and outlier are fixed.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from rapidfuzz.distance import Levenshtein
from scipy.optimize import linear_sum_assignment

from torchcrf_scan.geometry import se2
from torchcrf_scan.scan import BACKGROUND, OUTLIER, Annotation, Bools, Floats, Ints, PairPrediction, ScanPair

MOVER_MIN_POINTS = 5  # a mover with fewer inlier points is not asked to be found
FOUND_IOU = 0.5
EGO_TRANSLATION, EGO_ROTATION = 0.05, 0.01745  # metres, radians (1 deg): a good ego motion
EGO_TRANSLATION_LOOSE, EGO_ROTATION_LOOSE = 0.15, float(np.radians(0.5))  # for a truth that is itself good to about 7 cm


@dataclass(frozen=True, slots=True)
class LabelScore:
    """A string of predicted labels against the true one, in points.

    Attributes:
        points: scored points.
        right: points with the true label, the outlier being a label (spec 8.1, 8.2).
        sed1, sed2: edit distances of the strings with substitutions at cost 1 and 2 (spec 8.3).
        outliers_predicted, outliers_true, outliers_both: points called outlier, that are, and both (spec 8.4).
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
        centroid: metres by which the object's centroid lands wrong (free of the choice of origin).
    """

    rotation: float
    translation: float
    centroid: float


@dataclass(frozen=True, slots=True)
class ObjectScore:
    """A true object (background or mover) against the predicted cluster matched to it.

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
        """Whether it is a mover large enough to be asked for."""
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
    """Everything that is measured on one pair; `summarise` turns many into the figures of a table.

    Attributes:
        association: score of the associations.
        cluster: score of the cluster labels after matching.
        within_1, within_2: points at most 1, 2 target beams off; an outlier must be called one.
        inliers, inliers_right: points with a counterpart, and those associated exactly (A-27).
        distance_sum, distance_points: summed distance (metres) between the predicted and the true target return, over the
            points that have both.
        moving_both, moving_either: points moving by truth and prediction, by truth or prediction, among those whose `body` counts.
        has_ego_truth: whether the background's true motion is known.
        ego_rotation, ego_translation: error of the background motion, radians and metres; NaN when it or its truth is unknown.
        objects: background and movers that have inlier points.
        name, sequence: of the pair.
    """

    association: LabelScore
    cluster: LabelScore
    within_1: int
    within_2: int
    inliers: int
    inliers_right: int
    distance_sum: float
    distance_points: int
    moving_both: int
    moving_either: int
    has_ego_truth: bool
    ego_rotation: float
    ego_translation: float
    objects: tuple[ObjectScore, ...]
    name: str = ""
    sequence: str = ""

    def has_ego_within(self, translation: float, rotation: float) -> bool:
        """Whether the ego motion is closer to the truth than this, metres and radians; False when unknown."""
        return self.ego_translation < translation and self.ego_rotation < rotation


def score_pair(pair: ScanPair, prediction: PairPrediction) -> PairScore:
    """Scores the prediction of an annotated pair.

    Raises:
        ValueError: a pair without annotation, or a prediction of another number of beams or of target beams that do not exist.
    """
    truth = _checked_annotation(pair, prediction)
    keep = pair.source.to_beams(np.ones(len(pair.source), dtype=bool), False) & ~truth.ignore
    association, predicted_association = truth.association[keep], prediction.association[keep]
    cluster, predicted_cluster = truth.cluster[keep], prediction.cluster[keep]
    points = pair.source.to_beams(pair.source.points, np.nan)[keep]

    offset = _index_offset(association, predicted_association)
    distances = _target_distances(pair, association, predicted_association)
    matched = match_movers(cluster, predicted_cluster)
    moving = _moving(truth.body[keep], predicted_cluster)
    has_ego_truth, rotation, translation = _ego_error(truth.motions[0], _motion(prediction, BACKGROUND))
    return PairScore(
        association=_label_score(association, predicted_association),
        cluster=_label_score(cluster, relabel(predicted_cluster, cluster, matched)),
        within_1=int((offset <= 1).sum()),
        within_2=int((offset <= 2).sum()),
        inliers=int((association >= 0).sum()),
        inliers_right=int(((association >= 0) & (offset == 0)).sum()),
        distance_sum=float(distances.sum()),
        distance_points=len(distances),
        moving_both=moving[0],
        moving_either=moving[1],
        has_ego_truth=has_ego_truth,
        ego_rotation=rotation,
        ego_translation=translation,
        objects=_object_scores(truth, prediction, cluster, predicted_cluster, points, matched),
        name=pair.name,
        sequence=pair.sequence,
    )


def match_movers(cluster: Ints, predicted: Ints) -> dict[int, int]:
    """Matches movers one to one by maximum total overlap; matches without any overlap are left out (spec 8.2, A-22).

    Clusters enter in the order of their first point, so that their numbers do not matter, not even in a tie.

    Args:
        cluster: (N,) true labels.
        predicted: (N,) predicted labels.

    Returns:
        true mover -> predicted mover.
    """
    ids, predicted_ids = _movers_in_order(cluster), _movers_in_order(predicted)
    is_true = cluster[None, :] == ids[:, None]  # (K, N)
    is_predicted = predicted[None, :] == predicted_ids[:, None]  # (L, N)
    overlap = is_true.astype(np.float64) @ is_predicted.T.astype(np.float64)  # (K, L)
    rows, columns = linear_sum_assignment(-overlap)
    return {int(ids[i]): int(predicted_ids[j]) for i, j in zip(rows, columns, strict=True) if overlap[i, j] > 0}


def relabel(predicted: Ints, cluster: Ints, matched: dict[int, int]) -> Ints:
    """(N,) predicted labels in the numbers of the true ones; unmatched movers get numbers that no true one has."""
    out = predicted.copy()
    number = {theirs: ours for ours, theirs in matched.items()}
    free = int(cluster.max(initial=0)) + 1
    for mover in _movers_in_order(predicted).tolist():
        if mover not in number:
            number[mover] = free
            free += 1
        out[predicted == mover] = number[mover]
    return out


def edit_distance(labels: Ints, others: Ints, substitution: int) -> int:
    """Edit distance of two label strings, insertion and deletion at cost 1 (spec 8.3; 2 N - 2 LCS for `substitution` = 2)."""
    return int(Levenshtein.distance((labels + 1).tolist(), (others + 1).tolist(), weights=(1, 1, substitution)))


def summarise(scores: Sequence[PairScore]) -> dict[str, float]:
    """The figures of many pairs: mean over pairs unless said otherwise; percent, metres, radians, numbers of edits.

    - `pairs`, and `association_*`, `cluster_*`: `accuracy`, `sed1`, `sed2`, `outliers_found`, `outliers_true`, `recall` and
      `precision` of the outliers.
    - `association_within_1`, `association_within_2`, `association_inlier_accuracy`; `target_distance` pooled over points.
    - `iou_moving`, `movers_found` pooled over pairs; `movers`, their number.
    - `ego_success`, `ego_success_loose` over the pairs whose ego motion is known, `ego_answered` the share of them with a finite
      answer; over these `ego_rotation_*` and `ego_translation_*`, `median`, `p95` and `mean`.
    - `motion_*`, `background_motion_*`, `mover_motion_*`: `rotation`, `translation`, `centroid` errors, pooled over the
      correctly clustered objects (A-23), and `objects`, their number.
    - `found_mover_centroid_median`: over the movers found.

    An undefined precision, recall or accuracy counts as 0; the key with `_skipped` leaves such pairs out. Keys with `_skipped`,
    `target_distance` and errors are NaN when there is nothing to average; no other key ever is.

    Raises:
        ValueError: no scores.
    """
    if not scores:
        raise ValueError("scores: expected at least one pair, got none")
    return {
        "pairs": float(len(scores)),
        **_association_summary(scores),
        **_label_summary("cluster", [score.cluster for score in scores]),
        **_moving_summary(scores),
        **_ego_summary(scores),
        **_motion_summary(scores),
    }


def _checked_annotation(pair: ScanPair, prediction: PairPrediction) -> Annotation:
    n, m = pair.source.n_beams, pair.target.n_beams
    if pair.annotation is None:
        raise ValueError(f"pair {pair.name!r}: expected an annotation, got none")
    if prediction.association.shape != (n,) or prediction.cluster.shape != (n,):
        got = f"association {prediction.association.shape} and cluster {prediction.cluster.shape}"
        raise ValueError(f"prediction of pair {pair.name!r}: expected labels of all ({n},) source beams, got {got}")
    if n and int(prediction.association.max()) >= m:
        raise ValueError(f"prediction of pair {pair.name!r}: expected association below {m}, got {prediction.association.max()}")
    return pair.annotation


def _index_offset(association: Ints, predicted: Ints) -> Floats:
    """(N,) distance of the target indices, 0 where both are outliers, inf where only one is."""
    is_outlier, is_predicted = association < 0, predicted < 0
    offset = np.where(is_outlier != is_predicted, np.inf, np.abs(association - predicted))
    return np.where(is_outlier & is_predicted, 0.0, offset)


def _target_distances(pair: ScanPair, association: Ints, predicted: Ints) -> Floats:
    """Distances between the true and the predicted target return, metres, where both exist."""
    targets = pair.target.to_beams(pair.target.points, np.nan)
    both = (association >= 0) & (predicted >= 0)
    distances = np.linalg.norm(targets[association[both]] - targets[predicted[both]], axis=-1)
    return distances[np.isfinite(distances)]


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


def _movers_in_order(labels: Ints) -> Ints:
    """(K,) movers that occur, in the order of their first point."""
    ids, first = np.unique(labels, return_index=True)
    ids = ids[np.argsort(first)]
    return ids[ids > BACKGROUND]


def _moving(body: Ints, predicted: Ints) -> tuple[int, int]:
    """Points moving by truth and by prediction, and by either: a point of unknown body counts when it is called moving."""
    is_moving, is_predicted = body > BACKGROUND, predicted > BACKGROUND
    return int((is_moving & is_predicted).sum()), int((is_moving | is_predicted).sum())


def _motion(prediction: PairPrediction, cluster: int) -> Floats | None:
    """The predicted motion of a cluster, None when there is no finite one."""
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


def _percent(part: float, whole: float) -> float:
    """Percentage, 0 of nothing."""
    return 100.0 * part / whole if whole else 0.0


def _mean(values: Iterable[float]) -> float:
    """Mean, NaN of nothing."""
    array = np.fromiter(values, dtype=np.float64)
    return float(array.mean()) if len(array) else float("nan")


def _mean_percent(counts: Sequence[tuple[int, int]]) -> float:
    return _mean(_percent(part, whole) for part, whole in counts)


def _both_means(key: str, counts: Sequence[tuple[int, int]]) -> dict[str, float]:
    """Mean percentage of (part, whole) with 0 for an undefined one, and with those skipped."""
    return {key: _mean_percent(counts), f"{key}_skipped": _mean_percent([count for count in counts if count[1]])}


def _label_summary(prefix: str, labels: Sequence[LabelScore]) -> dict[str, float]:
    return {
        f"{prefix}_accuracy": _mean_percent([(x.right, x.points) for x in labels]),
        f"{prefix}_sed1": _mean(x.sed1 for x in labels),
        f"{prefix}_sed2": _mean(x.sed2 for x in labels),
        f"{prefix}_outliers_found": _mean_percent([(x.outliers_predicted, x.points) for x in labels]),
        f"{prefix}_outliers_true": _mean_percent([(x.outliers_true, x.points) for x in labels]),
        **_both_means(f"{prefix}_recall", [(x.outliers_both, x.outliers_true) for x in labels]),
        **_both_means(f"{prefix}_precision", [(x.outliers_both, x.outliers_predicted) for x in labels]),
    }


def _association_summary(scores: Sequence[PairScore]) -> dict[str, float]:
    distance_points = sum(score.distance_points for score in scores)
    distance_sum = sum(score.distance_sum for score in scores)
    return {
        **_label_summary("association", [score.association for score in scores]),
        "association_within_1": _mean_percent([(score.within_1, score.association.points) for score in scores]),
        "association_within_2": _mean_percent([(score.within_2, score.association.points) for score in scores]),
        **_both_means("association_inlier_accuracy", [(score.inliers_right, score.inliers) for score in scores]),
        "target_distance": distance_sum / distance_points if distance_points else float("nan"),
    }


def _moving_summary(scores: Sequence[PairScore]) -> dict[str, float]:
    counted = [thing for score in scores for thing in score.objects if thing.is_counted]
    return {
        "iou_moving": _percent(sum(score.moving_both for score in scores), sum(score.moving_either for score in scores)),
        "movers_found": _percent(sum(thing.is_found for thing in counted), len(counted)),
        "movers": float(len(counted)),
    }


def _ego_summary(scores: Sequence[PairScore]) -> dict[str, float]:
    known = [score for score in scores if score.has_ego_truth]
    answered = [score for score in known if np.isfinite(score.ego_translation)]
    strict = sum(score.has_ego_within(EGO_TRANSLATION, EGO_ROTATION) for score in known)
    loose = sum(score.has_ego_within(EGO_TRANSLATION_LOOSE, EGO_ROTATION_LOOSE) for score in known)
    return {
        "ego_success": _percent(strict, len(known)),
        "ego_success_loose": _percent(loose, len(known)),
        "ego_answered": _percent(len(answered), len(known)),
        **_spread("ego_rotation", [score.ego_rotation for score in answered]),
        **_spread("ego_translation", [score.ego_translation for score in answered]),
    }


def _spread(key: str, values: list[float]) -> dict[str, float]:
    """Median, 95th percentile and mean, NaN of nothing."""
    array = np.array(values or [np.nan])
    return {
        f"{key}_median": float(np.median(array)),
        f"{key}_p95": float(np.percentile(array, 95)),
        f"{key}_mean": float(array.mean()),
    }


def _motion_summary(scores: Sequence[PairScore]) -> dict[str, float]:
    objects = [thing for score in scores for thing in score.objects]
    found = [thing.error.centroid for thing in objects if thing.is_counted and thing.is_found and thing.error is not None]
    return {
        **_error_summary("motion", objects, lambda thing: True),
        **_error_summary("background_motion", objects, lambda thing: not thing.is_mover),
        **_error_summary("mover_motion", objects, lambda thing: thing.is_mover),
        "found_mover_centroid_median": float(np.median(found)) if found else float("nan"),
    }


def _error_summary(prefix: str, objects: Sequence[ObjectScore], is_meant: Callable[[ObjectScore], bool]) -> dict[str, float]:
    """Mean motion errors of the correctly clustered objects that are meant (spec 8.5)."""
    errors = [thing.error for thing in objects if thing.error is not None and thing.is_correct and is_meant(thing)]
    return {
        f"{prefix}_rotation": _mean(error.rotation for error in errors),
        f"{prefix}_translation": _mean(error.translation for error in errors),
        f"{prefix}_centroid": _mean(error.centroid for error in errors),
        f"{prefix}_objects": float(len(errors)),
    }
