"""Lines of CARMEN logs that hold a scan.

    FLASER|RLASER n r1..rn x y theta odom_x odom_y odom_theta t host t
    ROBOTLASERk type start fov step max accuracy mode n r1..rn m remission1..m laser_x y theta robot_x y theta + 5 fields, t host t
    RAWLASERk, as far as the remissions, then t host t

The first t is that of the message, the second that of the logger.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass

import numpy as np

from torchcrf_scan.data.limits import check_beams
from torchcrf_scan.data.text_lines import Line
from torchcrf_scan.errors import TorchCRFScanError
from torchcrf_scan.scan import Floats

KIND = re.compile(r"(FLASER|RLASER|ROBOTLASER\d|RAWLASER\d) ")
POSES = {"F": 6, "R": 6, "ROBOT": 11, "RAW": 0}  # fields between the beams and the stamps
STAMPS = 3
GEOMETRY = 7  # fields before the number of beams


@dataclass(frozen=True, slots=True)
class LaserLine:
    """A scan as a line states it.

    Attributes:
        ranges: (N,) metres, as written.
        start, step: radians; `limit`: metres, its greatest range; None: the line does not say.
        stamps: (2,) seconds, of the message and of the logger.
        pose: (3,) (theta, x, y) of the sensor. robot: (3,) of the robot by the wheels. None: not in the line.
    """

    ranges: Floats
    start: float | None
    step: float | None
    limit: float | None
    stamps: Floats
    pose: Floats | None
    robot: Floats | None


def kind_of(text: str) -> str | None:
    """The kind of a line that holds a scan; None for other lines."""
    match = KIND.match(text)
    return None if match is None else match[1]


def read_laser_line(line: Line, kind: str) -> LaserLine:
    """The scan of a line; raises TorchCRFScanError, with its place, if it is cut or malformed."""
    fields = line.text.split()
    try:
        return _read_fields(fields, kind.rstrip("0123456789").removesuffix("LASER"), line)
    except (ValueError, IndexError) as error:
        if str(error).startswith(str(line.path)):
            raise
        raise TorchCRFScanError(f"{line.where}: expected {kind} with its numbers, got {line.text[:60]!r}") from error


def _read_fields(fields: list[str], family: str, line: Line) -> LaserLine:
    has_geometry = family in ("ROBOT", "RAW")
    ranges, at = _counted(fields, 1 + GEOMETRY * has_geometry, line)
    start, step, limit = _geometry(fields, len(ranges)) if has_geometry else (None, None, None)
    if has_geometry:
        _, at = _counted(fields, at, line)  # remissions
    tail, poses = fields[at:], POSES[family]
    if len(tail) < poses + STAMPS:
        raise TorchCRFScanError(f"{line.where}: expected {poses + STAMPS} fields behind the ranges, got {len(tail)}")
    numbers = np.array(tail[: min(poses, 6)], dtype=np.float64)
    stamps = np.array([tail[poses], tail[-1]], dtype=np.float64)
    if not np.isfinite(stamps).all():
        raise TorchCRFScanError(f"{line.where}: expected finite stamps, got {' '.join(tail)[:60]!r}")
    first, second = (numbers[[k + 2, k, k + 1]] if poses and np.isfinite(numbers[k : k + 3]).all() else None for k in (0, 3))
    return LaserLine(ranges, start, step, limit, stamps, first, second)


def _geometry(fields: list[str], count: int) -> tuple[float, float, float | None]:
    """Start angle, step and greatest range (None: not positive) of a line that has them."""
    _, start, fov, step, limit, *_ = map(float, fields[1 : 1 + GEOMETRY])
    return start, _exact_step(step, fov, count), limit if limit > 0 else None


def _exact_step(step: float, fov: float, count: int) -> float:
    """The step by the field of view where both agree, as it is written with more digits per beam; or where it is missing."""
    by_view = fov / max(count - 1, 1)
    return by_view if step == 0 or abs(step - by_view) * (count - 1) < abs(step) / 2 else step


def _counted(fields: list[str], at: int, line: Line) -> tuple[Floats, int]:
    """Numbers behind their count, and the position behind them."""
    count = int(fields[at])
    check_beams(count, line.where)
    values = np.array(fields[at + 1 : at + 1 + max(count, 0)], dtype=np.float64)
    if len(values) != count:
        raise TorchCRFScanError(f"{line.where}: expected {count} numbers, got {len(values)}")
    return values, at + 1 + count


def bearings_of(count: int, fov: float = math.pi, step: float | None = None) -> Floats:
    """(count,) bearings of a laser that looks ahead, radians.

    Without a step they cover the field of view: with both ends for an odd number of beams (181, 361), without the last for an
    even one.
    """
    if step is None:
        step = fov / max(count - count % 2, 1)
    else:
        fov = step * (count - count % 2)
    return -fov / 2 + step * np.arange(count, dtype=np.float64)
