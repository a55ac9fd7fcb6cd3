"""Panoptic quality of the movers of a pair.

A true mover and an answered one match if their IoU is above 0.5, which at most one pair of them can reach. Of the matches TP, the
unmatched answered movers FP and the unmatched true ones FN:

    PQ = sum of the matches' IoU / (|TP| + |FP| / 2 + |FN| / 2) = SQ RQ,  SQ: mean IoU of the matches,  RQ: their F1

Points without annotation or without a counterpart are void: they belong to no segment, and an answered mover most of whose points
are void is not counted as wrong. Unmatched segments of fewer than five points are not counted either, as the benchmark of
SemanticKITTI leaves out those below fifty points of a 3-D cloud.

Sources: Kirillov, He, Girshick, Rother, Dollar, Panoptic Segmentation, CVPR 2019; Behley, Milioto, Stachniss, A Benchmark for
LiDAR-based Panoptic Segmentation based on KITTI, ICRA 2021.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from torchcrf_scan.evaluation.counterparts import annotation_of
from torchcrf_scan.evaluation.measures import percent
from torchcrf_scan.evaluation.metrics import MOVER_MIN_POINTS
from torchcrf_scan.scan import BACKGROUND, OUTLIER, Bools, Ints, PairPrediction, ScanPair

LEAST_IOU = 0.5  # exceeded by a match


@dataclass(frozen=True, slots=True)
class PanopticCount:
    """Matches of some movers.

    Attributes:
        overlap: sum of the matches' IoU. matched: their number. false, missed: answered and true movers without a match.
    """

    overlap: float
    matched: int
    false: int
    missed: int

    @classmethod
    def of(cls, pair: ScanPair, prediction: PairPrediction) -> PanopticCount:
        """The movers of an annotated pair; raises TorchCRFScanError for a pair without annotation."""
        truth, beam = annotation_of(pair), pair.source.beam
        cluster = truth.cluster[beam]
        return count_segments(cluster, prediction.cluster[beam], truth.ignore[beam] | (cluster == OUTLIER))


def count_segments(cluster: Ints, predicted: Ints, is_void: Bools, least: int = MOVER_MIN_POINTS) -> PanopticCount:
    """Counts the matches of segments above `BACKGROUND`. cluster, predicted, is_void: (N,). least: points of an unmatched one."""
    known = ~is_void
    true = [cluster[known] == k for k in np.unique(cluster[known & (cluster > BACKGROUND)])]
    numbers = np.unique(predicted[predicted > BACKGROUND])
    found = [predicted[known] == k for k in numbers]
    voids = [int((predicted[is_void] == k).sum()) for k in numbers]
    iou = np.array([[(a & b).sum() / max((a | b).sum(), 1) for b in found] for a in true]).reshape(len(true), len(found))
    is_match = iou > LEAST_IOU
    missed = sum(int(a.sum()) >= least for a, row in zip(true, is_match, strict=True) if not row.any())
    unmatched = [(int(b.sum()), void) for b, void, column in zip(found, voids, is_match.T, strict=True) if not column.any()]
    false = sum(size >= least and size >= void for size, void in unmatched)
    return PanopticCount(float(iou[is_match].sum()), int(is_match.sum()), false, missed)


def panoptic_quality(counts: Sequence[PanopticCount]) -> dict[str, float]:
    """`pq`, `sq` and `rq` of all pairs' movers together, percent; NaN where there is nothing to match."""
    overlap, matched, false, missed = (
        sum(getattr(of, name) for of in counts) for name in ("overlap", "matched", "false", "missed")
    )
    half = matched + (false + missed) / 2
    return {"pq": percent(overlap, half), "sq": percent(overlap, matched), "rq": percent(matched, half)}
