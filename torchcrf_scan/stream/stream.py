"""Scans one by one: where the sensor is, what moves, and whether to believe it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from torchcrf_scan.beams import number, vector
from torchcrf_scan.errors import TorchCRFScanError
from torchcrf_scan.geometry import se2
from torchcrf_scan.model import JointScanCRF
from torchcrf_scan.result import ScanResult, Status
from torchcrf_scan.scan import BACKGROUND, OUTLIER, Floats, Ints, PairPrediction, Scan
from torchcrf_scan.search.grid import ScanGrid
from torchcrf_scan.search.trusted import LEAST_OF_BEST, Backed, choose_background
from torchcrf_scan.stream import twist
from torchcrf_scan.stream.clock import Clock
from torchcrf_scan.stream.config import StreamConfig
from torchcrf_scan.stream.covariance import LEAST, unknown, velocity_covariance, world_covariance
from torchcrf_scan.stream.deskew import Deskewing, deskewed
from torchcrf_scan.stream.fusion import MOST, Standing, fused
from torchcrf_scan.stream.memory import Votes
from torchcrf_scan.stream.objects import Moving, Objects, nothing_moves
from torchcrf_scan.stream.placement import Placement, explained_by, grid_at, place
from torchcrf_scan.stream.view import History, View

FEWEST_POINTS = 3  # fewer returns do not determine a motion
LEAST_OF_INTERVAL = 0.1  # that remain between the times of two poses when the middles of their sweeps differ
DOUBTED = 0.5  # a keyframe that explains less than this share of what the scan before explains is not believed
SHARE_THERE = 0.5  # of `keyframe_share`, which is enough for a keyframe taken where the sensor still is
ALIKE = 0.02  # metres or radians; poses this near explain the same
FASTEST = 100.0  # metres a second, in at least one second, that odometry may go; more is a fault of it
FARTHEST_GUESS = 1e5  # metres that it may go at all: the model takes guesses within 1e6
ASTRAY = 0.5  # metres or radians between placements on both, from which the keyframe is not believed


@dataclass(frozen=True, slots=True)
class _Placed:
    """A scan placed in the world.

    Attributes:
        measured: (3,) its pose before it is settled. covariance: (3, 3) of it.
        placement: on the keyframe or, if not `on_keyframe`, on the scan that it was matched to.
        is_torn: the two disagree.
    """

    view: View
    measured: Floats
    covariance: Floats
    placement: Placement
    on_keyframe: bool
    is_torn: bool


class ScanStream:
    """Ego motion, moving points and objects of scans that are fed one by one, in constant memory.

    Every scan is matched to an earlier one, from where constant velocity or odometry predict it, which labels its points. Its
    background is then placed on a keyframe, as long as that explains it. What cannot be placed is predicted, and said to be.
    With times of the beams, a scan is first corrected for the predicted motion during its sweep, then for the one found.

    Args:
        model: None: the default model of the package.
        config: settings; None: the defaults.
    """

    def __init__(self, model: JointScanCRF | None = None, config: StreamConfig | None = None) -> None:
        self.model = model or JointScanCRF.from_pretrained()
        self.config = config or StreamConfig()
        self._factor = float(self.model.calibration.covariance_factor)
        self._clock = Clock()
        self._deskewing = Deskewing(self.config.deskew)
        self._history = History(self.config.history)
        self._objects = Objects(self.config)
        self._standing = Standing()
        self._keyframe: View | None = None
        self._pose, self._twist = np.zeros(3), np.zeros(3)
        self._covariance = LEAST
        self._has_velocity = self._is_led = False  # whether constant velocity, or odometry, predicts the next pose
        self._late = 0.0  # seconds from the last stamp to the time of the pose
        self._odometry: Floats | None = None

    def feed(self, scan: Scan, stamp: float, odometry: Floats | None = None) -> ScanResult:
        """What is known after one more scan.

        Args:
            stamp: seconds, of its first beam. Stamps that stand still, go back or are not finite count as one usual interval
                after the scan before.
            odometry: (3,) pose (theta, x, y) of the sensor by the wheels, in any frame that stays; its motion since the scan
                before is the first guess. None, not finite or gone faster than `FASTEST`: constant velocity.

        Raises:
            TorchCRFScanError: no scan, a stamp that is no number, or odometry of another shape.
        """
        if not isinstance(scan, Scan):
            raise TorchCRFScanError(f"scan: expected a Scan, got {type(scan).__name__}")
        stamp = number("stamp", stamp, "seconds")
        odometry = None if odometry is None else vector("odometry", odometry, 3)
        interval = self._advance(scan, stamp)
        predicted = self._predict(interval, odometry)
        if len(scan) < FEWEST_POINTS:
            return self._lost(scan, stamp, predicted, f"{len(scan)} returns; at least {FEWEST_POINTS} are needed")
        if self._keyframe is None:
            return self._begin(View.of(scan, predicted, self._now), stamp)
        seen = self._corrected(scan, predicted, interval)
        reference = self._history.before(self._now - self.config.lag)
        guess = se2.compose(se2.inverse(reference.pose), predicted)
        grid = grid_at(seen, seen.points)
        found, votes = self._match(seen, grid, reference, predicted)
        backed = choose_background(found.motions[0], guess, grid, reference.grid)
        if backed.share < self.config.least_share:
            return self._not_placed(scan, stamp, predicted, backed)
        labels = labels_of(found, backed, seen)
        placed = self._place(seen, grid, labels, se2.compose(reference.pose, backed.motion), reference, predicted)
        again = self._corrected(scan, placed.view.pose, interval)  # by the motion found
        if again is not scan:
            better = self._place(again, grid_at(again, again.points), labels, placed.view.pose, reference, predicted)
            placed = max(better, placed, key=lambda of: of.placement.share)
        seen = placed.view.scan
        velocity = self._take(placed, interval)
        moving = self._objects.update(placed.view, labels[seen.beam], votes.of(seen.beam), found, reference)
        reason = unobserved_in_words(placed.placement)
        return self._result(scan, stamp, moving.by_beam(seen), velocity, "degenerate" if reason else "ok", reason)

    # --- the steps ----------------------------------------------------------------------------------------------------------------

    @property
    def _now(self) -> float:
        """Seconds, the time that the poses are of."""
        return self._clock.now + self._late

    def _advance(self, scan: Scan, stamp: float) -> float:
        """Seconds since the time of the last pose. That of a swept scan is the middle of its sweep."""
        interval, before = self._clock.advance(stamp), self._late
        self._late = self._deskewing.middle(scan, self._clock.known)
        return max(interval + self._late - before, LEAST_OF_INTERVAL * interval)

    def _corrected(self, scan: Scan, pose: Floats, interval: float) -> Scan:
        """The scan corrected for the motion during its sweep, at the velocity that leads from the last pose to this one (3,)."""
        return deskewed(scan, self._velocity(pose, interval), self._late) if self._late > 0 else scan

    def _predict(self, interval: float, odometry: Floats | None) -> Floats:
        """(3,) the pose `interval` seconds after the last one, by odometry or constant velocity; after a gap where it was."""
        before, self._odometry, self._is_led = self._odometry, None, False
        if odometry is not None and np.isfinite(odometry).all():
            self._odometry = odometry
            step = None if before is None else _step(before, odometry, interval)
            self._is_led = step is not None
            if step is not None:
                return se2.compose(self._pose, step)
        if interval > self.config.gap:
            return self._pose
        return se2.compose(self._pose, twist.exp(interval * self._twist))

    def _velocity(self, pose: Floats, interval: float) -> Floats:
        """(3,) the velocity that leads from the last pose to this one."""
        return twist.log(se2.compose(se2.inverse(self._pose), pose)) / interval

    def _match(self, scan: Scan, grid: ScanGrid, reference: View, predicted: Floats) -> tuple[PairPrediction, Votes]:
        """The scan matched to an earlier one, and the votes of others; both by beam.

        A pair's answer labels its source, so that is the new scan.
        """
        assert self._keyframe is not None
        near = place(grid, self._keyframe.background, se2.compose(se2.inverse(self._keyframe.pose), predicted))
        pose = se2.compose(self._keyframe.pose, near.motion)
        if near.share < DOUBTED or np.abs(se2.compose(se2.inverse(predicted), pose)).max() > ASTRAY:
            pose = predicted
        votes = self._objects.memory.look(grid, pose)
        expected = self._objects.expect(grid, votes, pose, reference, self._now)
        guess = se2.compose(se2.inverse(reference.pose), pose).tolist()
        found = self.model.match(scan, reference.scan, self._now - reference.time, initial_motion=guess, expected=expected)
        return found, votes.by_beam(scan)

    def _place(self, scan: Scan, grid: ScanGrid, labels: Ints, guess: Floats, reference: View, predicted: Floats) -> _Placed:
        """The scan's background on the keyframe, or on the scan before if that explains it much better.

        grid: of the scan. labels: (n_beams,). guess: (3,) a good one of the pose.
        """
        assert self._keyframe is not None
        background = grid_at(scan, scan.points[labels[scan.beam] == BACKGROUND])
        frame, on_keyframe = self._keyframe, True
        placement = place(background, frame.background, se2.compose(se2.inverse(frame.pose), guess), self._factor)
        apart = se2.compose(se2.inverse(se2.compose(frame.pose, placement.motion)), guess)
        is_astray = bool(np.abs(apart).max() > ASTRAY)
        if is_astray or placement.share < self.config.keyframe_share:
            near = place(background, reference.background, se2.compose(se2.inverse(reference.pose), guess), self._factor)
            if is_astray or placement.share < DOUBTED * near.share:
                placement, frame, on_keyframe = near, reference, False
        pose, covariance = se2.compose(frame.pose, placement.motion), world_covariance(placement.covariance, frame.pose)
        if self._has_velocity or self._is_led:
            pose = fused(predicted, pose, covariance, self._now - self._history.last.time)
        is_less = explains_less(pose, guess, grid, reference)  # what is not observed was predicted wrongly
        pose, on_keyframe = (guess, False) if is_less else (pose, on_keyframe)
        settled = self._standing.settled(pose, covariance, self._now)
        view = View(scan, grid, background, settled, self._now)
        return _Placed(view, pose, covariance, placement, on_keyframe, is_less or is_astray)

    def _take(self, placed: _Placed, interval: float) -> Floats:
        """Remembers a placed scan; returns (3, 3) covariance of the velocity."""
        pose = placed.view.pose
        spread = velocity_covariance(placed.covariance, self._covariance, pose, interval)
        self._pose, self._twist, self._covariance = pose, self._velocity(pose, interval), placed.covariance
        self._has_velocity = True
        if placed.is_torn:  # scans that disagree about where the sensor was would be believed in turn
            self._history.clear()
            self._objects.begin(placed.view)
            self._standing.clear()
        self._standing.add(placed.measured, self._now)
        self._history.add(placed.view, self.config.lag)
        if not (placed.on_keyframe and self._keeps_keyframe(placed.placement)):
            self._keyframe = placed.view
        return spread

    def _keeps_keyframe(self, placement: Placement) -> bool:
        theta, x, y = placement.motion
        config = self.config
        is_near = np.hypot(x, y) < config.keyframe_distance and abs(theta) < config.keyframe_turn
        is_there = (np.abs(placement.motion) < MOST).all()  # a newer keyframe would see the same, and be less certain
        return bool(is_near and placement.share >= config.keyframe_share * (SHARE_THERE if is_there else 1.0))

    # --- the answers --------------------------------------------------------------------------------------------------------------

    def _begin(self, view: View, stamp: float) -> ScanResult:
        """The first scan, and that after a gap: all background."""
        self._history.clear()
        self._objects.begin(view)
        self._standing.clear()
        self._history.add(view, self.config.lag)
        self._keyframe, self._pose, self._covariance = view, view.pose, LEAST
        self._has_velocity, self._twist = False, np.zeros(3)
        return self._result(view.scan, stamp, nothing_moves(view.scan, BACKGROUND), unknown(), "ok", "")

    def _not_placed(self, scan: Scan, stamp: float, predicted: Floats, backed: Backed) -> ScanResult:
        """A scan that no motion explains: predicted; after a gap the stream starts anew from there."""
        share, least = 100 * backed.share, 100 * self.config.least_share
        reason = f"{share:.0f} % of the returns are explained; at least {least:.0f} % are needed"
        since = self._now - self._history.last.time
        if since > self.config.gap:
            self._begin(View.of(scan, predicted, self._now), stamp)
            reason += f"; started anew after {since:.2g} s without a placed scan"
        return self._lost(scan, stamp, predicted, reason)

    def _lost(self, scan: Scan, stamp: float, predicted: Floats, reason: str) -> ScanResult:
        self._pose, self._covariance = predicted, unknown()
        return self._result(scan, stamp, nothing_moves(scan, OUTLIER), unknown(), "lost", reason)

    def _result(self, scan: Scan, stamp: float, moving: Moving, spread: Floats, status: Status, reason: str) -> ScanResult:
        """The answer, at the time of the scan's first beam."""
        return ScanResult(
            scan=deskewed(scan, self._twist) if self._late > 0 else scan,
            stamp=stamp,
            pose=se2.compose(self._pose, twist.exp(-self._late * self._twist)),
            covariance=self._covariance.copy(),
            twist=self._twist.copy(),
            twist_covariance=spread,
            moving=moving.is_moving,
            track=moving.track,
            objects=moving.objects,
            status=status,
            reason=reason,
        )


