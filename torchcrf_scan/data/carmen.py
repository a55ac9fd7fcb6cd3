"""CARMEN logs (`FLASER n r1..rn x y theta odom_x odom_y odom_theta t host t`), plain or gzipped, as a sequence of scan pairs."""

from __future__ import annotations

import gzip
import math
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import overload

import numpy as np

from torchcrf_scan.scan import Floats, Scan, ScanPair

NO_RETURN = 50.0  # metres; larger readings are beams without return (SICK LMS: 51 or 81.9)
FIELD_OF_VIEW = math.pi  # of the front laser; not stated in the format
TAIL = 9  # number of fields after the ranges


@dataclass(frozen=True, slots=True)
class CarmenScan:
    """One reading.

    Attributes:
        scan: the valid returns.
        stamp: seconds.
        pose: (x, y, theta) of the sensor, metres and radians; corrected if the log is.
        odometry: (x, y, theta) from the wheels.
    """

    scan: Scan
    stamp: float
    pose: Floats
    odometry: Floats


class CarmenLog(Sequence[ScanPair]):
    """The pairs of consecutive readings of the front laser, in the order of the file; pairs are made on demand.

    Args:
        path: log file, `.gz` or not.
        no_return: metres; larger readings are beams without return.

    Attributes:
        scans: all S readings; there are S - 1 pairs, none if S < 2.

    Raises:
        ValueError: a file that cannot be read, without readings, or with a malformed reading; names file and line.
    """

    def __init__(self, path: str | Path, *, no_return: float = NO_RETURN) -> None:
        self.path = Path(path)
        self.scans = [
            read_line(line, no_return, f"{self.path}, line {number}")
            for number, line in enumerate(read_text(self.path).splitlines(), start=1)
            if line.startswith("FLASER ")
        ]
        if not self.scans:
            raise ValueError(f"{self.path}: expected lines that start with FLASER, got none")

    def __len__(self) -> int:
        return len(self.scans) - 1

    @overload
    def __getitem__(self, index: int) -> ScanPair: ...
    @overload
    def __getitem__(self, index: slice) -> list[ScanPair]: ...
    def __getitem__(self, index: int | slice) -> ScanPair | list[ScanPair]:
        if isinstance(index, slice):
            return [self[k] for k in range(*index.indices(len(self)))]
        k = range(len(self))[index]
        source, target = self.scans[k], self.scans[k + 1]
        seconds = max(target.stamp - source.stamp, 1e-3)  # logs are not always in order
        name, sequence = self.pair_name(k), log_name(self.path)
        return ScanPair(source.scan, target.scan, seconds, name=name, sequence=sequence, origin=self.path.name)

    def pair_name(self, number: int) -> str:
        """The name of a pair: that of the log and its number."""
        return f"{log_name(self.path)}_{number:05d}"


def log_name(path: Path) -> str:
    """The name of a recording: that of the file, without `.log` and `.gz`."""
    return path.name.removesuffix(".gz").removesuffix(".log")


def read_text(path: Path) -> str:
    """Contents of a text file. Raises ValueError if it is missing or not text."""
    try:
        data = path.read_bytes()
        return (gzip.decompress(data) if path.suffix == ".gz" else data).decode("utf-8", errors="replace")
    except (OSError, EOFError, zlib.error) as error:
        raise ValueError(f"{path}: expected a CARMEN log, got {error}") from error


def read_line(line: str, no_return: float, where: str) -> CarmenScan:
    """One FLASER line. where: file and line, for the error."""
    fields = line.split()
    try:
        count = int(fields[1])
        ranges = np.array(fields[2 : 2 + count], dtype=np.float64)
        tail = fields[2 + count :]
        numbers = np.array([*tail[:6], tail[-1]], dtype=np.float64)
    except (ValueError, IndexError) as error:
        raise ValueError(f"{where}: expected FLASER with its number of ranges and numbers, got {line[:60]!r}") from error
    if len(ranges) != count or len(tail) < TAIL:
        raise ValueError(f"{where}: expected {count} ranges and {TAIL} fields behind them, got {len(fields) - 2} in all")
    scan = Scan.from_ranges(np.where(ranges >= no_return, np.nan, ranges), bearings_of(count))
    return CarmenScan(scan, float(numbers[6]), numbers[:3], numbers[3:6])


def bearings_of(count: int) -> Floats:
    """(count,) over 180 degrees: with both ends for an odd number of beams (181, 361), without the last for an even one."""
    step = FIELD_OF_VIEW / max(count - count % 2, 1)
    return -FIELD_OF_VIEW / 2 + step * np.arange(count, dtype=np.float64)
