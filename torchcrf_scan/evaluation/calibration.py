"""Calibration of confidences and consistency of covariances: calibration error, reliability, normalised estimation error."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import chdtri  # quantiles of chi-square; `scipy.stats` takes a second to import

from torchcrf_scan.errors import TorchCRFScanError
from torchcrf_scan.evaluation.counterparts import annotation_of, beams_apart, match_movers, relabel
from torchcrf_scan.geometry import se2
from torchcrf_scan.scan import BACKGROUND, Bools, Floats, PairPrediction, ScanPair

BINS = 15
MOTION_FREEDOM = 3  # theta, tx, ty


@dataclass(frozen=True, slots=True)
class Bin:
    """Predictions with confidences from `low` (included) to `high` (excluded).

    Attributes:
        low, high: bounds of the confidence.
        count: predictions in the bin.
        confidence: their mean confidence. accuracy: share of right ones. Both NaN for an empty bin.
    """

    low: float
    high: float
    count: int
    confidence: float
    accuracy: float


def reliability(confidence: ArrayLike, is_right: ArrayLike, bins: int = BINS) -> tuple[Bin, ...]:
    """The reliability table: `bins` equally wide bins over [0, 1].

    Args:
        confidence: (P,) in [0, 1]. is_right: (P,) bool.

    Raises:
        TorchCRFScanError: other shapes, confidences outside [0, 1], no bins.
    """
    confidences, right = np.asarray(confidence, dtype=np.float64), np.asarray(is_right, dtype=bool)
    if confidences.ndim != 1 or confidences.shape != right.shape:
        raise TorchCRFScanError(f"is_right: expected one for every confidence (P,), got {right.shape} for {confidences.shape}")
    if not ((confidences >= 0) & (confidences <= 1)).all():
        raise TorchCRFScanError("confidence: expected numbers in [0, 1], got others")
    if bins < 1:
        raise TorchCRFScanError(f"bins: expected at least 1, got {bins}")
    place = np.minimum((confidences * bins).astype(np.int64), bins - 1)
    edges = np.linspace(0.0, 1.0, bins + 1)
    table = []
    for k in range(bins):
        inside = place == k
        count = int(inside.sum())
        means = (float(confidences[inside].mean()), float(right[inside].mean())) if count else (np.nan, np.nan)
        table.append(Bin(float(edges[k]), float(edges[k + 1]), count, *means))
    return tuple(table)


def expected_calibration_error(confidence: ArrayLike, is_right: ArrayLike, bins: int = BINS) -> float:
    """Mean over all predictions of |confidence - accuracy| of their bin; NaN for empty input. Arguments as in `reliability`."""
    table = [row for row in reliability(confidence, is_right, bins) if row.count]
    if not table:
        return float("nan")
    return sum(row.count * abs(row.confidence - row.accuracy) for row in table) / sum(row.count for row in table)


def normalised_error(estimate: Floats, truth: Floats, covariance: Floats) -> Floats:
    """NEES e^T P^-1 e of motions; chi-square distributed with three degrees of freedom if the covariance P is right.

    estimate, truth: (..., 3). covariance: (..., 3, 3). Returns (...,), NaN where the truth is.
    """
    error = np.concatenate([se2.wrap(estimate[..., :1] - truth[..., :1]), estimate[..., 1:] - truth[..., 1:]], axis=-1)
    scale = np.sqrt(np.einsum("...ii->...i", covariance))  # normalises radians and metres, so that the system is well conditioned
    correlation = covariance / (scale[..., :, None] * scale[..., None, :])
    scaled = (error / scale)[..., None]
    return (scaled * np.linalg.solve(correlation, scaled)).sum((-1, -2))


@dataclass(frozen=True, slots=True)
class Consistency:
    """Consistency of covariances with many normalised errors.

    Attributes:
        count: number of errors.
        mean: of the errors; low, high: 95 % interval of this mean under right covariances.
        median: divided by the median of the chi-square distribution.
        within: share of the errors below its 95 % quantile.
    """

    count: int
    mean: float
    low: float
    high: float
    median: float
    within: float


def consistency(nees: ArrayLike, freedom: int = MOTION_FREEDOM, level: float = 0.95) -> Consistency:
    """Compares normalised errors (P,) with the chi-square distribution. Raises TorchCRFScanError for empty input."""
    values = np.asarray(nees, dtype=np.float64)
    if values.ndim != 1 or not len(values):
        raise TorchCRFScanError(f"nees: expected at least one number (P,), got {values.shape}")
    n = len(values)
    low, high = chdtri(n * freedom, np.array([1 + level, 1 - level]) / 2) / n
    return Consistency(
        count=n,
        mean=float(values.mean()),
        low=float(low),
        high=float(high),
        median=float(np.median(values) / chdtri(freedom, 0.5)),
        within=float((values < chdtri(freedom, 1 - level)).mean()),
    )


@dataclass(frozen=True, slots=True)
class Rightness:
    """Right and wrong labels of a pair, by valid return of the source.

    Attributes:
        known: (N,) annotated returns; the others are not scored.
        within: (N,) at most `tolerance` target beams off, or a true outlier.
        cluster: (N,) the true cluster, movers matched by overlap.
    """

    known: Bools
    within: Bools
    cluster: Bools


def rightness(pair: ScanPair, prediction: PairPrediction, tolerance: int = 2) -> Rightness:
    """Compares a prediction with the pair's annotation. Raises TorchCRFScanError for a pair without one."""
    truth, beam = annotation_of(pair), pair.source.beam
    known = ~truth.ignore[beam]
    off = beams_apart(pair.target, truth.association[beam], prediction.association[beam])
    cluster, found = truth.cluster[beam], prediction.cluster[beam]
    numbered = relabel(found, cluster, match_movers(cluster[known], found[known]))
    return Rightness(known, off <= tolerance, numbered == cluster)


@dataclass(frozen=True, slots=True)
class Sureness:
    """Confidences of a pair's labels and whether these are right: P annotated returns.

    Attributes:
        association, cluster: (P,) confidences.
        association_right, cluster_right: (P,) bool; an association is right within two target beams.
        nees: normalised error of the background's motion; NaN without covariance or if a motion is unknown.
    """

    association: Floats
    association_right: Bools
    cluster: Floats
    cluster_right: Bools
    nees: float

    @classmethod
    def of(cls, pair: ScanPair, prediction: PairPrediction) -> Sureness:
        """Compares a prediction with the pair's annotation. Raises TorchCRFScanError for a pair without one."""
        right = rightness(pair, prediction)
        beam = pair.source.beam[right.known]
        return cls(
            association=prediction.association_confidence[beam],
            association_right=right.within[right.known],
            cluster=prediction.cluster_confidence[beam],
            cluster_right=right.cluster[right.known],
            nees=background_nees(pair, prediction),
        )


def background_nees(pair: ScanPair, prediction: PairPrediction) -> float:
    """Normalised error of the background's motion; NaN if undefined."""
    if pair.annotation is None or prediction.covariances is None:
        return float("nan")
    covariance, motions = prediction.covariances[BACKGROUND], (prediction.motions[BACKGROUND], pair.annotation.motions[BACKGROUND])
    if not np.isfinite(motions).all() or np.linalg.eigvalsh(covariance)[0] <= 0:
        return float("nan")
    return float(normalised_error(*motions, covariance))
