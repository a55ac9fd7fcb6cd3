"""Outlier decisions at the answered motions: with the truth's help, and by one gate in metres."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import cKDTree

from torchcrf_scan.evaluation.counterparts import annotation_of, clusters_beneath
from torchcrf_scan.geometry import se2
from torchcrf_scan.scan import BACKGROUND, OUTLIER, Bools, Floats, Ints, PairPrediction, ScanPair


def nearest_targets(pair: ScanPair, motions: Floats, cluster: Ints) -> tuple[Floats, Ints]:
    """(N,) metres to the nearest target point under the motion of a point's cluster (N,), and (N,) its beam.

    inf and -1 for outliers, unknown motions, and without target points.
    """
    distance, beam = np.full(len(pair.source), np.inf), np.full(len(pair.source), OUTLIER)
    if not len(pair.target):
        return distance, beam
    tree = cKDTree(pair.target.points)
    for number in np.unique(cluster[(cluster >= BACKGROUND) & (cluster < len(motions))]):
        own = cluster == number
        if np.isfinite(motions[number]).all():
            distance[own], place = tree.query(se2.apply(motions[number], pair.source.points[own]))
            beam[own] = pair.target.beam[place]
    return distance, beam


def with_true_outliers(pair: ScanPair, prediction: PairPrediction) -> PairPrediction:
    """The answer with every annotated point's outlier decision put right, its motions as they are.

    A point taken back gets the cluster of the nearest answered inlier, and the nearest target point under that cluster's motion.
    """
    truth, beam = annotation_of(pair), pair.source.beam
    association, cluster = prediction.association.copy(), prediction.cluster.copy()
    beneath = clusters_beneath(pair, prediction)
    _, nearest = nearest_targets(pair, prediction.motions, beneath)
    known, is_outlier = ~truth.ignore[beam], truth.association[beam] < 0
    back = known & ~is_outlier & ((association[beam] < 0) | (cluster[beam] == OUTLIER))
    association[beam[back]], cluster[beam[back]] = nearest[back], beneath[back]
    association[beam[known & is_outlier]] = cluster[beam[known & is_outlier]] = OUTLIER
    return replace(prediction, association=association, cluster=cluster)


@dataclass(frozen=True, slots=True)
class OutlierCase:
    """The annotated points of a pair, P of them: what they are, what the answer calls them, and what a gate goes by.

    Attributes:
        distance: (P,) metres to the nearest target point under the answered motion.
        is_outlier, is_called: (P,) by truth, by answer.
    """

    distance: Floats
    is_outlier: Bools
    is_called: Bools

    @classmethod
    def of(cls, pair: ScanPair, prediction: PairPrediction) -> OutlierCase:
        """The case of an annotated pair."""
        truth, beam = annotation_of(pair), pair.source.beam
        distance, _ = nearest_targets(pair, prediction.motions, clusters_beneath(pair, prediction))
        known = ~truth.ignore[beam]
        return cls(distance[known], truth.association[beam][known] < 0, prediction.association[beam][known] < 0)


@dataclass(frozen=True, slots=True)
class Gate:
    """The best single gate for some pairs, chosen with their labels: a point farther than `metres` is an outlier.

    Attributes:
        errors: outlier decisions that it gets wrong. answered: those that the answer gets wrong.
    """

    metres: float
    errors: int
    answered: int


def best_gate(cases: Sequence[OutlierCase]) -> Gate:
    """The gate with the fewest wrong outlier decisions, the smallest of equal ones, among the distances that occur, 0 and inf."""
    distance, is_outlier, is_called = (
        np.concatenate([np.zeros(0), *(getattr(case, name) for case in cases)]) for name in ("distance", "is_outlier", "is_called")
    )
    order = np.argsort(distance, kind="stable")
    edges = np.unique(np.append(distance, [0.0, np.inf]))
    inside = np.searchsorted(distance[order], edges, side="right")  # points within each gate
    outliers = np.append(0, np.cumsum(is_outlier[order]))  # among the k nearest
    kept, total = outliers[inside], outliers[-1]
    errors = kept + (len(distance) - inside) - (total - kept)
    best = int(errors.argmin())
    return Gate(float(edges[best]), int(errors[best]), int((is_outlier.astype(bool) != is_called.astype(bool)).sum()))
