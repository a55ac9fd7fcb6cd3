"""Measures of scene flow: end-point errors of three kinds of points, by speed and by range, and moving points found by speed.

The flow of a source point is where its body's motion takes it, minus where it is. The points are the annotated returns whose body
and its motion are known, with or without a counterpart (`body` of a pair file). The answered flow is that of the point's answered
cluster; answered outliers have no motion and take that of the nearest answered inlier (`counterparts.clusters_beneath`).

Three kinds (Argoverse 2, task 3D scene flow: foreground dynamic, foreground static, background static), by the true labels:

- moving: of an annotated object, at 0.5 m/s or more over the ground, T_0^-1 T_k p - p in `dt` seconds;
- standing: of an annotated object, slower. A planar pair numbers the bodies that move within it, so most recordings have none;
- background: body 0, parked cars and furniture included: nobody has annotated them apart.

Published figures are of 3-D clouds whose ground has been removed and whose ego motion is given. Here the sensor's motion is
answered too, and its error is in every number.

Sources: Wilson et al., Argoverse 2, NeurIPS Datasets 2021, and the evaluation of its scene flow challenge (av2-api); Chodosh,
Ramanan, Lucey, Re-Evaluating LiDAR Scene Flow, WACV 2024 (three-way error); Liu, Qi, Guibas, FlowNet3D, CVPR 2019 (accuracies);
Khatri, Vedder, Peri, Ramanan, Hays, I Can't Believe It's Not Scene Flow!, ECCV 2024 (bucket-normalised error); Lin, Caesar,
ICP-Flow, CVPR 2024; Zhang et al., TeFlow, CVPR 2026.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from torchcrf_scan.evaluation.counterparts import annotation_of, clusters_beneath
from torchcrf_scan.evaluation.measures import mean, percent
from torchcrf_scan.geometry import se2
from torchcrf_scan.scan import BACKGROUND, OUTLIER, Bools, Floats, Ints, PairPrediction, ScanPair

SLOWEST = 0.5  # metres per second over the ground from which a point moves
KINDS = ("moving", "standing", "background")
STRICT, RELAXED = 0.05, 0.1  # metres, and as shares of the way over the ground
BUCKET, FASTEST = 0.4, 20.0  # metres per second: width of a bucket of speed, and from where one bucket holds all


@dataclass(frozen=True, slots=True)
class FlowErrors:
    """Flow of P points of known flow, of one pair or many.

    Attributes:
        error: (P,) metres between true and answered end point.
        kind: (P,) index into `KINDS`.
        way: (P,) metres travelled over the ground by truth. speed, found_speed: (P,) metres per second by truth, by answer.
        range: (P,) metres from the sensor in the first scan.
    """

    error: Floats
    kind: Ints
    way: Floats
    speed: Floats
    found_speed: Floats
    range: Floats

    @classmethod
    def of(cls, pair: ScanPair, prediction: PairPrediction) -> FlowErrors:
        """The errors of an annotated pair; raises TorchCRFScanError for a pair without annotation.

        A cluster without a finite answered motion moves with the answered background, and that, if it is unknown, not at all.
        """
        truth, beam, points = annotation_of(pair), pair.source.beam, pair.source.points
        body = np.where(truth.cluster[beam] != OUTLIER, truth.cluster[beam], truth.body[beam])
        is_finite = np.asarray(np.isfinite(truth.motions).all(axis=1))
        known = ~truth.ignore[beam] & (body >= BACKGROUND) & (body < len(is_finite)) & is_finite[BACKGROUND]
        known[known] = is_finite[body[known]]
        end, way = _carried(points[known], body[known], truth.motions)
        found, found_way = _carried(points[known], clusters_beneath(pair, prediction)[known], _usable(prediction.motions))
        speed = way / pair.dt
        kind = np.where(body[known] == BACKGROUND, 2, np.where(speed >= SLOWEST, 0, 1))
        error = np.linalg.norm(found - end, axis=-1)
        return cls(error, kind, way, speed, found_way / pair.dt, pair.source.ranges[known])

    @classmethod
    def pool(cls, parts: Sequence[FlowErrors]) -> FlowErrors:
        """The points of many pairs together; none without pairs."""
        names = ("error", "kind", "way", "speed", "found_speed", "range")
        kinds = {"kind": np.int64}
        return cls(*(np.concatenate([np.zeros(0, kinds.get(name)), *(getattr(part, name) for part in parts)]) for name in names))

    @property
    def is_moving(self) -> Bools:
        """(P,) by truth."""
        return self.kind == KINDS.index("moving")

    @property
    def is_found_moving(self) -> Bools:
        """(P,) by the answer's speed."""
        return self.found_speed >= SLOWEST


