"""Motions of one body's points onto the target scan, and the nearest target points under a motion."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from torchcrf_scan.baselines.cloud import Cloud, fit_motion
from torchcrf_scan.baselines.trimmed_icp import slide
from torchcrf_scan.batch import range_noise_of
from torchcrf_scan.data.annotate import scan_gate
from torchcrf_scan.geometry import se2
from torchcrf_scan.scan import OUTLIER, Floats, Ints, ScanPair

FOLLOWS = -2  # no target point given by hand: the nearest one within the gate counts
WIDE = (8.0, 8.0, 4.0, 4.0, 2.0, 2.0)  # gates of a search for a motion, one a round; then 1 until nothing changes
STARTS = 4  # at most, of a search
ROUNDS = 40  # at most
ALONG = 0.1  # weight of distances along the target's surface, beside 1 across it
SETTLED = 1e-9  # radians or metres


@dataclass(frozen=True, slots=True)
class Scans:
    """The points of a pair, and how far apart an associated pair of them may be.

    Attributes:
        pair: the scans. source: (N, 2) its points. target: the points that they go to; None: there is none.
        gate: metres.
    """

    pair: ScanPair
    source: Floats
    target: Cloud | None
    gate: float

    @classmethod
    def of(cls, pair: ScanPair, gate: float | None = None) -> Scans:
        """gate: metres; None: by the target's spacing and noise."""
        target = Cloud.of(pair.target) if len(pair.target) else None
        spacing = np.zeros(1) if target is None else target.spacing
        return cls(pair, pair.source.points, target, gate or scan_gate(spacing, range_noise_of(pair)))

    def nearest(self, moved: Floats, within: float = 1.0) -> Ints:
        """(P,) the nearest target point within so many gates, or -1. moved: (P, 2), NaN for a motion that is unknown."""
        is_known = np.isfinite(moved).all(-1)
        found = np.full(len(moved), OUTLIER)
        if self.target is not None:
            distance, index = self.target.nearest(moved[is_known])
            found[is_known] = np.where(distance <= within * self.gate, index, OUTLIER)
        return found

    def misfit(self, moved: Floats) -> float:
        """Mean distance to the nearest target points, metres; those beyond a few gates count as that. moved: (P, 2)."""
        if self.target is None or not len(moved):
            return 0.0
        return float(np.minimum(self.target.nearest(moved)[0], WIDE[0] * self.gate).mean())


def fit(scans: Scans, points: Floats, given: Ints, start: Floats, is_line: bool, gates: Iterable[float] = ()) -> Floats:
    """(3,) `T_target_source` of a body: point-to-line or Kabsch (Eq. 6), and nearest points within the gate, in turn.

    Args:
        points: (P, 2) of the source.
        given: (P,) target points fixed by hand, -1 none, `FOLLOWS` the nearest.
        start: (3,). With fewer than two associated points its rotation is kept, without any all of it.
        is_line: only distances across the target's surface count.
        gates: multiples of the gate in the first rounds.
    """
    motion = start
    for gate in (*gates, *[1.0] * ROUNDS):
        before = motion
        association = np.where(given == FOLLOWS, scans.nearest(se2.apply(motion, points), gate), given)
        motion = _fitted(scans, points, association, motion, is_line)
        if gate == 1.0 and np.abs(motion - before).max() < SETTLED:
            break
    return motion


def search(scans: Scans, points: Floats, given: Ints, starts: Iterable[Floats], is_line: bool) -> Floats:
    """(3,) the motion that fits best of those found from the best starts, with gates that narrow down."""

    def misfit(motion: Floats) -> float:
        return scans.misfit(se2.apply(motion, points))

    return min((fit(scans, points, given, start, is_line, WIDE) for start in sorted(starts, key=misfit)[:STARTS]), key=misfit)


def _fitted(scans: Scans, points: Floats, association: Ints, motion: Floats, is_line: bool) -> Floats:
    is_inlier = association != OUTLIER
    if scans.target is None or not is_inlier.any():
        return motion
    here, index = points[is_inlier], association[is_inlier]
    there, moved = scans.target.points[index], se2.apply(motion, here)
    if len(here) == 1:
        return motion + np.append(0.0, (there - moved)[0])
    if is_line:
        return _slid(motion, moved, there, scans.target.tangent[index])
    return fit_motion(here, there)


def _slid(motion: Floats, moved: Floats, there: Floats, tangent: Floats) -> Floats:
    """One point-to-line step; along the surface, where the points say little, they count `ALONG` times."""
    has_line = np.hypot(*tangent.T) > 0
    tangent = np.where(has_line[:, None], tangent, (1.0, 0.0))
    normal = np.stack([-tangent[:, 1], tangent[:, 0]], axis=-1)
    weights = np.append(np.ones(len(moved)), np.where(has_line, ALONG, 1.0))
    moved, there = (np.concatenate([values, values]) for values in (moved, there))
    return slide(motion[None], moved[None], there[None], np.concatenate([tangent, normal])[None], weights[None])[0]
