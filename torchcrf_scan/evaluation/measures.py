"""Means, percentages, and metrics that are ratios, counted pair by pair: one function and one line each.

A new metric needs only a line in `MEASURES`: `score_pair` counts it, `summarise` averages it, and its table shows it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from torchcrf_scan.scan import Bools, Floats, Ints, ScanPair

Count = tuple[float, float]  # numerator and denominator


def mean(values: ArrayLike) -> float:
    """Mean of (P,) numbers; NaN of none."""
    numbers = np.asarray(values, dtype=np.float64)
    return float(numbers.mean()) if len(numbers) else float("nan")


def percent(part: float, whole: float) -> float:
    """Percentage; NaN of nothing."""
    return 100 * part / whole if whole else float("nan")


@dataclass(frozen=True, slots=True)
class Labelled:
    """The scored source beams of a pair, S of them, in the order of the beams.

    Attributes:
        pair: their pair. association, cluster: (S,) true labels; body: (S,) true body.
        predicted_association: (S,); predicted_cluster: (S,) as numbered by the method.
    """

    pair: ScanPair
    association: Ints
    cluster: Ints
    body: Ints
    predicted_association: Ints
    predicted_cluster: Ints

    @property
    def has_both(self) -> Bools:
        """(S,) whether there is a counterpart by truth and by prediction."""
        return (self.association >= 0) & (self.predicted_association >= 0)


@dataclass(frozen=True, slots=True)
class Measure:
    """A metric.

    Attributes:
        count: of one pair. heading, digits: of its column.
        is_pooled: numerators and denominators of all pairs are summed first; otherwise it is a mean over pairs, in percent.
    """

    count: Callable[[Labelled], Count]
    heading: str
    digits: int
    is_pooled: bool = False


def inliers_right(labels: Labelled) -> Count:
    """Points that are associated exactly, of those with a counterpart (A-27)."""
    is_inlier = labels.association >= 0
    return float((is_inlier & (labels.association == labels.predicted_association)).sum()), float(is_inlier.sum())


def target_distance(labels: Labelled) -> Count:
    """Summed distance between the true and the predicted target return, metres, and the points that have both."""
    distances = target_distances(labels)
    return float(distances.sum()), float(len(distances))


def target_distances(labels: Labelled) -> Floats:
    """Distances between the true and the predicted target return, metres, where both exist."""
    target = labels.pair.target
    points, both = target.to_beams(target.points, np.nan), labels.has_both
    distances = np.linalg.norm(points[labels.association[both]] - points[labels.predicted_association[both]], axis=-1)
    return distances[np.isfinite(distances)]


MEASURES: Mapping[str, Mapping[str, Measure]] = {  # by table, then by key of `summarise`
    "association": {
        "association_inlier_accuracy": Measure(inliers_right, "inliers only (%)", 2),
        "target_distance": Measure(target_distance, "target distance (m)", 3, is_pooled=True),
    },
    "detection": {},
}
EVERY: Mapping[str, Measure] = {key: measure for table in MEASURES.values() for key, measure in table.items()}
