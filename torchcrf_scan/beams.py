"""The arrays that a scan is made from: types, and checks of what drivers, files and users put into them."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Bools = NDArray[np.bool_]

FARTHEST = 1e6  # metres; larger ranges are treated as invalid, as their squares would lose single precision
WIDEST_SPAN = 1.05 * 2 * np.pi  # radians; a turn and a step of a coarse scan. What spans more is in degrees


def vector(name: str, values: ArrayLike, length: int | None = None) -> Floats:
    """(length,) numbers, NaN where the array is masked."""
    if isinstance(values, np.ma.MaskedArray):
        values = np.ma.filled(values.astype(np.float64), np.nan)
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


def bearings_of(count: int, bearings: ArrayLike | None, angle_min: float | None, angle_increment: float | None) -> Floats:
    """(count,) bearings from either form, checked."""
    steps = [value for value in (angle_min, angle_increment) if value is not None]
    if len(steps) != (2 if bearings is None else 0):
        raise ValueError("bearings: expected either bearings or both angle_min and angle_increment, got neither, half or both")
    if bearings is None:
        first, increment = steps
        if increment == 0 and count > 1:
            raise ValueError("angle_increment: expected radians from beam to beam, got 0")
        bearings = first + increment * np.arange(count)
    bearings = vector("bearings", bearings, count)
    if not np.isfinite(bearings).all():
        raise ValueError(f"bearings: expected finite numbers, got {np.count_nonzero(~np.isfinite(bearings))} that are not")
    if count > 0 and np.ptp(bearings) > WIDEST_SPAN:
        raise ValueError(f"bearings: expected radians of one turn, got a span of {np.ptp(bearings):.1f}; are these degrees?")
    return bearings


def times_of(count: int, time_increment: float | None, times: ArrayLike | None) -> Floats | None:
    """(count,) seconds of the beams after the first one; None: unknown."""
    if time_increment is not None and times is not None:
        raise ValueError("times: expected either times or time_increment, got both")
    if times is not None:
        after = vector("times", times, count)
        if not np.isfinite(after).all():
            raise ValueError(f"times: expected finite numbers, got {np.count_nonzero(~np.isfinite(after))} that are not")
        return after - after[:1]
    if not time_increment:
        return None
    if not np.isfinite(time_increment):
        raise ValueError(f"time_increment: expected a finite number of seconds, got {time_increment}")
    return time_increment * np.arange(count, dtype=np.float64)
