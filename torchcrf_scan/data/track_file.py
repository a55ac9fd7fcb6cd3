"""Files of tracks: `tracks.csv`, one line per object and scan, objects numbered over the whole recording.

Columns: stamp (s), id, x, y (m), heading (rad), vx, vy (m/s over ground), length, width (m), points. Positions are in the frame of
the first scan. An object with 0 points is predicted: it was not seen in that scan.
"""

from __future__ import annotations

import csv
import math
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from io import StringIO
from pathlib import Path

import numpy as np

from torchcrf_scan.errors import TorchCRFScanError
from torchcrf_scan.result import MovingObject
from torchcrf_scan.scan import Floats, Ints
from torchcrf_scan.whole_file import whole_file

COLUMNS = ("stamp", "id", "x", "y", "heading", "vx", "vy", "length", "width", "points")
LARGEST = 1 << 63  # what 64 bits hold, and far beyond any field
WHOLE = ("id", "points")  # columns of whole numbers
Write = Callable[[float, Iterable[MovingObject]], None]


@dataclass(frozen=True, slots=True)
class TrackTable:
    """The R rows of a file of tracks, in its order.

    Attributes:
        stamp: (R,) seconds. number: (R,) of the objects. points: (R,) of each in its scan.
        position: (R, 2) metres. heading: (R,) radians. velocity: (R, 2) m/s. extent: (R, 2) length and width, metres.
    """

    stamp: Floats
    number: Ints
    position: Floats
    heading: Floats
    velocity: Floats
    extent: Floats
    points: Ints

    def __len__(self) -> int:
        return len(self.stamp)


def _line(stamp: float, of: MovingObject) -> str:
    """One line of the file; a micrometre is enough, but a stamp needs all digits of its seconds."""
    numbers = (*of.position, of.heading, *of.velocity, *of.extent)
    return ",".join([f"{stamp:.9f}", str(of.number), *(f"{value:.6f}" for value in numbers), str(of.points)]) + "\n"


@contextmanager
def writing_tracks(path: str | Path) -> Iterator[Write]:
    """A file of tracks under construction; yields `write(stamp, objects)`, to be called scan by scan.

    The file is there when the block ends, and only if it ends without error; memory does not grow with the recording.

    Raises:
        OSError: the file could not be written; its old content is kept.
    """
    with whole_file(Path(path)) as file:
        file.write((",".join(COLUMNS) + "\n").encode())

        def write(stamp: float, objects: Iterable[MovingObject]) -> None:
            file.write("".join(_line(stamp, of) for of in objects).encode())

        yield write


def read_tracks(path: str | Path) -> TrackTable:
    """Reads a file of tracks. Further columns are ignored.

    Raises:
        TorchCRFScanError: a missing column, a line that is too short, or a field that is not a number; names file and line.
        OSError: the file cannot be opened.
    """
    try:
        text = Path(path).read_text(encoding="utf-8")
    except UnicodeDecodeError:
        raise TorchCRFScanError(f"{path}: expected a CSV file of tracks, got other bytes") from None
    lines = csv.reader(StringIO(text, newline=""))
    header = next(lines, [])
    missing = [name for name in COLUMNS if name not in header]
    if missing:
        raise TorchCRFScanError(f"{path}, line 1: expected the columns {', '.join(COLUMNS)}, got none named {', '.join(missing)}")
    places = [header.index(name) for name in COLUMNS]
    rows = [_fields(line, places, f"{path}, line {lines.line_num}") for line in lines if line]
    table = np.array(rows, dtype=np.float64).reshape(-1, len(COLUMNS))
    number, points = (np.array([row[COLUMNS.index(name)] for row in rows], dtype=np.int64) for name in WHOLE)
    return TrackTable(table[:, 0], number, table[:, 2:4], table[:, 4], table[:, 5:7], table[:, 7:9], points)


def _fields(line: list[str], places: list[int], where: str) -> list[float | int]:
    """The numbers of one line, in the order of `COLUMNS`."""
    if len(line) <= max(places):
        raise TorchCRFScanError(f"{where}: expected at least {max(places) + 1} fields, got {len(line)}")
    fields: list[float | int] = []
    for name, place in zip(COLUMNS, places, strict=True):
        kind = int if name in WHOLE else float
        try:
            value = kind(line[place])
        except ValueError:
            value = math.nan
        if not abs(value) < LARGEST:
            raise TorchCRFScanError(
                f"{where}: {name}: expected a {'whole' if kind is int else 'finite'} number, got {line[place]!r}"
            )
        fields.append(value)
    return fields
