"""A recording as a sequence of pairs of consecutive scans, read anew as they are asked for: never all of it in memory."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator, Sequence
from itertools import pairwise
from pathlib import Path
from typing import overload

import numpy as np

from torchcrf_scan.data.reading import Reading
from torchcrf_scan.data.stamps import steps_with_a_word
from torchcrf_scan.errors import TorchCRFScanError
from torchcrf_scan.geometry import se2
from torchcrf_scan.safe_names import check_name
from torchcrf_scan.scan import FARTHEST, Floats, ScanPair

logger = logging.getLogger(__name__)

Read = Callable[[], Iterator[Reading]]

SUFFIXES = (".gz", ".log", ".bag", ".mcap", ".db3", ".csv")


class Recording(Sequence[ScanPair]):
    """The pairs of consecutive scans of a recording, in its order.

    It is read once to count the scans, then again from the front as pairs are asked for: forward that costs no more than
    reading, backward it begins anew. Pairs have the odometry between their scans as `initial_motion`, unless it never changes.

    Args:
        path: file or folder, for names.
        read: begins to read. again: begins to read once more, without a word on what is left out; None: as `read` does.

    Attributes:
        fault: what ended the reading before the end of the file; None: nothing.

    Raises:
        TorchCRFScanError: fewer than two scans, or a name with control characters.
    """

    def __init__(self, path: str | Path, read: Read, again: Read | None = None) -> None:
        self.path, self._again = Path(path), again or read
        check_name(f"{self.path}: file name", self.path.name)
        self.fault: ValueError | None = None
        stamps, odometry = self._survey(read())
        self._steps = steps_with_a_word(stamps, str(self.path))
        self._motions = motions_between(odometry)
        self._position = -1
        self._ahead: Iterator[Reading] = iter(())
        self._scans: tuple[Reading, ...] = ()

    def _survey(self, readings: Iterator[Reading]) -> tuple[Floats, list[Floats | None]]:
        """(S,) stamps and S odometry poses."""
        stamps: list[float] = []
        odometry: list[Floats | None] = []
        try:
            for reading in readings:
                stamps.append(reading.stamp)
                odometry.append(reading.odometry)
        except ValueError as error:
            if len(stamps) < 2:
                raise
            self.fault = error
            logger.warning("%s; the %d scans before that are read", error, len(stamps))
        if len(stamps) < 2:
            raise TorchCRFScanError(f"{self.path}: expected at least two scans, got {['none', 'one'][len(stamps)]}")
        return np.array(stamps), odometry

    def __len__(self) -> int:
        return len(self._steps)

    @overload
    def __getitem__(self, index: int) -> ScanPair: ...
    @overload
    def __getitem__(self, index: slice) -> list[ScanPair]: ...
    def __getitem__(self, index: int | slice) -> ScanPair | list[ScanPair]:
        if isinstance(index, slice):
            return [self[k] for k in range(*index.indices(len(self)))]
        k = range(len(self))[index]
        source, target = self._scans_at(k)
        guess, name = self._motions[k], log_name(self.path)
        return ScanPair(
            source.scan, target.scan, float(self._steps[k]), None, name, self.pair_name(k), self.path.name, initial_motion=guess
        )

    def _scans_at(self, k: int) -> tuple[Reading, ...]:
        """The scans k and k + 1."""
        if self._position > k or self._position < 0:
            self._position, self._ahead = 0, self._again()
            self._scans = (next(self._ahead), next(self._ahead))
        while self._position < k:
            self._scans = (self._scans[1], next(self._ahead))
            self._position += 1
        return self._scans

    def pair_name(self, number: int) -> str:
        """The name of a pair: that of the recording and its number."""
        return f"{log_name(self.path)}_{number:05d}"


def log_name(path: Path) -> str:
    """The name of a recording: that of the file, without the endings of logs."""
    name = path.name
    for suffix in SUFFIXES:
        name = name.removesuffix(suffix)
    return name


def motions_between(odometry: Sequence[Floats | None]) -> list[Floats | None]:
    """(S-1) motions `T_target_source` between S poses of the sensor.

    None where one is unknown, where the sensor cannot have gone so far, or if all are the same.
    """
    known = [pose for pose in odometry if pose is not None]
    if not known or all(np.array_equal(pose, known[0]) for pose in known):
        return [None] * (len(odometry) - 1)
    motions = [None if a is None or b is None else se2.compose(se2.inverse(b), a) for a, b in pairwise(odometry)]
    return [motion if motion is not None and (np.abs(motion) <= FARTHEST).all() else None for motion in motions]
