"""One object over time: birth, prediction, what a sighting changes."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np

from torchcrf_scan.checks import Amount, Positive, Within, check_fields
from torchcrf_scan.errors import TorchCRFScanError
from torchcrf_scan.geometry import se2
from torchcrf_scan.result import MovingObject
from torchcrf_scan.scan import Floats
from torchcrf_scan.stream import extent as box
from torchcrf_scan.stream import filter as kalman

UNKNOWN_SPEED = 8.0  # m/s, standard deviation of a velocity that was not observed
SLIDE = 1.0  # spacings, standard deviation of how far a shape may have slid along itself
LONE_SPACING = 0.1  # metres, of an object of one point
PARTIAL = 0.1  # share of an object's size by which the end of its visible part is uncertain
APART = 0.7, 4.0  # metres, and times the spacing of its points, between neighbours that are not of the same piece
PERSISTENT = 3  # sightings in a row that must be larger than a box before it grows
STEERED = 2.0  # standard deviations of the speed above which a heading is that of the velocity,
ASTRAY = 0.5  # if that is known to so many radians
DOUBT = 9.0  # squared standard deviations; a measurement farther off counts the less, the farther


@dataclass(frozen=True)
class TrackerConfig:
    """How objects are followed.

    Attributes:
        acceleration: change of velocity within one second, standard deviation, m/s.
        range_noise: standard deviation of where an object's points end, metres.
        velocity_noise: least standard deviation of a measured velocity, m/s.
        gate: largest squared Mahalanobis distance of a cluster from a track that it continues.
        sightings, among: an object is confirmed when seen in `sightings` of its last `among` scans,
        strong_points, strong_speed: or at once, with that many points and a speed of that many standard deviations.
        lifetime: seconds after which an unseen object is given up.
        loss: standard deviation of the position, metres, at which an unseen object is given up.
        least_speed: m/s, below which a heading is kept.
    """

    acceleration: Positive = 1.5
    range_noise: Positive = 0.02
    velocity_noise: Positive = 0.05
    gate: Positive = 20.0
    sightings: Annotated[int, Within(1, 100)] = 2
    among: Annotated[int, Within(1, 100)] = 4
    strong_points: Annotated[int, Within(1)] = 12
    strong_speed: Positive = 6.0
    lifetime: Amount = 1.5
    loss: Positive = 2.0
    least_speed: Amount = 0.1

    def __post_init__(self) -> None:
        check_fields(self)
        if self.among < self.sightings:
            raise TorchCRFScanError(f"among: expected at least sightings = {self.sightings}, got {self.among}")


@dataclass(frozen=True, slots=True)
class Sighting:
    """A moving cluster of one scan, in the world.

    Attributes:
        points: (n, 2), n > 0, in the order of beams. velocity: (2,) over ground. covariance: (2, 2) of it; large where it was
            not observed.
        turn: rad/s, of its rotation. noise: standard deviation of where its points end, metres.
    """

    points: Floats
    velocity: Floats
    covariance: Floats
    turn: float
    noise: float

    @classmethod
    def of(cls, points: Floats, velocity: Floats, covariance: Floats, since: float, turn: float, config: TrackerConfig) -> Sighting:
        """A velocity or covariance that is not finite or not positive counts as not observed, a turn that is not finite as none.

        since: seconds over which the velocity was measured. A shape that slid by more than the spacing of its points in that time
        would show other ends; this bounds the velocity's uncertainty where the shape itself tells nothing.
        """
        spacing = float(np.median(np.hypot(*np.diff(points, axis=0).T))) if len(points) > 1 else LONE_SPACING
        noise = float(np.hypot(config.range_noise, min(spacing, 1.0) / 2))
        turn = turn if np.isfinite(turn) else 0.0
        is_right = np.isfinite(velocity).all() and np.isfinite(covariance).all() and np.linalg.eigvalsh(covariance)[0] >= 0
        if not is_right:
            return cls(points, np.zeros(2), UNKNOWN_SPEED**2 * np.eye(2), turn, noise)
        most = SLIDE * np.hypot(spacing, config.range_noise) / since if since > 0 else np.inf
        values, axes = np.linalg.eigh(covariance + config.velocity_noise**2 * np.eye(2))
        bounded = axes @ np.diag(1 / (1 / values + 1 / most**2)) @ axes.T
        return cls(points, velocity, bounded, turn, noise)

    def velocity_at(self, place: Floats) -> Floats:
        """(2,) the velocity of the object where its centre is, which differs from that of its visible points as it turns."""
        x, y = place - self.points.mean(0)
        return self.velocity + self.turn * np.array([-y, x])

    def pieces(self) -> list[Sighting]:
        """Its pieces that lie apart, the one of most points first: what was not one thing, or what hides in part."""
        gaps = np.hypot(*np.diff(self.points, axis=0).T)
        apart = max(APART[0], APART[1] * float(np.median(gaps))) if len(gaps) else 0.0
        parts = np.split(self.points, np.flatnonzero(gaps > apart) + 1)
        return [replace(self, points=part) for part in sorted(parts, key=len, reverse=True)]

    def joined(self, other: Sighting) -> Sighting:
        """Both as one object; the velocity is that of the one with more points."""
        most = max(self, other, key=lambda of: len(of.points))
        return replace(most, points=np.concatenate([self.points, other.points]))


@dataclass(frozen=True, slots=True)
class Track:
    """The state of an object.

    Attributes:
        number: never given twice. born, stamp, seen_at: seconds of its first sighting, of this state, of its last sighting.
        state: (4,) position of the box's centre and velocity. covariance: (4, 4).
        heading: radians. extent: (2,) length and width of the box, metres. excess: (2,) of its last sightings beyond it.
        is_steered: the heading is that of a velocity.
        points: (n, 2) as last seen, in the world. seen_from: (2,) the centre then.
        history: whether it was seen, in its last scans.
        is_confirmed: whether it is more than a guess.
    """

    number: int
    born: float
    stamp: float
    seen_at: float
    state: Floats
    covariance: Floats
    heading: float
    extent: Floats
    excess: tuple[Floats, ...]
    is_steered: bool
    points: Floats
    seen_from: Floats
    history: tuple[bool, ...]
    is_confirmed: bool

    @classmethod
    def born_of(cls, number: int, stamp: float, sighting: Sighting, config: TrackerConfig) -> Track:
        """A new track of a sighting, confirmed at once if the evidence is strong."""
        strength = kalman.chi_square(sighting.velocity, sighting.covariance)
        is_strong = len(sighting.points) >= config.strong_points and strength > config.strong_speed**2
        centre = sighting.points.mean(0)
        unmoved = np.concatenate([centre, np.zeros(2)]), np.diag([sighting.noise**2] * 2 + [UNKNOWN_SPEED**2] * 2)
        state, covariance = kalman.update(*unmoved, sighting.velocity, np.eye(4)[2:], sighting.covariance)
        heading = _main_axis(sighting.points)
        is_confirmed = bool(is_strong) or config.sightings == 1
        unboxed = np.zeros(2), (), False, sighting.points, centre, (True,), is_confirmed
        return cls(number, stamp, stamp, stamp, state, covariance, heading, *unboxed)._boxed(config)

    @property
    def centre(self) -> Floats:
        """(2,) position of the box."""
        return self.state[:2]

    @property
    def velocity(self) -> Floats:
        """(2,) over ground, m/s."""
        return self.state[2:]

    def at(self, stamp: float, config: TrackerConfig) -> Track:
        """The track at another time, as predicted; a time before its state is answered by the state as it is."""
        state, covariance = kalman.predict(self.state, self.covariance, stamp - self.stamp, config.acceleration)
        return replace(self, stamp=stamp, state=state, covariance=covariance)

    def seen(self, sighting: Sighting, sensor: Floats | None, config: TrackerConfig) -> Track:
        """The track, predicted to the time of a sighting, after it. sensor: (2,) position in the world."""
        axes = se2.rotate(np.full(2, self.heading), np.eye(2))  # (2, 2) rows: along and across
        eye = None if sensor is None else axes @ (sensor - self.centre)
        covered = box.cover(sighting.points, self.centre, self.heading)
        noise = np.hypot(sighting.noise, PARTIAL * np.maximum(self.extent, covered.size))
        view = box.look(covered, self.extent, eye, noise)
        state, covariance = self._corrected(view, axes, sighting, noise)
        excess = (*self.excess, view.excess)[-PERSISTENT:]
        growth = box.GROWTH * np.min(excess, axis=0) if len(excess) == PERSISTENT else np.zeros(2)
        state[:2] += view.side * growth / 2 @ axes
        extent = self.extent + growth
        moved = replace(self, state=state, covariance=covariance, extent=extent, excess=excess, points=sighting.points)
        history = (*self.history, True)[-config.among :]
        is_confirmed = self.is_confirmed or sum(history) >= config.sightings
        turned = moved._turned(config)
        return replace(turned, seen_at=self.stamp, seen_from=turned.centre, history=history, is_confirmed=is_confirmed)

    def _corrected(self, view: box.View, axes: Floats, sighting: Sighting, noise: Floats) -> tuple[Floats, Floats]:
        """State and covariance after what was observed of the position, with `noise` (2,) along and across, and the velocity."""
        ahead = np.zeros((2, 4))
        ahead[:, :2] = axes
        still = np.eye(4)[2:]
        expected = axes @ self.covariance[:2, :2] @ axes.T
        strayed = doubt(view.shift[:, None], (np.diag(expected) + noise**2)[:, None, None])
        change = sighting.velocity_at(self.centre) - self.velocity
        turned = doubt(change, self.covariance[2:, 2:] + sighting.covariance)
        rows = [*np.flatnonzero(view.is_seen), 2, 3]
        innovation = np.concatenate([view.shift, change])
        R = np.zeros((4, 4))
        R[:2, :2], R[2:, 2:] = np.diag(noise**2 * strayed), sighting.covariance * turned
        H = np.concatenate([ahead, still])
        return kalman.update(self.state, self.covariance, innovation[rows], H[rows], R[np.ix_(rows, rows)])

    def missed(self, config: TrackerConfig) -> Track:
        """The track after a scan in which it was not seen."""
        return replace(self, history=(*self.history, False)[-config.among :])

    def is_over(self, config: TrackerConfig) -> bool:
        """Whether an object that was not seen is given up."""
        if not self.is_confirmed and self.history.count(False) > config.among - config.sightings:
            return True
        return self.is_lost(config) or self.stamp - self.seen_at > config.lifetime

    def is_lost(self, config: TrackerConfig) -> bool:
        """Whether its position is too uncertain to find it again; after a single sighting it always is uncertain."""
        return len(self.history) > 1 and _deviation(self.covariance[:2, :2]) > config.loss

    def _turned(self, config: TrackerConfig) -> Track:
        """With the heading of the velocity, if it is certain; the first time, the box is fitted anew."""
        if not self._has_course(config):
            return self
        turned = replace(self, heading=float(np.arctan2(self.velocity[1], self.velocity[0])))
        return turned if self.is_steered else turned._boxed(config)

    def _boxed(self, config: TrackerConfig) -> Track:
        """With the box of its points alone, along the velocity if that is certain."""
        is_steered = self._has_course(config)
        heading = float(np.arctan2(self.velocity[1], self.velocity[0])) if is_steered else self.heading
        seen = box.cover(self.points, self.centre, heading)
        centre = self.centre + se2.rotate(np.asarray(heading), seen.middle)
        state = np.concatenate([centre, self.velocity])
        return replace(self, state=state, heading=heading, extent=seen.size, is_steered=is_steered, seen_from=centre)

    def _has_course(self, config: TrackerConfig) -> bool:
        """Whether the direction of the velocity is certain."""
        speed = float(np.hypot(*self.velocity))
        if speed <= config.least_speed:
            return False
        ahead = self.velocity / speed
        aside = np.array([-ahead[1], ahead[0]])
        along, across = (float(np.sqrt(of @ self.covariance[2:, 2:] @ of)) for of in (ahead, aside))
        return speed > STEERED * along and across < ASTRAY * speed

    def to_object(self, points: int) -> MovingObject:
        """As the result of a scan in which it has that many points."""
        extent = float(self.extent[0]), float(self.extent[1])
        age = max(self.stamp - self.born, 0.0)
        return MovingObject(self.number, self.centre, self.velocity, self.covariance, self.heading, extent, points, age)


def doubt(innovation: Floats, S: Floats) -> Floats:
    """(...,) factor, at least 1, on the covariance of a measurement that is implausibly far off. innovation: (..., M)."""
    return np.maximum(kalman.chi_square(innovation, S) / DOUBT, 1.0) ** 2


def _deviation(covariance: Floats) -> float:
    """Largest standard deviation of a covariance (2, 2)."""
    return float(np.sqrt(max(np.linalg.eigvalsh(covariance)[1], 0.0)))


def _main_axis(points: Floats) -> float:
    """Direction in which the points (n, 2) spread most, radians; 0 for a single one."""
    spread = points - points.mean(0)
    x, y = np.linalg.eigh(spread.T @ spread)[1][:, 1] if len(points) > 1 else (1.0, 0.0)
    return float(np.arctan2(y, x))
