"""Simulated drives as recordings: a CSV of ranges (`csv_scans`), without what is true of them."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from torchcrf_scan.data.csv_scans import FIRST
from torchcrf_scan.data.drive import Drive
from torchcrf_scan.data.laser import beam_bearings
from torchcrf_scan.data.worlds import SimulatorConfig
from torchcrf_scan.whole_file import whole_file


def write_drive(path: Path, drive: Drive, config: SimulatorConfig) -> None:
    """Writes the scans of a drive, stamped by their first beams. Raises OSError if that fails; the file's old content is kept.

    Args:
        config: that the drive was simulated with, whose sensor has a beam for every column.
    """
    bearings, step = beam_bearings(config)
    with whole_file(path) as file:
        file.write((",".join([FIRST, *(f"{value:.9f}" for value in bearings)]) + "\n").encode())
        for reading in drive.readings():
            fields = [""] * len(bearings)
            columns = np.round((reading.scan.bearings - bearings[0]) / (step or 1.0)).astype(int)
            for column, value in zip(columns, reading.scan.ranges, strict=True):
                fields[column] = f"{value:.4f}"
            file.write((",".join([f"{reading.stamp:.6f}", *fields]) + "\n").encode())
