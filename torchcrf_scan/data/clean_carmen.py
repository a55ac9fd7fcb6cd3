"""CARMEN logs written again without what moves: readings of moving objects become "no return", all else stays as it is."""

from __future__ import annotations

import gzip
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from torchcrf_scan.data.carmen_line import GEOMETRY, LaserLine, kind_of, read_laser_line
from torchcrf_scan.data.carmen_survey import Survey, survey
from torchcrf_scan.data.options import ReadOptions
from torchcrf_scan.data.text_lines import Line, is_gzipped, read_lines
from torchcrf_scan.errors import TorchCRFScanError
from torchcrf_scan.result import ScanResult
from torchcrf_scan.scan import Bools
from torchcrf_scan.whole_file import whole_file

SICK = 81.91  # metres: what a SICK LMS writes where nothing comes back
MARGIN = 0.01  # metres beyond the least reading without return

Write = Callable[[ScanResult], None]


@contextmanager
def writing_clean_carmen(source: Path, target: Path, options: ReadOptions) -> Iterator[Write]:
    """A log under construction: yields `write(result)`, to be called with the results of the source's scans in their order.

    Scans of that laser for which there is no result are left out; other lines are copied up to the last result, and all of them
    if every scan had one. It is gzipped if the source is, and there when the block ends, if that ends without error.

    Args:
        options: with which the source was read.
    """
    known, lines = survey(source, options), read_lines(source)
    with whole_file(target) as raw, ExitStack() as stack:
        file: Any = raw
        if is_gzipped(source):
            file = stack.enter_context(gzip.GzipFile(fileobj=raw, mode="wb", filename="", mtime=0))

        def put(text: str) -> None:
            file.write(f"{text}\n".encode())

        def write(result: ScanResult) -> None:
            for line in lines:
                if kind_of(line.text) != known.kind:
                    put(line.text)
                elif (laser := _laser(line, known)) is not None and _is_scan_of(laser, known, result):
                    put(blank(line, laser, known, result.moving))
                    return
            raise TorchCRFScanError(f"{source}: expected the scan of {result.stamp:.6f} s, got no such line")

        yield write
        for line in _until_fault(lines):
            if kind_of(line.text) == known.kind:
                break
            put(line.text)


def _until_fault(lines: Iterator[Line]) -> Iterator[Line]:
    """The lines before a fault, of which the reader of the scans has told."""
    try:
        yield from lines
    except ValueError:
        return


def _laser(line: Line, known: Survey) -> LaserLine | None:
    """The scan of a line; None if it is malformed: then there is no result of it."""
    try:
        return read_laser_line(line, known.kind)
    except ValueError:
        return None


def _is_scan_of(laser: LaserLine, known: Survey, result: ScanResult) -> bool:
    return len(laser.ranges) == len(result.moving) and float(laser.stamps[known.clock]) == result.stamp


def blank(line: Line, laser: LaserLine, known: Survey, moving: Bools) -> str:
    """A line whose moving beams say that nothing came back; other fields keep their digits."""
    fields = line.text.split(" ")
    words = [index for index, field in enumerate(fields) if field]  # fields may be parted by several blanks
    first = 2 + GEOMETRY * (known.kind[:2] in ("RO", "RA"))
    value = max(SICK, known.no_return + MARGIN if np.isfinite(known.no_return) else 0.0) if laser.limit is None else laser.limit
    for beam in np.flatnonzero(moving):
        fields[words[first + beam]] = f"{value:.2f}"
    return " ".join(fields)
