"""Comparison of two labellings: movers matched by overlap, associations by the beams between them, outliers by their place."""

from __future__ import annotations

import numpy as np
from scipy.optimize import linear_sum_assignment
from scipy.spatial import cKDTree

from torchcrf_scan.errors import TorchCRFScanError
from torchcrf_scan.scan import BACKGROUND, OUTLIER, Annotation, Floats, Ints, PairPrediction, Scan, ScanPair


def annotation_of(pair: ScanPair) -> Annotation:
    """The annotation; raises TorchCRFScanError for a pair without one."""
    if pair.annotation is None:
        raise TorchCRFScanError(f"pair {pair.name!r}: expected an annotation, got none")
    return pair.annotation


def match_movers(cluster: Ints, predicted: Ints) -> dict[int, int]:
    """Matches movers one to one by maximum total overlap; matches without any overlap are left out (spec 8.2, A-22).

    Clusters are ordered by their first point, so that the result does not depend on their numbers, not even in a tie.

    Args:
        cluster: (N,) true labels.
        predicted: (N,) predicted labels.

    Returns:
        true mover -> predicted mover.
    """
    ids, predicted_ids = movers_in_order(cluster), movers_in_order(predicted)
    is_true = cluster[None, :] == ids[:, None]  # (K, N)
    is_predicted = predicted[None, :] == predicted_ids[:, None]  # (L, N)
    overlap = is_true.astype(np.float64) @ is_predicted.T.astype(np.float64)  # (K, L)
    rows, columns = linear_sum_assignment(-overlap)
    return {int(ids[i]): int(predicted_ids[j]) for i, j in zip(rows, columns, strict=True) if overlap[i, j] > 0}


def relabel(predicted: Ints, cluster: Ints, matched: dict[int, int]) -> Ints:
    """(N,) predicted labels renumbered like the matched true ones; unmatched movers get numbers unused by the truth."""
    out = predicted.copy()
    number = {theirs: ours for ours, theirs in matched.items()}
    free = int(cluster.max(initial=0)) + 1
    for mover in movers_in_order(predicted).tolist():
        if mover not in number:
            number[mover] = free
            free += 1
        out[predicted == mover] = number[mover]
    return out


def movers_in_order(labels: Ints) -> Ints:
    """(K,) numbers of the movers, in the order of their first point."""
    ids, first = np.unique(labels, return_index=True)
    ids = ids[np.argsort(first)]
    return ids[ids > BACKGROUND]


def clusters_beneath(pair: ScanPair, prediction: PairPrediction) -> Ints:
    """(N,) cluster of every source point, that of the nearest answered inlier for answered outliers; background without any."""
    beam, points = pair.source.beam, pair.source.points
    cluster = prediction.cluster[beam]
    is_inlier = (cluster != OUTLIER) & (prediction.association[beam] >= 0)
    if not is_inlier.any():
        return np.maximum(cluster, BACKGROUND)
    nearest = cKDTree(points[is_inlier]).query(points)[1]
    return np.where(cluster == OUTLIER, cluster[is_inlier][nearest], cluster)


def beams_apart(target: Scan, association: Ints, other: Ints) -> Floats:
    """(N,) target beams between two associations (N,): 0 where both are outliers, inf where only one is."""
    is_outlier, is_other = association < 0, other < 0
    rank = np.append(target.rank, 0)  # the last entry is for -1
    apart = np.where(is_outlier != is_other, np.inf, np.abs(rank[association] - rank[other]))
    return np.where(is_outlier & is_other, 0.0, apart)