def explains_less(pose: Floats, guess: Floats, grid: ScanGrid, reference: View) -> bool:
    """Whether a pose (3,) explains far less of a scan, on an earlier one, than a guess (3,) that is not near it."""
    if np.abs(se2.compose(se2.inverse(pose), guess)).max() < ALIKE:
        return False
    shares = [explained_by(se2.compose(se2.inverse(reference.pose), at), grid, reference.grid).mean() for at in (pose, guess)]
    return bool(shares[0] < LEAST_OF_BEST * shares[1])


def _step(before: Floats, after: Floats, interval: float) -> Floats | None:
    """(3,) the motion between two poses by the wheels; None if nothing goes so far in `interval` seconds."""
    with np.errstate(over="ignore", invalid="ignore"):
        step = se2.compose(se2.inverse(before), after)
        is_possible = float(np.hypot(step[1], step[2])) <= min(FASTEST * max(interval, 1.0), FARTHEST_GUESS)
    return step if is_possible else None


def labels_of(found: PairPrediction, backed: Backed, scan: Scan) -> Ints:
    """(n_beams,) labels of the match; without it, or without background, what the motion explains is background."""
    if backed.is_found and np.count_nonzero(found.cluster == BACKGROUND) >= FEWEST_POINTS:
        return found.cluster
    return scan.to_beams(np.where(backed.explained, BACKGROUND, OUTLIER), OUTLIER)


def unobserved_in_words(placement: Placement) -> str:
    """Which part of a motion is not observed; empty: none."""
    if not placement.is_degenerate:
        return ""
    turn, x, y = np.diag(placement.unobserved)
    parts = (["the turn"] if turn > 0.5 else []) + (["the shift along a direction"] if x + y > 0.5 else [])
    return f"{' and '.join(parts) or 'a combination of turn and shift'} is not observed, and predicted"
