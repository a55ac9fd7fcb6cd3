"""Scans, annotated pairs and predictions of one pair.

Frame: x ahead, y left, bearings counter-clockwise, metres, radians, seconds. The first scan of a pair is the `source`, the
second the `target`; a motion `T_target_source` = (theta, tx, ty) maps source points into the target frame.

There are two numberings. A *beam* is an entry of the input arrays, valid or not; a *point* is a valid return.
Annotations and `PairPrediction` count beams (as files do), tensors count points; `Scan.beam` maps points to beams.
Beams come in any order and direction, points are kept counter-clockwise.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from torchcrf_scan.beams import (
    FARTHEST,
    MOST_BEAMS,
    NEAREST,
    Bools,
    Floats,
    Ints,
    bearings_of,
    check_sensor,
    number,
    times_of,
    vector,
)
from torchcrf_scan.errors import TorchCRFScanError

BACKGROUND = 0
OUTLIER = -1
MAX_RANGE_MARGIN = 0.05  # spec 0.2: a range this close to range_max is a beam without return
SHORTEST, LONGEST = 1e-6, 1e9  # seconds between two scans; what is beyond would not survive single precision as a speed
CLOSED_SPAN = float(np.radians(315.0))  # a scan that spans at least this much has neighbours across +-180 deg


@dataclass(frozen=True, slots=True)
class Scan:
    """The valid returns of one planar laser scan, counter-clockwise; made by `from_ranges`.

    Attributes:
        ranges: (N,) metres.
        bearings: (N,) radians, counter-clockwise, non-decreasing.
        beam: (N,) index of every return in the input arrays, which may have any order.
        n_beams: length of those arrays.
        range_min, range_max, range_noise: metres, None when unknown.
        times: (N,) seconds of every return after the first beam of the input; None: unknown.

    Raises:
        TorchCRFScanError: fields that do not fit each other, or the description above.
    """

    ranges: Floats
    bearings: Floats
    beam: Ints
    n_beams: int
    range_min: float | None = None
    range_max: float | None = None
    range_noise: float | None = None
    times: Floats | None = None

    def __post_init__(self) -> None:
        check_sensor(self.range_min, self.range_max, self.range_noise)
        if not (isinstance(self.n_beams, int | np.integer) and 0 <= self.n_beams <= MOST_BEAMS):
            raise TorchCRFScanError(f"n_beams: expected a number from 0 to {MOST_BEAMS}, got {self.n_beams!r:.80}")
        ranges = vector("ranges", self.ranges)
        for name in ("ranges", "bearings", "beam") if self.times is None else ("ranges", "bearings", "beam", "times"):
            values = vector(name, getattr(self, name), len(ranges))
            if not np.isfinite(values).all():
                raise TorchCRFScanError(f"{name}: expected finite numbers, got {values[~np.isfinite(values)][0]}")
            object.__setattr__(self, name, values if name != "beam" else values.astype(np.int64))
        if (self.bearings[1:] < self.bearings[:-1]).any():
            raise TorchCRFScanError("bearings: expected radians in rising order, got others")
        is_beam = self.beam.min(initial=0) >= 0 and self.beam.max(initial=-1) < self.n_beams
        if not is_beam or np.bincount(self.beam).max(initial=0) > 1:
            raise TorchCRFScanError(f"beam: expected distinct indices below n_beams = {self.n_beams}, got others")

    @classmethod
    def from_ranges(
        cls,
        ranges: ArrayLike,
        bearings: ArrayLike | None = None,
        *,
        angle_min: float | None = None,
        angle_increment: float | None = None,
        range_min: float | None = None,
        range_max: float | None = None,
        range_noise: float | None = None,
        time_increment: float | None = None,
        times: ArrayLike | None = None,
    ) -> Scan:
        """A scan from ranges and bearings, or from ranges, `angle_min` and `angle_increment` (negative: clockwise).

        Beams may be in any order. Invalid returns (not finite, masked, not above range_min or `NEAREST`, not below `FARTHEST` or
        range_max - 0.05 m) are dropped: REP 117, and what sensor_msgs/LaserScan says of its limits. An infinite range_max is no
        limit.

        Args:
            ranges: (N,) metres. bearings: (N,) radians, counter-clockwise positive.
            angle_min, angle_increment: radians, of the first beam and from each to the next.
            range_min, range_max, range_noise: metres, of the sensor.
            time_increment: seconds from each beam of the input to the next; 0: unknown, as drivers leave it.
            times: (N,) seconds of every beam, instead; those after the first beam are kept.

        Raises:
            TorchCRFScanError: wrong shapes, neither or both forms of bearings or of times, bearings that are not finite or span
                more than a turn, impossible limits.
        """
        ranges = vector("ranges", ranges)
        range_min, range_max, range_noise = check_sensor(range_min, range_max, range_noise)
        bearings = bearings_of(len(ranges), bearings, angle_min, angle_increment)
        after = times_of(len(ranges), time_increment, times)
        with np.errstate(invalid="ignore"):
            valid = (ranges < FARTHEST) & (ranges > max(range_min or 0.0, NEAREST))
            if range_max is not None:
                valid &= ranges < range_max - MAX_RANGE_MARGIN
        beam = np.flatnonzero(valid)
        beam = beam[np.argsort(bearings[beam], kind="stable")]
        after = after if after is None else after[beam]
        return cls(ranges[beam], bearings[beam], beam, len(ranges), range_min, range_max, range_noise, after)

    def __len__(self) -> int:
        return len(self.ranges)

    @property
    def points(self) -> Floats:
        """(N, 2) Cartesian points in the sensor's frame, metres."""
        return self.ranges[:, None] * np.stack([np.cos(self.bearings), np.sin(self.bearings)], axis=1)

    @property
    def is_closed(self) -> bool:
        """Whether the first and the last return are neighbours: the returns span (nearly) the whole circle."""
        return len(self) > 2 and float(self.bearings[-1] - self.bearings[0]) > CLOSED_SPAN

    def to_beams(self, values: NDArray[Any], fill: Any) -> NDArray[Any]:
        """Scatters (N, ...) values of the points to (n_beams, ...), `fill` where the beam returned nothing."""
        assert len(values) == len(self)
        out = np.full((self.n_beams, *values.shape[1:]), fill, dtype=values.dtype)
        out[self.beam] = values
        return out

    def only(self, keep: Bools) -> Scan:
        """The scan of some of its returns, the same beams. keep: (N,)."""
        times = None if self.times is None else self.times[keep]
        return replace(self, ranges=self.ranges[keep], bearings=self.bearings[keep], beam=self.beam[keep], times=times)

    @property
    def beam_bearings(self) -> Floats:
        """(n_beams,) bearings of all beams, those without return interpolated between their neighbours (held at the ends)."""
        if len(self) == 0:
            return np.zeros(self.n_beams)
        order = np.argsort(self.beam)
        return np.interp(np.arange(self.n_beams), self.beam[order], self.bearings[order])

    @property
    def rank(self) -> Ints:
        """(n_beams,) place of every beam among all of them, counter-clockwise: neighbours differ by 1."""
        steps, number = np.diff(self.beam), np.arange(self.n_beams)
        if (steps >= 0).all():
            return number
        if (steps <= 0).all():
            return number[::-1]
        return np.argsort(np.argsort(self.beam_bearings, kind="stable"))


