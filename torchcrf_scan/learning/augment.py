"""Augmentation of pairs: mirroring, lost returns, noise. Pure functions of (pair, generator); annotations are transformed too.

A target in another frame is not a scan any more, as its rays do not start at 0, so the offset is drawn here (`frame_offset`)
and applied to the batch (`ScanPairBatch.displaced`).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch

from torchcrf_scan.learning.settings import AugmentConfig
from torchcrf_scan.scan import MAX_RANGE_MARGIN, OUTLIER, Annotation, Bools, Floats, Ints, Scan, ScanPair

USUAL_NOISE = 0.01  # metres, for sensors of unknown noise
NEAREST = 1e-3  # metres; lower bound of noisy ranges
HANDS = np.array([-1.0, 1.0, -1.0])  # signs of (theta, tx, ty) under mirroring


def augment(pair: ScanPair, config: AugmentConfig, generator: torch.Generator) -> ScanPair:
    """The pair with all augmentations of `config`; a function of the generator's state."""
    pair = mirror(pair) if _uniform(generator) < config.mirror else pair
    pair = drop_returns(pair, config.dropout * _uniform(generator), generator)
    return add_noise(pair, config.noise * _uniform(generator), generator)


def _uniform(generator: torch.Generator) -> float:
    return float(torch.rand((), generator=generator, dtype=torch.float64))


# --- mirror -------------------------------------------------------------------------------------------------------------------


def mirror(pair: ScanPair) -> ScanPair:
    """The pair with left and right exchanged; an involution. Beams are counted from the other end."""
    guess = None if pair.initial_motion is None else np.asarray(pair.initial_motion, dtype=np.float64) * HANDS
    annotation = pair.annotation and _mirror_annotation(pair.annotation, pair.target.n_beams)
    return replace(
        pair, source=_mirror_scan(pair.source), target=_mirror_scan(pair.target), annotation=annotation, initial_motion=guess
    )


def _mirror_scan(scan: Scan) -> Scan:
    """The mirrored scan: bearings change their sign, and reversing the beams makes them ascend again."""
    beam = scan.n_beams - 1 - scan.beam[::-1]
    times = None if scan.times is None else scan.times[::-1].copy()
    return replace(scan, ranges=scan.ranges[::-1].copy(), bearings=-scan.bearings[::-1], beam=beam, times=times)


def _mirror_annotation(truth: Annotation, target_beams: int) -> Annotation:
    """Labels by reversed source beam, associations to reversed target beams, mirrored motions."""
    association = truth.association[::-1]
    return Annotation(
        association=np.where(association >= 0, target_beams - 1 - association, OUTLIER),
        cluster=truth.cluster[::-1].copy(),
        motions=truth.motions * HANDS,
        body=truth.body[::-1].copy(),
        ignore=truth.ignore[::-1].copy(),
    )


# --- dropouts -----------------------------------------------------------------------------------------------------------------


def drop_returns(pair: ScanPair, share: float, generator: torch.Generator) -> ScanPair:
    """Both scans without a share of their returns, each return dropped independently.

    A source return whose counterpart is dropped is ignored: whether a neighbour would be one is not annotated.
    """
    if share <= 0:
        return pair
    source, source_lost = _drop(pair.source, share, generator)
    target, target_lost = _drop(pair.target, share, generator)
    annotation = pair.annotation and _without(pair.annotation, source_lost, target_lost)
    return replace(pair, source=source, target=target, annotation=annotation)


def _drop(scan: Scan, share: float, generator: torch.Generator) -> tuple[Scan, Bools]:
    """The scan without the dropped returns, and (n_beams,) whether a beam's return was dropped."""
    keep = (torch.rand(len(scan), generator=generator, dtype=torch.float64) >= share).numpy()
    lost = scan.to_beams(~keep, False)
    return scan.only(keep), lost


def _without(truth: Annotation, source_lost: Bools, target_lost: Bools) -> Annotation:
    partner_lost = (truth.association >= 0) & target_lost[truth.association]  # -1 indexes the last beam and is masked
    unknown = source_lost | partner_lost
    association: Ints = np.where(unknown, OUTLIER, truth.association)
    return replace(truth, association=association, cluster=np.where(unknown, OUTLIER, truth.cluster), ignore=truth.ignore | unknown)


# --- noise --------------------------------------------------------------------------------------------------------------------


def add_noise(pair: ScanPair, amount: float, generator: torch.Generator) -> ScanPair:
    """Noise on all ranges, `amount` times the sensor's; a stated sensor noise becomes the combined one. Labels are unchanged."""
    if amount <= 0:
        return pair
    return replace(pair, source=_noisy(pair.source, amount, generator), target=_noisy(pair.target, amount, generator))


def _noisy(scan: Scan, amount: float, generator: torch.Generator) -> Scan:
    """Ranges are kept within the sensor's limits, so that no return becomes invalid."""
    noise = USUAL_NOISE if scan.range_noise is None else scan.range_noise
    error: Floats = amount * noise * torch.randn(len(scan), generator=generator, dtype=torch.float64).numpy()
    nearest = max(scan.range_min or 0.0, 0.0) + NEAREST
    farthest = np.inf if scan.range_max is None else scan.range_max - MAX_RANGE_MARGIN - NEAREST
    low, high = np.minimum(scan.ranges, nearest), np.maximum(scan.ranges, farthest)  # a return at the limit is unchanged
    stated = None if scan.range_noise is None else noise * float(np.hypot(1.0, amount))
    return replace(scan, ranges=np.clip(scan.ranges + error, low, high), range_noise=stated)


# --- frames -------------------------------------------------------------------------------------------------------------------


def frame_offset(pair: ScanPair, config: AugmentConfig, generator: torch.Generator) -> Floats:
    """(3,) motion of the target's points into another frame, for `ScanPairBatch.displaced`."""
    usual = float(np.median(pair.target.ranges)) if len(pair.target) else 0.0
    most = np.array([config.frame_rotation, config.frame_translation * usual, config.frame_translation * usual])
    return most * (2 * torch.rand(3, generator=generator, dtype=torch.float64).numpy() - 1)
