"""Scans, annotated pairs and predictions of one pair.

Frame: x ahead, y left, bearings counter-clockwise, metres, radians, seconds. The first scan of a pair is the `source`, the
second the `target`; a motion `T_target_source` = (theta, tx, ty) maps source points into the target frame.

There are two numberings. A *beam* is an entry of the input arrays, valid or not; a *point* is a valid return.
Annotations and `PairPrediction` count beams (as files do), tensors count points; `Scan.beam` maps points to beams.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Bools = NDArray[np.bool_]

BACKGROUND = 0
OUTLIER = -1
MAX_RANGE_MARGIN = 0.05  # spec 0.2: a range this close to range_max is a beam without return
FARTHEST = 1e6  # metres; larger ranges are treated as invalid, as their squares would lose single precision
CLOSED_SPAN = float(np.radians(315.0))  # a scan that spans at least this much has neighbours across +-180 deg


def _vector(name: str, values: ArrayLike, length: int | None = None) -> Floats:
    array = np.asarray(values, dtype=np.float64)
    if array.ndim != 1 or (length is not None and len(array) != length):
        expected = "(N,)" if length is None else f"({length},)"
        raise ValueError(f"{name}: expected shape {expected}, got {array.shape}")
    return array


def check_sensor(range_min: float | None, range_max: float | None, range_noise: float | None) -> None:
    """Raises ValueError for impossible sensor limits: not a number, an empty interval, or noise out of bounds."""
    least = 0.0 if range_min is None else range_min
    if not np.isfinite(least):
        raise ValueError(f"range_min: expected a finite number of metres, got {range_min}")
    if range_max is not None and not range_max > max(least, 0.0):
        raise ValueError(f"range_max: expected more than range_min = {max(least, 0.0)}, got {range_max}")
    if range_noise is not None and not 0 <= range_noise <= FARTHEST:
        raise ValueError(f"range_noise: expected metres between 0 and {FARTHEST:g}, got {range_noise}")


@dataclass(frozen=True, slots=True)
class Scan:
    """The valid returns of one planar laser scan, in beam order.

    Attributes:
        ranges: (N,) metres.
        bearings: (N,) radians, counter-clockwise, non-decreasing.
        beam: (N,) index of every return in the input arrays.
        n_beams: length of those arrays.
        range_min, range_max, range_noise: metres, None when unknown.
    """

    ranges: Floats
    bearings: Floats
    beam: Ints
    n_beams: int
    range_min: float | None = None
    range_max: float | None = None
    range_noise: float | None = None

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
    ) -> Scan:
        """A scan from ranges and bearings, or from ranges, `angle_min` and `angle_increment`.

        Invalid returns (not finite, not above max(range_min, 0), not below range_max - 0.05 m or `FARTHEST`) are dropped. An
        infinite range_max is no limit.

        Raises:
            ValueError: wrong shapes, neither or both forms of bearings, bearings not finite or decreasing, impossible limits.
        """
        ranges = _vector("ranges", ranges)
        check_sensor(range_min, range_max, range_noise)
        steps = [value for value in (angle_min, angle_increment) if value is not None]
        if len(steps) != (2 if bearings is None else 0):
            raise ValueError("bearings: expected either bearings or both angle_min and angle_increment, got neither, half or both")
        if bearings is None:
            first, increment = steps
            if increment == 0 and len(ranges) > 1:
                raise ValueError("angle_increment: expected more than 0, got 0")
            bearings = first + increment * np.arange(len(ranges))
        bearings = _vector("bearings", bearings, len(ranges))
        if not np.isfinite(bearings).all():
            raise ValueError(f"bearings: expected finite numbers, got {np.count_nonzero(~np.isfinite(bearings))} that are not")
        back = np.flatnonzero(np.diff(bearings) < 0)
        if len(back):
            raise ValueError(f"bearings: expected counter-clockwise (non-decreasing), got a step back after beam {back[0]}")
        with np.errstate(invalid="ignore"):
            valid = (ranges < FARTHEST) & (ranges > max(range_min or 0.0, 0.0))
            if range_max is not None:
                valid &= ranges < range_max - MAX_RANGE_MARGIN
        beam = np.flatnonzero(valid)
        return cls(ranges[beam], bearings[beam], beam, len(ranges), range_min, range_max, range_noise)

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


@dataclass(frozen=True, slots=True)
class Annotation:
    """Ground truth of every source beam (`n` = source.n_beams); the optional keys of a pair file.

    Attributes:
        association: (n,) target beam, -1 outlier (no counterpart).
        cluster: (n,) 0 background, k >= 1 moving object k, -1 exactly where association is -1.
        motions: (K+1, 3) `T_target_source` of every cluster; a NaN row where the object is not in this pair.
        body: (n,) cluster of the object hit by the beam, also without a counterpart; -1 unknown.
        ignore: (n,) bool, unannotated beams.
    """

    association: Ints
    cluster: Ints
    motions: Floats
    body: Ints
    ignore: Bools


@dataclass(frozen=True, slots=True)
class ScanPair:
    """Two consecutive scans `dt` seconds apart, with or without annotation.

    `sequence` names the recording (pairs of one sequence overlap in time: never split one between training and test), `name`
    the pair, `origin` where the data comes from. `initial_motion` (3,) is a guess of the background's `T_target_source`, from
    odometry or the motion before; None: there is none.
    """

    source: Scan
    target: Scan
    dt: float = 0.1
    annotation: Annotation | None = None
    sequence: str = ""
    name: str = ""
    origin: str = ""
    initial_motion: Floats | None = None


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
