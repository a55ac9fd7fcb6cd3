"""The arrays that a scan is made from: types, and checks of what drivers, files and users put into them."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from torchcrf_scan.errors import TorchCRFScanError

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Bools = NDArray[np.bool_]

REAL = "biuf"  # kinds of arrays of real numbers
NUMBERS = f"{REAL}O"  # that are converted; objects one by one

NEAREST, FARTHEST = 1e-9, 1e6  # metres; other ranges are treated as invalid, as their squares would leave single precision
FARTHEST_BEARING = 4 * np.pi  # radians; a sensor's own numbers stay within two turns
LONGEST_SWEEP = 1e6  # seconds between the first beam and any other
MOST_BEAMS = 20_000  # of a scan, above what sensors give; a pair of so many takes minutes
WIDEST_SPAN = 1.05 * 2 * np.pi  # radians; a turn and a step of a coarse scan. What spans more is in degrees


def vector(name: str, values: ArrayLike, length: int | None = None) -> Floats:
    """(length,) numbers, NaN where the array is masked."""
    try:
        if isinstance(values, np.ma.MaskedArray):
            values = np.ma.filled(values.astype(np.float64), np.nan)
        array = np.asarray(values)
        if array.dtype.kind not in NUMBERS:
            raise TypeError(array.dtype)
        array = array.astype(np.float64, copy=False)
    except (ValueError, TypeError, OverflowError) as error:
        raise TorchCRFScanError(f"{name}: expected numbers, got {error}") from error
    if array.ndim != 1 or (length is not None and len(array) != length):
        expected = "(N,)" if length is None else f"({length},)"
        raise TorchCRFScanError(f"{name}: expected shape {expected}, got {array.shape}")
    if len(array) > MOST_BEAMS:
        raise TorchCRFScanError(f"{name}: expected at most {MOST_BEAMS} beams, got {len(array)}")
    return array


def number(name: str, value: Any, unit: str) -> float:
    """The value as a float, also if it is not finite; `unit` is for the message."""
    array = np.asarray(value)
    if array.ndim > 0 or array.dtype.kind not in REAL:
        raise TorchCRFScanError(f"{name}: expected a number of {unit}, got {value!r:.80}")
    return float(array)


def check_sensor(
    range_min: float | None, range_max: float | None, range_noise: float | None
) -> tuple[float | None, float | None, float | None]:
    """The sensor's limits as floats; raises TorchCRFScanError for no number, an empty interval, or noise out of bounds."""
    range_min, range_max, range_noise = (
        None if value is None else number(name, value, "metres")
        for name, value in (("range_min", range_min), ("range_max", range_max), ("range_noise", range_noise))
    )
    least = range_min or 0.0
    if not np.isfinite(least):
        raise TorchCRFScanError(f"range_min: expected a finite number of metres, got {range_min}")
    if range_max is not None and not range_max > max(least, 0.0):
        raise TorchCRFScanError(f"range_max: expected more than range_min = {max(least, 0.0)}, got {range_max}")
    if range_noise is not None and not 0 <= range_noise <= FARTHEST:
        raise TorchCRFScanError(f"range_noise: expected metres between 0 and {FARTHEST:g}, got {range_noise}")
    return range_min, range_max, range_noise


def bearings_of(count: int, bearings: ArrayLike | None, angle_min: float | None, angle_increment: float | None) -> Floats:
    """(count,) bearings from either form, checked."""
    steps = [value for value in (angle_min, angle_increment) if value is not None]
    if len(steps) != (2 if bearings is None else 0):
        raise TorchCRFScanError(
            "bearings: expected either bearings or both angle_min and angle_increment, got neither, half or both"
        )
    if bearings is None:
        first, increment = (number(name, of, "radians") for name, of in zip(("angle_min", "angle_increment"), steps, strict=True))
        if increment == 0 and count > 1:
            raise TorchCRFScanError("angle_increment: expected radians from beam to beam, got 0")
        with np.errstate(over="ignore", invalid="ignore"):
            bearings = first + increment * np.arange(count)
    bearings = vector("bearings", bearings, count)
    if not np.isfinite(bearings).all():
        raise TorchCRFScanError(f"bearings: expected finite numbers, got {np.count_nonzero(~np.isfinite(bearings))} that are not")
    span = np.max(bearings, initial=-np.inf) - np.min(bearings, initial=np.inf)
    if span > WIDEST_SPAN:
        raise TorchCRFScanError(f"bearings: expected radians of one turn, got a span of {span:.1f}; are these degrees?")
    if np.abs(bearings).max(initial=0.0) > FARTHEST_BEARING:
        raise TorchCRFScanError(f"bearings: expected radians within two turns, got {bearings[np.abs(bearings).argmax()]:.6g}")
    return bearings


def times_of(count: int, time_increment: float | None, times: ArrayLike | None) -> Floats | None:
    """(count,) seconds of the beams after the first one; None: unknown."""
    if time_increment is not None and times is not None:
        raise TorchCRFScanError("times: expected either times or time_increment, got both")
    with np.errstate(over="ignore", invalid="ignore"):
        if times is not None:
            name, after = "times", vector("times", times, count)
        elif time_increment is None or (step := number("time_increment", time_increment, "seconds")) == 0:
            return None
        else:
            name, after = "time_increment", step * np.arange(count, dtype=np.float64)
        after = after - after[:1]
    wrong = after[~(np.abs(after) <= LONGEST_SWEEP)]
    if len(wrong):
        raise TorchCRFScanError(f"{name}: expected seconds within {LONGEST_SWEEP:g} of the first beam's, got {wrong[0]:.6g}")
    return after
