"""The paper's ICP (spec 9.1): associations by reciprocal nearest neighbours under one rigid motion, and its calibration."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from torchcrf_scan.baselines.cloud import Cloud, fit_motion
from torchcrf_scan.baselines.labels import IDENTITY, all_outliers, as_background
from torchcrf_scan.baselines.trimmed_icp import register_trimmed
from torchcrf_scan.errors import TorchCRFScanError
from torchcrf_scan.geometry import se2
from torchcrf_scan.scan import OUTLIER, Floats, Ints, PairPrediction, ScanPair

FOUND = 0.346  # share of outliers of the paper's ICP; its rejection rule is not given
GATES = (*(round(0.03 * 1.35**k, 4) for k in range(18)), math.inf)  # metres, to choose from; with the last only reciprocity rejects
LOOSE_GATE = 0.5  # metres
DEVIATIONS = 2.5
ROUNDS = 50
ROTATION_TOLERANCE, TRANSLATION_TOLERANCE = 1e-4, 1e-3  # radians, metres


def match_icp(pair: ScanPair, *, gate: float | None = None, initial_motion: Floats | None = None) -> PairPrediction:
    """Background everywhere except for the rejected points, which are outliers.

    Args:
        pair: two scans.
        gate: maximum distance to a counterpart, metres; None: the larger of 0.5 m and 2.5 median absolute deviations.
        initial_motion: (3,) initial `T_target_source`; None: the identity.
    """
    motion = IDENTITY if initial_motion is None else np.asarray(initial_motion, dtype=np.float64)
    if not len(pair.source) or not len(pair.target):
        return all_outliers(pair, motion)
    source, target = Cloud.of(pair.source), Cloud.of(pair.target)
    has_settled = False
    for _ in range(ROUNDS):
        association = associate(source, target, motion, gate)
        kept = association >= 0
        if np.count_nonzero(kept) < 2:  # the rotation would be undetermined
            break
        previous, motion = motion, fit_motion(source.points[kept], target.points[association[kept]])
        rotation, translation = se2.distance(motion, previous)
        has_settled = bool(rotation < ROTATION_TOLERANCE and translation < TRANSLATION_TOLERANCE)
        if has_settled:
            break
    return as_background(pair, associate(source, target, motion, gate), motion, converged=has_settled)


def associate(source: Cloud, target: Cloud, motion: Floats, gate: float | None) -> Ints:
    """(N,) nearest target point if the point is also that one's nearest and within the gate, else -1. One to one."""
    distance, nearest = target.nearest(se2.apply(motion, source.points))
    home = source.nearest(se2.apply(se2.inverse(motion), target.points))[1]  # (M,)
    is_mutual = home[nearest] == np.arange(len(source))
    limit = loose_gate(distance[is_mutual]) if gate is None else gate
    return np.where(is_mutual & (distance <= limit), nearest, OUTLIER)


def loose_gate(distance: Floats) -> float:
    """Metres: the larger of 0.5 m and 2.5 median absolute deviations. distance: (P,)."""
    if not len(distance):
        return LOOSE_GATE
    return max(LOOSE_GATE, DEVIATIONS * float(np.median(np.abs(distance - np.median(distance)))))


def found_shares(pair: ScanPair, gates: Sequence[float] = GATES) -> Floats:
    """(G,) share of the valid, annotated source points that are outliers of ICP at each gate; NaN without such points."""
    counted = pair.source.to_beams(np.ones(len(pair.source), dtype=bool), False)
    if pair.annotation is not None:
        counted &= ~pair.annotation.ignore
    if not counted.any():
        return np.full(len(gates), np.nan)
    return np.array([np.mean(match_icp(pair, gate=gate).association[counted] == OUTLIER) for gate in gates])


def choose_gate(shares: Floats, gates: Sequence[float] = GATES) -> float:
    """The gate (metres) whose mean share of outliers is closest to the paper's 34.6 %, the first among equals.

    shares: (P, G) of `found_shares`; pairs of NaN are skipped. To be called with training pairs only.

    Raises:
        TorchCRFScanError: shares of another shape, or NaN for all pairs.
    """
    shares = np.asarray(shares, dtype=np.float64)
    if shares.ndim != 2 or shares.shape[1] != len(gates):
        raise TorchCRFScanError(f"shares: expected shape (P, {len(gates)}), got {shares.shape}")
    telling = shares[np.isfinite(shares).all(-1)]
    if not len(telling):
        raise TorchCRFScanError("shares: expected at least one pair with annotated points, got none")
    return gates[int(np.abs(telling.mean(0) - FOUND).argmin())]


def match_background(pair: ScanPair) -> PairPrediction:
    """Sanity baseline: every point is background under the trimmed ICP's motion and associated with its nearest target point."""
    if not len(pair.source) or not len(pair.target):
        return all_outliers(pair)
    source, target = Cloud.of(pair.source), Cloud.of(pair.target)
    motion = register_trimmed(source, target)
    return as_background(pair, target.nearest(se2.apply(motion, source.points))[1], motion)
