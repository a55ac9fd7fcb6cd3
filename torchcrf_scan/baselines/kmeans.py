"""K-Means on the displacements implied by another method's associations (spec 9.3)."""

from __future__ import annotations

import warnings

import numpy as np
from sklearn.cluster import KMeans
from sklearn.exceptions import ConvergenceWarning

from torchcrf_scan.baselines.cloud import fit_motion
from torchcrf_scan.baselines.labels import all_outliers, to_prediction
from torchcrf_scan.geometry import se2
from torchcrf_scan.scan import BACKGROUND, OUTLIER, Floats, Ints, PairPrediction, ScanPair

SEED = 0
RESTARTS = 20
FEWEST_POINTS = 3  # of a cluster with a rotation of its own (spec 7.5), and
LEAST_EXTENT = 0.1  # metres, root mean square along its longest direction


def cluster_displacements(
    pair: ScanPair, matched: PairPrediction, *, clusters: int = 4, remove_motion: bool = False
) -> PairPrediction:
    """Groups the associated points by displacement; the largest group is the background. Adds no outliers.

    Args:
        pair: two scans.
        matched: its associations, kept unchanged.
        clusters: K, maximum number of groups (at most the number of distinct displacements).
        remove_motion: measure displacements relative to the background's motion of `matched`.
    """
    association = pair.target_points(matched.association)  # (N,)
    inliers = np.flatnonzero(association >= 0)
    base = matched.motions[BACKGROUND]
    if not len(inliers):
        return all_outliers(pair, base)
    source, target = pair.source.points[inliers], pair.target.points[association[inliers]]
    groups = group_by_size(target - (se2.apply(base, source) if remove_motion else source), clusters)
    motions = [fit_group(source[groups == 0], target[groups == 0], float(base[0]))]
    for k in range(1, groups.max() + 1):
        motions.append(fit_group(source[groups == k], target[groups == k], float(motions[BACKGROUND][0])))
    cluster = np.full(len(association), OUTLIER)
    cluster[inliers] = groups
    return to_prediction(pair, association, cluster, np.stack(motions), converged=matched.converged)


def group_by_size(displacements: Floats, clusters: int) -> Ints:
    """(P,) K-Means labels 0.. of (P, 2) displacements, numbered by falling size."""
    count = min(clusters, len(np.unique(displacements, axis=0)))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ConvergenceWarning)  # displacements equal up to rounding give fewer groups, as intended
        found = KMeans(count, n_init=RESTARTS, random_state=SEED).fit(displacements).labels_
    order = np.argsort(-np.bincount(found, minlength=count), kind="stable")
    return np.argsort(order)[found]


def fit_group(source: Floats, target: Floats, rotation: float) -> Floats:
    """(3,) motion of (P, 2) paired points, P >= 1; few or concentrated points take `rotation` (radians) and the mean shift."""
    spread = source - source.mean(0)
    extent = np.sqrt(np.linalg.eigvalsh(spread.T @ spread / len(source)).max())
    if len(source) >= FEWEST_POINTS and extent >= LEAST_EXTENT:
        return fit_motion(source, target)
    return np.array([rotation, *(target.mean(0) - se2.rotate(np.float64(rotation), source.mean(0)))])
