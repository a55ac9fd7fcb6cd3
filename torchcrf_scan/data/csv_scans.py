"""Scans in a CSV file, one in a row, as a spreadsheet or pandas writes them.

    stamp,-1.570796,-1.562069, ... ,1.570796
    0.000,2.31,2.32, ... ,inf
    0.050,2.30,2.32, ... ,

The first row names the columns: `stamp` (seconds), perhaps the sensor's pose by the wheels, `odom_theta` (radians), `odom_x` and
`odom_y` (metres), then the bearing of every beam in radians. An empty field, nan or inf is a beam without return, or an unknown
pose.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from pathlib import Path

import numpy as np

from torchcrf_scan.data.limits import check_beams
from torchcrf_scan.data.options import AS_RECORDED, ReadOptions
from torchcrf_scan.data.reading import Reading
from torchcrf_scan.data.text_lines import Line, read_lines
from torchcrf_scan.errors import TorchCRFScanError
from torchcrf_scan.scan import Floats, Scan

FIRST = "stamp"
ODOMETRY = ("odom_theta", "odom_x", "odom_y")


def read_csv_scans(path: str | Path, options: ReadOptions = AS_RECORDED) -> Iterator[Reading]:
    """The scans of a CSV file, one row at a time.

    Raises:
        TorchCRFScanError: a first row of another layout; or, after every scan before it, a row that does not fit it (unless
            `on_bad` takes it) or is cut, with line and byte.
        OSError: the file cannot be opened.
    """
    lines = read_lines(Path(path))
    head = next(lines, None)
    if head is None:
        raise TorchCRFScanError(f"{path}: expected a row of column names, got an empty file")
    has_odometry, bearings = _read_head(head)
    no_return = np.inf if options.no_return is None else options.no_return
    for line in lines:
        if line.text.strip():
            make = partial(_read_row, line, has_odometry, bearings, no_return)
            reading = options.attempt(make) if line.is_whole else make()
            if reading is not None:
                yield reading


def _read_head(line: Line) -> tuple[bool, Floats]:
    """Whether there is odometry, and the bearings."""
    first, *names = (name.strip().strip('"') for name in line.text.lstrip("\ufeff").split(","))
    has_odometry = tuple(names[:3]) == ODOMETRY
    names = names[3:] if has_odometry else names
    check_beams(len(names), line.where)
    try:
        bearings = np.array(names, dtype=np.float64)
        Scan.from_ranges(np.zeros(len(bearings)), bearings)
    except ValueError as error:
        raise TorchCRFScanError(f"{line.where}: expected bearings of one turn in radians behind {FIRST}, got {error}") from error
    if first != FIRST or not len(bearings):
        raise TorchCRFScanError(f"{line.where}: expected columns {FIRST} and bearings, got {line.text[:60]!r}")
    return has_odometry, bearings


def _read_row(line: Line, has_odometry: bool, bearings: Floats, no_return: float) -> Reading:
    fields = [field.strip() or "nan" for field in line.text.split(",")]
    ahead = 4 if has_odometry else 1
    if len(fields) != ahead + len(bearings):
        raise TorchCRFScanError(f"{line.where}: expected {ahead + len(bearings)} fields, got {len(fields)}")
    try:
        values = np.array(fields, dtype=np.float64)
    except ValueError as error:
        raise TorchCRFScanError(f"{line.where}: expected numbers, got {error}") from error
    if not np.isfinite(values[0]):
        raise TorchCRFScanError(f"{line.where}: expected a finite stamp, got {line.text[:60]!r}")
    ranges = np.where(values[ahead:] >= no_return, np.nan, values[ahead:])
    is_known = has_odometry and np.isfinite(values[1:4]).all()
    return Reading(Scan.from_ranges(ranges, bearings), float(values[0]), values[1:4] if is_known else None)
