"""What became of the movers of a pair: found, or the step that lost them; and the kinds of movers that are none."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from torchcrf_scan.evaluation.causes.trace import SearchTrace
from torchcrf_scan.geometry import se2
from torchcrf_scan.scan import BACKGROUND, Annotation, Bools, Floats, Ints, PairPrediction, Scan, ScanPair

TOLERANCE = 2.0  # units up to which a motion is right, as nearest points are then about two beams off at most,
TOLERANCE_SHARE = 0.12  # or this share of the way travelled, as in `learning.hypothesis_fit`
PURE = 0.5  # least share of one mover's points among a hypothesis' (or the other way round) that make it a hypothesis of the mover

RIGHT, BACKGROUND_OFF, NO_HYPOTHESIS = "motion right", "background off", "motion not in the pool"
UNLIKELY, RIVALLED = "in the pool, score too low", "in the pool, yielded to another one"
DROPPED, ASTRAY = "considered, dropped by the selection", "kept, motion off"
FOUND, MISLABELLED = "found", "labels wrong although the motion is right"
STATES = (RIGHT, BACKGROUND_OFF, NO_HYPOTHESIS, UNLIKELY, RIVALLED, DROPPED, ASTRAY)
FATES = (FOUND, *STATES[1:], MISLABELLED)

SLIDING, EDGE, A_LITTLE_OFF, OTHER = "sliding along its own line", "at an occlusion edge", "static, a little off", "other"
FALSE_KINDS = (SLIDING, EDGE, A_LITTLE_OFF, OTHER)
THIN = 0.3  # width over length of a line
ALONG = 0.9  # share of the way along the line
NEARER = 5.0  # units by which the return beside it is nearer at an occlusion edge
A_LITTLE = 2.0  # units of displacement


def gap(points: Floats, one: Floats, other: Floats) -> Floats:
    """(N,) metres between points (N, 2) under two motions (3,); NaN for an unknown motion."""
    return np.linalg.norm(se2.apply(one, points) - se2.apply(other, points), axis=-1)


@dataclass(frozen=True, slots=True)
class TrueMover:
    """One annotated mover: its points with a counterpart (all of its points if none has one) and its motion.

    Attributes:
        points: (P, 2) metres. is_member: (N,) bool over the source points, which of them these are.
        motion: (3,) true. tolerance: metres, largest mean distance of a right motion from the true one.
        units: metres, the mean of its points.
    """

    points: Floats
    is_member: Bools
    motion: Floats
    tolerance: float
    units: float

    @classmethod
    def of(cls, number: int, pair: ScanPair, truth: Annotation, units: Floats) -> TrueMover:
        """Mover `number` of a pair. units: (N,) of `SearchTrace`."""
        beam, points = pair.source.beam, pair.source.points
        known = ~truth.ignore[beam]
        is_member = known & (truth.cluster[beam] == number)
        if not is_member.any():
            is_member = known & (truth.body[beam] == number)
        own, motion, unit = points[is_member], truth.motions[number], float(units[is_member].mean())
        travel = gap(own, truth.motions[BACKGROUND], motion).mean()
        return cls(own, is_member, motion, max(TOLERANCE * unit, TOLERANCE_SHARE * np.nan_to_num(travel)), unit)

    def is_right(self, motions: Floats) -> Bools:
        """(H,) whether motions (H, 3) take its points where they should go; False for unknown ones."""
        return self.error(motions) <= self.tolerance

    def error(self, motions: Floats) -> Floats:
        """(H,) metres, mean over its points."""
        return np.array([gap(self.points, motion, self.motion).mean() for motion in motions]).reshape(-1)

    def right_hypotheses(self, trace: SearchTrace) -> Ints:
        """Numbers of the hypotheses that move this mover as it moved, those of the most overlap (IoU) with its points first."""
        shared = (trace.members & self.is_member).sum(-1)
        is_own = shared >= PURE * np.minimum(trace.members.sum(-1), self.is_member.sum())
        right = np.flatnonzero(is_own & (shared > 0) & self.is_right(trace.motions))
        overlap = shared / (trace.members | self.is_member).sum(-1)
        return right[np.argsort(-overlap[right], kind="stable")]


def state_of(mover: TrueMover, truth: Annotation, cluster: Ints, motions: Floats, trace: SearchTrace) -> str:
    """The first of `STATES` that holds: right in the answer, else the step at which the search lost the motion.

    Args:
        cluster: (N,) answered labels of the source points, as the answer numbers them. motions: (K+1, 3) of the answer.
    """
    own = np.unique(cluster[mover.is_member & (cluster > BACKGROUND) & (cluster < len(motions))])
    if mover.is_right(motions[own]).any() or not np.isfinite(mover.motion).all():
        return RIGHT
    if gap(mover.points, motions[BACKGROUND], truth.motions[BACKGROUND]).mean() > TOLERANCE * mover.units:
        return BACKGROUND_OFF
    right = mover.right_hypotheses(trace)
    if not len(right):
        return NO_HYPOTHESIS
    if not np.isin(right, trace.considered).any():
        return RIVALLED if trace.likely[right].any() else UNLIKELY
    return ASTRAY if np.isin(right, trace.accepted).any() else DROPPED


def kind_of_false_mover(pair: ScanPair, prediction: PairPrediction, is_member: Bools, number: int, units: Floats) -> str:
    """The first of `FALSE_KINDS` that holds for an answered mover that is none.

    Sliding: a thin line displaced along itself. Edge: the return beside its ends is nearer, or another return of the second scan
    hides its standing points. A little off: displaced by at most two units.

    Args:
        is_member: (N,) bool, its source points. number: of its motion. units: (N,) of `SearchTrace`.
    """
    standing = se2.apply(prediction.motions[BACKGROUND], pair.source.points[is_member])
    if number >= len(prediction.motions) or not np.isfinite([prediction.motions[k] for k in (0, number)]).all():
        return OTHER
    shift = se2.apply(prediction.motions[number], pair.source.points[is_member]) - standing  # (P, 2)
    if _slides(standing, shift):
        return SLIDING
    if _is_beside_nearer(pair.source, is_member, units) or _is_hidden(standing, pair.target, units[is_member]).any():
        return EDGE
    return A_LITTLE_OFF if np.linalg.norm(shift, axis=-1).mean() <= A_LITTLE * units[is_member].mean() else OTHER


def _slides(points: Floats, shift: Floats) -> bool:
    """Whether points (P, 2) on a thin line are shifted (P, 2) along it."""
    if len(points) < 3:
        return False
    extent, directions = np.linalg.eigh(np.cov(points.T))
    travel = np.linalg.norm(shift, axis=-1).sum()
    is_thin = max(extent[0], 0.0) <= THIN**2 * extent[1]
    return bool(is_thin and np.abs(shift @ directions[:, 1]).sum() >= ALONG * travel)


def _is_beside_nearer(scan: Scan, is_member: Bools, units: Floats) -> bool:
    """Whether a return next to the members (N,) in the scan's order is nearer by `NEARER` of their units (N,)."""
    for step in (-1, 1):
        ranges, outside = np.roll(scan.ranges, -step), ~np.roll(is_member, -step)
        if not scan.is_closed:
            outside[-1 if step == 1 else 0] = False
        if (is_member & outside & (ranges < scan.ranges - NEARER * units)).any():
            return True
    return False


def _is_hidden(points: Floats, scan: Scan, units: Floats) -> Bools:
    """(P,) whether both returns of a scan that are next to a point in bearing are nearer by `NEARER` units (P,)."""
    if len(scan) < 2:
        return np.zeros(len(points), dtype=bool)
    after = np.searchsorted(scan.bearings, np.arctan2(points[:, 1], points[:, 0])).clip(1, len(scan) - 1)
    farther = np.maximum(scan.ranges[after - 1], scan.ranges[after])
    return farther < np.linalg.norm(points, axis=-1) - NEARER * units
