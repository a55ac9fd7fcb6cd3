"""What the first scans and the PARAM lines of a CARMEN log tell about all of it: the laser, the clock, what means no return."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from torchcrf_scan.data.carmen_line import LaserLine, kind_of, read_laser_line
from torchcrf_scan.data.limits import MOST_SILENCE
from torchcrf_scan.data.no_return import find_no_return
from torchcrf_scan.data.options import ReadOptions
from torchcrf_scan.data.text_lines import Line, read_lines
from torchcrf_scan.errors import TorchCRFScanError
from torchcrf_scan.geometry import se2
from torchcrf_scan.scan import Floats

SCANS, ENOUGH = 300, 1 << 24  # scans and bytes that are looked at
SICK = 50.0  # metres; larger readings are beams without return (SICK LMS: 51 or 81.9), where no PARAM says otherwise
ROUNDING = 0.005  # metres
FARTHEST_MOUNT = 1.0  # metres from the robot's centre; what is farther is a corrected pose
PREFERRED = ("FLASER", "ROBOTLASER1", "RAWLASER1", "RLASER")  # the front laser first
WORDS = {"RLASER": ("rearlaser", "rear_laser")}  # by which PARAM lines name the laser; others: FRONT
FRONT = ("frontlaser", "front_laser")


class NotCarmenError(TorchCRFScanError):
    """A text without a single line of a laser."""


@dataclass(slots=True)
class Survey:
    """What is known of a log before it is read.

    Attributes:
        kind: of the lines to read.
        clock: which of the two stamps: the one that stands still or goes back less often; the logger's if both are as good.
        fov, step: radians of a laser whose lines do not say. no_return: metres.
        mount: (3,) pose of the sensor on the robot.
    """

    kind: str
    clock: int
    fov: float
    step: float | None
    no_return: float
    mount: Floats


@dataclass(slots=True)
class _Seen:
    kinds: Counter[str] = field(default_factory=Counter)
    params: dict[str, float] = field(default_factory=dict)
    lines: dict[str, list[LaserLine]] = field(default_factory=dict)
    fault: ValueError | None = None


def survey(path: Path, options: ReadOptions) -> Survey:
    """Looks at the beginning of a log.

    Raises:
        TorchCRFScanError: no scans of the kind that is asked for, or of any; the message names those that there are.
    """
    seen = _Seen()
    for line in _first_lines(path, seen, options.topic):
        _note(line, seen)
    if seen.fault is not None and not seen.kinds:
        raise seen.fault
    kind = _choose_kind(path, seen.kinds, options.topic)
    lines, params = seen.lines[kind], _params(seen.params, WORDS.get(kind, FRONT))
    return Survey(
        kind=kind,
        clock=_choose_clock(np.array([line.stamps for line in lines])),
        fov=_radians(params.get("fov")) or math.pi,
        step=_believed_step(_radians(params.get("resolution")), len(lines[0].ranges)),
        no_return=_no_return(lines, params.get("max")) if options.no_return is None else options.no_return,
        mount=_mount(kind, lines[0], params.get("offset")),
    )


def _first_lines(path: Path, seen: _Seen, topic: str | None) -> Iterator[Line]:
    """The lines up to enough scans, or to the fault if there is one behind a scan."""
    try:
        for line in read_lines(path):
            scans = seen.kinds[topic] if topic is not None else max(seen.kinds.values(), default=0)
            if scans >= SCANS or (scans > 0 and line.offset > ENOUGH):
                return
            if not seen.kinds and line.offset > MOST_SILENCE:
                raise TorchCRFScanError(f"{path}: expected a scan within the first {MOST_SILENCE} bytes, got none")
            yield line
    except ValueError:
        if not seen.kinds:
            raise


def _note(line: Line, seen: _Seen) -> None:
    if line.text.startswith("PARAM "):
        _, name, value, *_ = [*line.text.split(), "", ""]
        try:
            seen.params[name] = float(value)
        except ValueError:
            return
    elif (kind := kind_of(line.text)) is not None:
        try:
            seen.lines.setdefault(kind, []).append(read_laser_line(line, kind))
        except ValueError as error:
            seen.fault = seen.fault or error
        else:
            seen.kinds[kind] += 1


def _choose_kind(path: Path, kinds: Counter[str], topic: str | None) -> str:
    if not kinds:
        raise NotCarmenError(f"{path}: expected lines that start with {', '.join(PREFERRED)}, got none")
    if topic is None:
        return next((kind for kind in PREFERRED if kind in kinds), min(kinds))
    if topic not in kinds:
        raise TorchCRFScanError(f"{path}: topic: expected one of {', '.join(sorted(kinds))}, got {topic}")
    return topic


def _choose_clock(stamps: Floats) -> int:
    """stamps: (S, 2)."""
    stands = (np.diff(stamps, axis=0) <= 0).sum(axis=0)
    return 0 if stands[0] < stands[1] else 1


def _params(told: dict[str, float], words: tuple[str, ...]) -> dict[str, float]:
    """What PARAM lines say of a laser, e.g. `robot_front_laser_max`: its last word -> value."""
    found = {}
    for key, value in told.items():
        start, _, name = key.rpartition("_")
        if start.endswith(words) and math.isfinite(value):
            found[name] = value
    return found


def _radians(value: float | None) -> float | None:
    return None if value is None or value <= 0 else math.radians(value)


def _believed_step(step: float | None, beams: int) -> float | None:
    """The step that a PARAM states, unless the beams would then span less than 60 degrees or more than a turn."""
    return step if step is not None and math.pi / 3 <= step * (beams - 1) <= 2 * math.pi else None


def _no_return(lines: list[LaserLine], limit: float | None) -> float:
    """The least reading without return: as stated (lines with a limit of their own are held to that), or as readings show."""
    usual = math.inf if lines[0].limit is not None else SICK
    stated = (limit if limit is not None and limit > 0 else usual) - ROUNDING
    limits = (min(stated, math.inf if line.limit is None else line.limit - ROUNDING) for line in lines)
    readings = [line.ranges[line.ranges < limit] for line, limit in zip(lines, limits, strict=True)]
    shown = find_no_return(np.concatenate(readings))
    return stated if shown is None else shown


def _mount(kind: str, line: LaserLine, offset: float | None) -> Floats:
    """(3,) pose of the sensor on the robot: by the PARAM, or by a line that holds both poses, unless they are too far apart."""
    if kind != "FLASER" and line.pose is not None and line.robot is not None:
        between = se2.compose(se2.inverse(line.robot), line.pose)
        if np.hypot(*between[1:]) < FARTHEST_MOUNT:
            return between
    return np.array([0.0, 0.0 if offset is None else offset, 0.0])