@dataclass(frozen=True, slots=True)
class Annotation:
    """Ground truth of every source beam (`n` = source.n_beams); the optional keys of a pair file.

    Attributes:
        association: (n,) target beam, -1 outlier (no counterpart).
        cluster: (n,) 0 background, k >= 1 moving object k, -1 exactly where association is -1.
        motions: (K+1, 3) `T_target_source` of every cluster; a NaN row where the object is not in this pair.
        body: (n,) cluster of the object hit by the beam, also without a counterpart; -1 unknown.
        ignore: (n,) bool, unannotated beams.
        weight: of the pair in learning, below 1 for labels that are not certain.
    """

    association: Ints
    cluster: Ints
    motions: Floats
    body: Ints
    ignore: Bools
    weight: float = 1.0


@dataclass(frozen=True, slots=True)
class ScanPair:
    """Two consecutive scans `dt` seconds apart, `SHORTEST` to `LONGEST`, with or without annotation.

    `sequence` names the recording (pairs of one sequence overlap in time: never split one between training and test), `name`
    the pair, `origin` where the data comes from. `initial_motion` (3,) is a guess of the background's `T_target_source`, from
    odometry or the motion before; None: there is none.

    Raises:
        TorchCRFScanError: a field of another type, or beyond these bounds.
    """

    source: Scan
    target: Scan
    dt: float = 0.1
    annotation: Annotation | None = None
    sequence: str = ""
    name: str = ""
    origin: str = ""
    initial_motion: Floats | None = None

    def __post_init__(self) -> None:
        kinds = {"source": Scan, "target": Scan, "annotation": Annotation | None, "sequence": str, "name": str, "origin": str}
        for name, kind in kinds.items():
            if not isinstance(getattr(self, name), kind):
                told = getattr(kind, "__name__", "Annotation or None")
                raise TorchCRFScanError(f"{name}: expected {told}, got {type(getattr(self, name)).__name__}")
        dt = number("dt", self.dt, "seconds")
        if not SHORTEST <= dt <= LONGEST:
            raise TorchCRFScanError(f"dt: expected seconds between {SHORTEST:g} and {LONGEST:g}, got {self.dt}")
        object.__setattr__(self, "dt", dt)
        if self.initial_motion is not None:
            guess = vector("initial_motion", self.initial_motion, 3)
            if not (np.abs(guess) <= FARTHEST).all():
                raise TorchCRFScanError(
                    f"initial_motion: expected finite numbers (theta, tx, ty) within {FARTHEST:g}, got {guess.tolist()}"
                )
            object.__setattr__(self, "initial_motion", guess)

    def target_points(self, association: Ints) -> Ints:
        """(N,) target point of every source point, -1 none. association: (n_beams,) target beam of every source beam."""
        point_of_beam = np.full(self.target.n_beams + 1, OUTLIER)  # the last entry maps -1 to -1
        point_of_beam[self.target.beam] = np.arange(len(self.target))
        return point_of_beam[association[self.source.beam]]


@dataclass(frozen=True, slots=True)
class PairPrediction:
    """Prediction of one pair, by source beam: exactly the contents of a prediction file. Arrays, without gradient.

    Attributes:
        association: (n,) int64 target beam, -1 outlier.
        cluster: (n,) int64 0 background, k >= 1 mover k, -1 outlier.
        motions: (K+1, 3) `T_target_source` of background and movers; the sensor moved by the inverse of row 0.
        association_confidence, cluster_confidence: (n,) in [0, 1].
        converged: whether the labels had converged when the iterations ended.
        covariances: (K+1, 3, 3) of the motions' (theta, tx, ty), radians and metres; large where nothing was observed.
        unobserved_turn: (K+1,) bool, the rotation is unobserved.
        unobserved_shift: (K+1, 2) unit direction, in the target frame, of the cluster's unobserved translation; 0: none.
            These three are None for methods that do not provide them.
    """

    association: Ints
    cluster: Ints
    motions: Floats
    association_confidence: Floats
    cluster_confidence: Floats
    converged: bool
    covariances: Floats | None = None
    unobserved_turn: Bools | None = None
    unobserved_shift: Floats | None = None
