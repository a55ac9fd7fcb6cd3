"""Conversion of labels by point to the prediction of a pair, by beam."""

from __future__ import annotations

import numpy as np

from torchcrf_scan.scan import BACKGROUND, OUTLIER, Floats, Ints, PairPrediction, ScanPair

IDENTITY: Floats = np.zeros(3)


def to_prediction(pair: ScanPair, association: Ints, cluster: Ints, motions: Floats, *, converged: bool = True) -> PairPrediction:
    """Numbers the movers by falling size, drops those without points, and scatters the labels to the beams.

    Args:
        pair: the pair.
        association: (N,) target point, -1 outlier.
        cluster: (N,) row of `motions`, 0 background, -1 outlier.
        motions: (K+1, 3) `T_target_source`.
        converged: whether the method had converged.
    """
    assert len(association) == len(cluster) == len(pair.source)
    sizes = np.bincount(cluster[cluster > BACKGROUND], minlength=len(motions))
    movers = [k for k in np.argsort(-sizes, kind="stable").tolist() if k != BACKGROUND and sizes[k] > 0]
    number = np.full(len(motions) + 1, OUTLIER)  # the last entry maps -1 to -1
    number[[BACKGROUND, *movers]] = np.arange(1 + len(movers))
    beam = np.append(pair.target.beam, OUTLIER)
    confidence = pair.source.to_beams(np.ones(len(pair.source)), 0.0)
    return PairPrediction(
        association=pair.source.to_beams(beam[association], OUTLIER),
        cluster=pair.source.to_beams(number[cluster], OUTLIER),
        motions=motions[[BACKGROUND, *movers]],
        association_confidence=confidence,
        cluster_confidence=confidence.copy(),
        converged=converged,
    )


def all_outliers(pair: ScanPair, motion: Floats = IDENTITY) -> PairPrediction:
    """The prediction if a scan is empty: all points are outliers."""
    nothing = np.full(len(pair.source), OUTLIER)
    return to_prediction(pair, nothing, nothing, motion[None])


def as_background(pair: ScanPair, association: Ints, motion: Floats, *, converged: bool = True) -> PairPrediction:
    """All associated points are background. association: (N,) target point, -1 outlier; motion: (3,)."""
    cluster = np.where(association >= 0, BACKGROUND, OUTLIER)
    return to_prediction(pair, association, cluster, motion[None], converged=converged)
