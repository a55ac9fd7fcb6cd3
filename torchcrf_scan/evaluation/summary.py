"""Averages of many pairs' scores: means, shares and medians (spec 8, A-23)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchcrf_scan.errors import TorchCRFScanError
from torchcrf_scan.evaluation.calibration import consistency, expected_calibration_error
from torchcrf_scan.evaluation.measures import EVERY, Count, mean
from torchcrf_scan.evaluation.metrics import LabelScore, MotionError, ObjectScore, PairScore

EGO_TRANSLATION, EGO_ROTATION = 0.05, 0.01745  # metres, radians (1 deg): success bounds of the ego motion
EGO_TRANSLATION_LOOSE, EGO_ROTATION_LOOSE = 0.15, float(np.radians(0.5))  # for annotations accurate to about 7 cm


def summarise(scores: Sequence[PairScore]) -> dict[str, float]:
    """Metrics over many pairs: mean over pairs unless stated otherwise; percent, metres, radians, numbers of edits.

    - `pairs`, and `association_*`, `cluster_*`: `accuracy`, `sed1`, `sed2`, `outliers_found`, `outliers_true`, `recall` and
      `precision` of the outliers.
    - `association_within_1`, `association_within_2`, `association_inlier_accuracy`; `target_distance` pooled over points.
    - `iou_moving`, `movers_found` pooled over pairs; `movers`, their number.
    - `ego_success`, `ego_success_loose` over the pairs whose ego motion is known, `ego_answered` the share of them with a finite
      prediction; over these `ego_rotation_*` and `ego_translation_*`, `median`, `p95` and `mean`.
    - `motion_*`, `background_motion_*`, `mover_motion_*`: `rotation`, `translation`, `centroid` errors, pooled over the
      correctly clustered objects (A-23), and `objects`, their number.
    - `found_mover_centroid_median`: over the movers found.
    - `association_ece` (right within two target beams), `cluster_ece`: expected calibration errors, percent of all returns.
    - `nees_pairs`: pairs with known background motion and covariance; over these `nees_covered`, percent within the 95 % quantile
      of the chi-square, `nees_mean`, and `nees_low`, `nees_high`, the 95 % interval of this mean under right covariances.

    An undefined precision, recall or accuracy counts as 0; the key with `_skipped` leaves such pairs out. Keys with `_skipped`,
    `target_distance`, errors, `_ece` and `nees_` are NaN when there is nothing to average; no other key ever is.

    Raises:
        TorchCRFScanError: no scores.
    """
    if not scores:
        raise TorchCRFScanError("scores: expected at least one pair, got none")
    return {
        "pairs": float(len(scores)),
        **_association_summary(scores),
        **_label_summary("cluster", [score.cluster for score in scores]),
        **_moving_summary(scores),
        **_ego_summary(scores),
        **_motion_summary(scores),
        **_sureness_summary(scores),
        **_counted_summary(scores),
    }


def _percent(part: float, whole: float) -> float:
    """Percentage, 0 for an empty denominator."""
    return 100.0 * part / whole if whole else 0.0


def _mean_percent(counts: Sequence[Count]) -> float:
    return mean([_percent(part, whole) for part, whole in counts])


def _both_means(key: str, counts: Sequence[Count]) -> dict[str, float]:
    """Mean percentage of (numerator, denominator) with 0 for an undefined one, and with those skipped."""
    return {key: _mean_percent(counts), f"{key}_skipped": _mean_percent([count for count in counts if count[1]])}


def _label_summary(prefix: str, labels: Sequence[LabelScore]) -> dict[str, float]:
    return {
        f"{prefix}_accuracy": _mean_percent([(x.right, x.points) for x in labels]),
        f"{prefix}_sed1": mean([x.sed1 for x in labels]),
        f"{prefix}_sed2": mean([x.sed2 for x in labels]),
        f"{prefix}_outliers_found": _mean_percent([(x.outliers_predicted, x.points) for x in labels]),
        f"{prefix}_outliers_true": _mean_percent([(x.outliers_true, x.points) for x in labels]),
        **_both_means(f"{prefix}_recall", [(x.outliers_both, x.outliers_true) for x in labels]),
        **_both_means(f"{prefix}_precision", [(x.outliers_both, x.outliers_predicted) for x in labels]),
    }


def _association_summary(scores: Sequence[PairScore]) -> dict[str, float]:
    return {
        **_label_summary("association", [score.association for score in scores]),
        "association_within_1": _mean_percent([(score.within_1, score.association.points) for score in scores]),
        "association_within_2": _mean_percent([(score.within_2, score.association.points) for score in scores]),
    }


def _counted_summary(scores: Sequence[PairScore]) -> dict[str, float]:
    """Averages of `measures.MEASURES`."""
    found: dict[str, float] = {}
    for key, measure in EVERY.items():
        counts = [score.counts[key] for score in scores]
        if measure.is_pooled:
            part, whole = (sum(numbers) for numbers in zip(*counts, strict=True))
            found[key] = part / whole if whole else float("nan")
        else:
            found |= _both_means(key, counts)
    return found


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
    """Median, 95th percentile and mean, NaN for empty input."""
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


def correct_errors(objects: Sequence[ObjectScore]) -> list[MotionError]:
    """The motion errors of the correctly clustered objects."""
    return [thing.error for thing in objects if thing.error is not None and thing.is_correct]


def _error_summary(prefix: str, objects: Sequence[ObjectScore], is_meant: Callable[[ObjectScore], bool]) -> dict[str, float]:
    """Mean motion errors of the correctly clustered objects selected by `is_meant` (spec 8.5)."""
    errors = correct_errors([thing for thing in objects if is_meant(thing)])
    return {
        f"{prefix}_rotation": mean([error.rotation for error in errors]),
        f"{prefix}_translation": mean([error.translation for error in errors]),
        f"{prefix}_centroid": mean([error.centroid for error in errors]),
        f"{prefix}_objects": float(len(errors)),
    }


def _sureness_summary(scores: Sequence[PairScore]) -> dict[str, float]:
    def pooled(name: str) -> NDArray[Any]:
        return np.concatenate([getattr(score.sureness, name) for score in scores])

    nees = np.array([score.sureness.nees for score in scores])
    nees = nees[np.isfinite(nees)]
    found = consistency(nees) if len(nees) else None
    return {
        "association_ece": 100 * expected_calibration_error(pooled("association"), pooled("association_right")),
        "cluster_ece": 100 * expected_calibration_error(pooled("cluster"), pooled("cluster_right")),
        "nees_pairs": float(len(nees)),
        "nees_covered": 100 * found.within if found else float("nan"),
        "nees_mean": found.mean if found else float("nan"),
        "nees_low": found.low if found else float("nan"),
        "nees_high": found.high if found else float("nan"),
    }
