"""Scans one by one: where the sensor is, what moves, and whether to believe it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from torchcrf_scan.geometry import se2
from torchcrf_scan.model import JointScanCRF
from torchcrf_scan.result import ScanResult, Status
from torchcrf_scan.scan import BACKGROUND, OUTLIER, Floats, Ints, PairPrediction, Scan
from torchcrf_scan.stream import twist
from torchcrf_scan.stream.clock import Clock
from torchcrf_scan.stream.config import StreamConfig
from torchcrf_scan.stream.covariance import LEAST, unknown, velocity_covariance, world_covariance
from torchcrf_scan.stream.placement import Placement, following, grid_at, place
from torchcrf_scan.stream.sanity import Backed, choose_background, labels_without_match
from torchcrf_scan.stream.view import History, View

FEWEST_POINTS = 3  # fewer returns do not determine a motion
DOUBTED = 0.5  # a keyframe that explains less than this share of what the scan before explains is not believed
ASTRAY = (
    0.5  # metres or radians between the placements on the keyframe and on the scan before, from which the former is not believed
)


@dataclass(frozen=True, slots=True)
class _Placed:
    """A scan placed in the world: its labels by point, its pose and covariance there, and on which scan it was placed."""

    cluster: Ints
    pose: Floats
    covariance: Floats
    placement: Placement
    has_keyframe: bool


class ScanStream:
    """Ego motion and moving points of scans that are fed one by one, in constant memory.

    Every scan is matched to an earlier one, from where constant velocity or odometry predict it, which labels its points. Its
    background is then placed on a keyframe, as long as that explains it. What cannot be placed is predicted, and said to be.

    Args:
        model: None: the default model of the package.
        config: settings; None: the defaults.
    """

    def __init__(self, model: JointScanCRF | None = None, config: StreamConfig | None = None) -> None:
        self.model = model or JointScanCRF.from_pretrained()
        self.config = config or StreamConfig()
        self._factor = float(self.model.calibration.covariance_factor)
        self._clock = Clock()
        self._history = History(self.config.history)
        self._keyframe: View | None = None
        self._pose, self._twist = np.zeros(3), np.zeros(3)
        self._covariance = LEAST
        self._odometry: Floats | None = None

    def feed(self, scan: Scan, stamp: float, odometry: Floats | None = None) -> ScanResult:
        """What is known after one more scan.

        Args:
            stamp: seconds, of its first beam. Stamps that stand still, go back or are not finite count as one usual interval
                after the scan before.
            odometry: (3,) pose (theta, x, y) of the sensor by the wheels, in any frame that stays; its motion since the scan
                before is the first guess. None or not finite: constant velocity.
        """
        interval = self._clock.advance(stamp)
        predicted = self._predict(interval, odometry)
        if len(scan) < FEWEST_POINTS:
            return self._lost(scan, stamp, predicted, f"{len(scan)} returns; at least {FEWEST_POINTS} are needed")
        grid = grid_at(scan, scan.points)
        if self._keyframe is None:
            return self._begin(View(scan, grid, grid, predicted, self._clock.now), stamp)
        reference = self._history.before(self._clock.now - self.config.lag)
        guess = se2.compose(se2.inverse(reference.pose), predicted)
        found = self._match(scan, reference, guess)
        backed = choose_background(found.motions[0], guess, grid, reference.grid)
        if backed.share < self.config.least_share:
            return self._not_placed(scan, stamp, predicted, backed)
        placed = self._place(scan, found, backed, reference, predicted)
        return self._take(scan, stamp, interval, placed)

    # --- the steps ----------------------------------------------------------------------------------------------------------------

    def _predict(self, interval: float, odometry: Floats | None) -> Floats:
        """(3,) the pose `interval` seconds after the last one, by odometry or constant velocity; after a gap where it was."""
        before, self._odometry = self._odometry, None
        if odometry is not None and np.isfinite(odometry).all():
            self._odometry = np.asarray(odometry, dtype=np.float64)
            if before is not None:
                return se2.compose(self._pose, se2.compose(se2.inverse(before), self._odometry))
        if interval > self.config.gap:
            return self._pose
        return se2.compose(self._pose, twist.exp(interval * self._twist))

    def _match(self, scan: Scan, reference: View, guess: Floats) -> PairPrediction:
        """The scan matched to an earlier one: a pair's answer labels its source, so that is the new scan."""
        return self.model.match(scan, reference.scan, self._clock.now - reference.time, initial_motion=guess.tolist())

    def _place(self, scan: Scan, found: PairPrediction, backed: Backed, reference: View, predicted: Floats) -> _Placed:
        """The scan's background on the keyframe, or on the scan before if that explains it much better."""
        assert self._keyframe is not None
        cluster = found.cluster[scan.beam] if backed.is_found else labels_without_match(backed)
        if np.count_nonzero(cluster == BACKGROUND) < FEWEST_POINTS:
            cluster = labels_without_match(backed)
        background = grid_at(scan, scan.points[cluster == BACKGROUND])
        near = place(background, reference.background, backed.motion, self._factor)
        pose = se2.compose(reference.pose, near.motion)
        key = place(background, self._keyframe.background, se2.compose(se2.inverse(self._keyframe.pose), pose), self._factor)
        apart = se2.compose(se2.inverse(se2.compose(self._keyframe.pose, key.motion)), pose)
        has_keyframe = key.share >= DOUBTED * near.share and bool(np.abs(apart).max() < ASTRAY)
        placement, frame = (key, self._keyframe) if has_keyframe else (near, reference)
        motion = following(placement, se2.compose(se2.inverse(frame.pose), predicted))
        covariance = world_covariance(placement.covariance, frame.pose)
        return _Placed(cluster, se2.compose(frame.pose, motion), covariance, placement, has_keyframe)

    def _take(self, scan: Scan, stamp: float, interval: float, placed: _Placed) -> ScanResult:
        """Remembers a placed scan and says what is known."""
        background = grid_at(scan, scan.points[placed.cluster == BACKGROUND])
        view = View(scan, grid_at(scan, scan.points), background, placed.pose, self._clock.now)
        velocity = twist.log(se2.compose(se2.inverse(self._pose), placed.pose)) / interval
        spread = velocity_covariance(placed.covariance, self._covariance, placed.pose, interval)
        self._pose, self._twist, self._covariance = placed.pose, velocity, placed.covariance
        self._history.add(view, self.config.lag)
        if not (placed.has_keyframe and self._keeps_keyframe(placed.placement)):
            self._keyframe = view
        reason = unobserved_in_words(placed.placement)
        status: Status = "degenerate" if reason else "ok"
        return self._result(scan, stamp, placed.cluster, spread, status, reason)

    def _keeps_keyframe(self, placement: Placement) -> bool:
        theta, x, y = placement.motion
        config = self.config
        is_near = np.hypot(x, y) < config.keyframe_distance and abs(theta) < config.keyframe_turn
        return bool(is_near and placement.share >= config.keyframe_share)

    # --- the answers --------------------------------------------------------------------------------------------------------------

    def _begin(self, view: View, stamp: float) -> ScanResult:
        """The first scan, and that after a gap: all background."""
        self._history.clear()
        self._history.add(view, self.config.lag)
        self._keyframe, self._pose, self._covariance = view, view.pose, LEAST
        labels = np.full(len(view.scan), BACKGROUND)
        return self._result(view.scan, stamp, labels, unknown(), "ok", "")

    def _not_placed(self, scan: Scan, stamp: float, predicted: Floats, backed: Backed) -> ScanResult:
        """A scan that no motion explains: predicted; after a gap the stream starts anew from there."""
        reason = (
            f"{100 * backed.share:.0f} % of the returns are explained; at least {100 * self.config.least_share:.0f} % are needed"
        )
        since = self._clock.now - self._history.last.time
        if since > self.config.gap:
            grid = grid_at(scan, scan.points)
            self._begin(View(scan, grid, grid, predicted, self._clock.now), stamp)
            reason += f"; started anew after {since:.2g} s without a placed scan"
        return self._lost(scan, stamp, predicted, reason)

    def _lost(self, scan: Scan, stamp: float, predicted: Floats, reason: str) -> ScanResult:
        self._pose, self._covariance = predicted, unknown()
        return self._result(scan, stamp, np.full(len(scan), OUTLIER), unknown(), "lost", reason)

    def _result(self, scan: Scan, stamp: float, cluster: Ints, spread: Floats, status: Status, reason: str) -> ScanResult:
        return ScanResult(
            scan=scan,
            stamp=float(stamp),
            pose=self._pose.copy(),
            covariance=self._covariance.copy(),
            twist=self._twist.copy(),
            twist_covariance=spread,
            moving=scan.to_beams(cluster > BACKGROUND, False),
            track=scan.to_beams(cluster, OUTLIER),
            objects=(),
            status=status,
            reason=reason,
        )


def unobserved_in_words(placement: Placement) -> str:
    """Which part of a motion is not observed; empty: none."""
    if not placement.is_degenerate:
        return ""
    turn, x, y = np.diag(placement.unobserved)
    parts = (["the turn"] if turn > 0.5 else []) + (["the shift along a direction"] if x + y > 0.5 else [])
    return f"{' and '.join(parts) or 'a combination of turn and shift'} is not observed, and predicted"