def _usable(motions: Floats) -> Floats:
    """Motions (K+1, 3) without gaps: unknown ones are the background's, or the identity."""
    whole = np.zeros((max(len(motions), 1), 3))
    whole[: len(motions)] = motions
    whole[0] = np.where(np.isfinite(whole[0]).all(), whole[0], 0.0)
    return np.where(np.isfinite(whole).all(-1, keepdims=True), whole, whole[:1])


def _carried(points: Floats, cluster: Ints, motions: Floats) -> tuple[Floats, Floats]:
    """(P, 2) where the motions of their clusters (P,) take points (P, 2), and (P,) metres on the way over the ground."""
    cluster = np.where(cluster < len(motions), cluster, BACKGROUND)
    end = se2.apply(motions[cluster], points[:, None])[:, 0]  # (P, 1, 2) -> (P, 2)
    standing = se2.apply(motions[BACKGROUND], points)
    return end, np.linalg.norm(end - standing, axis=-1)


def end_point_errors(flow: FlowErrors) -> dict[str, float]:
    """Mean end-point errors in metres, and accuracies in percent; NaN without points.

    - `epe`: of all points. `epe_moving`, `epe_standing`, `epe_background`: of each kind.
    - `epe_threeway`: mean of the three, of those that have points; `epe_kinds`, how many that are.
    - `points_moving`, `points_standing`, `points_background`: how many points.
    - `accuracy_strict`, `accuracy_relaxed`: points with an error below 5 cm or 5 % (10 cm or 10 %) of their way over the ground,
      and `_moving` of the moving ones alone.
    """
    means = {f"epe_{name}": mean(flow.error[flow.kind == k]) for k, name in enumerate(KINDS)}
    there = [value for value in means.values() if np.isfinite(value)]
    points = {f"points_{name}": float((flow.kind == k).sum()) for k, name in enumerate(KINDS)}
    found = {**points, "epe": mean(flow.error), **means, "epe_threeway": mean(np.array(there)), "epe_kinds": float(len(there))}
    for name, bound in (("strict", STRICT), ("relaxed", RELAXED)):
        is_near = (flow.error < bound) | (flow.error < bound * flow.way)
        found[f"accuracy_{name}"] = 100 * mean(is_near)
        found[f"accuracy_{name}_moving"] = 100 * mean(is_near[flow.is_moving])
    return found


def bucket_normalised(flow: FlowErrors) -> dict[str, float]:
    """Bucket-normalised end-point error (Khatri et al.), with all annotated objects as one class.

    Buckets of 0.4 m/s over the ground up to 20 m/s, and one beyond. `bucket_static`: mean error of the background, whose only
    bucket is the first, metres. `bucket_dynamic`: of the objects, the mean over buckets but the first, as far as they hold points,
    of mean error over mean way: 0 all of the motion is described, 1 as good as none. `buckets`: how many that are.
    """
    is_object = flow.kind < KINDS.index("background")
    bucket = np.minimum(flow.speed // BUCKET, FASTEST // BUCKET).astype(np.int64)
    full = np.unique(bucket[is_object & (bucket > 0)])
    of = [is_object & (bucket == k) for k in full]
    shares = np.array([flow.error[own].mean() / flow.way[own].mean() for own in of])
    return {"bucket_static": mean(flow.error[~is_object]), "bucket_dynamic": mean(shares), "buckets": float(len(full))}


def moving_shares(flow: FlowErrors) -> dict[str, float]:
    """`speed_iou`, `speed_precision`, `speed_recall`, `speed_f1` of the points at 0.5 m/s or more, percent; NaN of 0/0.

    By the answer's flow, not by its labels: those are in `metrics.PairScore.moving_both`.
    """
    both = float((flow.is_moving & flow.is_found_moving).sum())
    true, found = float(flow.is_moving.sum()), float(flow.is_found_moving.sum())
    return {
        "speed_iou": percent(both, true + found - both),
        "speed_precision": percent(both, found),
        "speed_recall": percent(both, true),
        "speed_f1": percent(2 * both, true + found),
    }
