"""CARMEN logs, plain or gzipped, read line by line; `CarmenLog` makes pairs of them."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from pathlib import Path

import numpy as np

from torchcrf_scan.data.carmen_line import LaserLine, bearings_of, kind_of, read_laser_line
from torchcrf_scan.data.carmen_survey import ROUNDING, Survey, survey
from torchcrf_scan.data.options import AS_RECORDED, ReadOptions
from torchcrf_scan.data.reading import Reading
from torchcrf_scan.data.recording import Recording
from torchcrf_scan.data.text_lines import Line, read_lines
from torchcrf_scan.errors import TorchCRFScanError
from torchcrf_scan.geometry import se2
from torchcrf_scan.scan import Floats, Scan


def read_carmen(path: str | Path, options: ReadOptions = AS_RECORDED) -> Iterator[Reading]:
    """The scans of one laser of a log, in the order of the file; the front laser's where none is asked for.

    PARAM lines give field of view, step and greatest range of a laser whose lines do not; readings that mean "no return" are
    found in the log (`no_return`). Odometry is that of the sensor; for RAWLASER lines, of the ODOM line before them.

    Raises:
        TorchCRFScanError: no scans; or, after every scan before it, a malformed line (unless `on_bad` takes it) or damaged file,
            with line and byte.
        OSError: the file cannot be opened.
    """
    path = Path(path)
    known = survey(path, options)
    odometry: Floats | None = None
    for line in read_lines(path):
        if line.text.startswith("ODOM "):
            odometry = _read_odometry(line)
        elif kind_of(line.text) == known.kind:
            make = partial(_read_line, line, known, odometry)
            reading = options.attempt(make) if line.is_whole else make()
            if reading is not None:
                yield reading


def _read_line(line: Line, known: Survey, odometry: Floats | None) -> Reading:
    return _reading(read_laser_line(line, known.kind), known, odometry, line.where)


def _reading(laser: LaserLine, known: Survey, odometry: Floats | None, where: str) -> Reading:
    limit = known.no_return if laser.limit is None else min(known.no_return, laser.limit - ROUNDING)
    count = len(laser.ranges)
    if laser.start is None or laser.step is None:
        bearings = bearings_of(count, known.fov, known.step)
    else:
        bearings = laser.start + laser.step * np.arange(count, dtype=np.float64)
    try:
        scan = Scan.from_ranges(np.where(laser.ranges >= limit, np.nan, laser.ranges), bearings)
    except ValueError as error:
        raise TorchCRFScanError(f"{where}: {error}") from error
    robot = odometry if laser.robot is None else laser.robot
    sensor = None if robot is None else se2.compose(robot, known.mount)
    return Reading(scan, float(laser.stamps[known.clock]), sensor, laser.pose)


def _read_odometry(line: Line) -> Floats | None:
    """(3,) pose of an ODOM line, `ODOM x y theta ...`; None if it is malformed: the scans do not need it."""
    try:
        x, y, theta = (float(value) for value in line.text.split()[1:4])
    except ValueError:
        return None
    pose = np.array([theta, x, y])
    return pose if np.isfinite(pose).all() else None


class CarmenLog(Recording):
    """The pairs of consecutive scans of one laser of a log.

    Args:
        path: log file, gzipped or not.
        no_return: metres; readings from there on are beams without return. None: as the log says or shows.
        topic: kind of lines to read; None: those of the front laser.

    Raises:
        TorchCRFScanError: fewer than two scans, or a file that cannot be read.
    """

    def __init__(self, path: str | Path, *, no_return: float | None = None, topic: str | None = None) -> None:
        options = ReadOptions(topic=topic, no_return=no_return)
        super().__init__(path, partial(read_carmen, path, options))
