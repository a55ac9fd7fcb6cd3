"""Trajectories in the format of the TUM RGB-D benchmark: lines `stamp x y z qx qy qz qw`, read by evo and most tools.

A pose is that of the sensor in the frame of the first scan; z, qx and qy are 0, for everything is planar.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from torchcrf_scan.errors import TorchCRFScanError
from torchcrf_scan.scan import Floats
from torchcrf_scan.whole_file import whole_file

FIELDS = 8
TILT = 0.1  # the largest |qx|, |qy| of a quaternion of length 1 that is read as planar
Write = Callable[[float, Floats], None]


@dataclass(frozen=True, slots=True)
class Trajectory:
    """S poses of a sensor.

    Attributes:
        stamps: (S,) seconds.
        poses: (S, 3) `T_world_sensor` = (theta, x, y).
    """

    stamps: Floats
    poses: Floats

    def __len__(self) -> int:
        return len(self.stamps)


@contextmanager
def writing_trajectory(path: str | Path) -> Iterator[Write]:
    """A trajectory under construction; yields `write(stamp, pose)`, to be called scan by scan with a pose (3,) (theta, x, y).

    The file is there when the block ends, and only if it ends without error; memory does not grow with the recording.

    Raises:
        OSError: the file could not be written; its old content is kept.
    """
    with whole_file(Path(path)) as file:

        def write(stamp: float, pose: Floats) -> None:
            theta, x, y = (float(value) for value in pose)
            file.write(f"{stamp:.9f} {x:.9f} {y:.9f} 0 0 0 {np.sin(theta / 2):.12f} {np.cos(theta / 2):.12f}\n".encode())

        yield write


def write_trajectory(path: str | Path, trajectory: Trajectory) -> None:
    """Writes a whole trajectory. Raises OSError if that fails; the file's old content is kept."""
    with writing_trajectory(path) as write:
        for stamp, pose in zip(trajectory.stamps, trajectory.poses, strict=True):
            write(stamp, pose)


def read_trajectory(path: str | Path) -> Trajectory:
    """Reads TUM lines; empty lines and comments (#) are left out, and z is not read.

    Raises:
        TorchCRFScanError: a line that is not eight finite numbers, or whose rotation is not about z; names file and line.
        OSError: the file cannot be opened.
    """
    try:
        lines = Path(path).read_text(encoding="utf-8").splitlines()
    except UnicodeDecodeError:
        raise TorchCRFScanError(f"{path}: expected lines of text, got other bytes") from None
    rows = [_row(line, f"{path}, line {number}") for number, line in enumerate(lines, 1) if line.partition("#")[0].strip()]
    table = np.array(rows, dtype=np.float64).reshape(-1, FIELDS)
    theta = 2 * np.arctan2(table[:, 6], table[:, 7])
    poses = np.stack([np.arctan2(np.sin(theta), np.cos(theta)), table[:, 1], table[:, 2]], axis=1)
    return Trajectory(table[:, 0], poses)


def _row(line: str, where: str) -> list[float]:
    """The eight numbers of one line."""
    words = line.partition("#")[0].split()
    try:
        row = [float(word) for word in words]
    except ValueError:
        row = []
    if len(row) != FIELDS or not np.isfinite(row).all():
        raise TorchCRFScanError(f"{where}: expected eight finite numbers (stamp x y z qx qy qz qw), got {line.strip()[:80]!r}")
    if np.hypot(row[4], row[5]) > TILT * np.hypot(row[6], row[7]):
        raise TorchCRFScanError(f"{where}: expected a rotation about z, got the quaternion {tuple(row[4:])}")
    return row
