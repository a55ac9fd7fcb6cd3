"""Formats of recordings by file suffix: one file and one line each. All other files are pair files."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Protocol, overload

from torchcrf_scan.data.carmen import CarmenLog
from torchcrf_scan.scan import ScanPair


class Recording(Protocol):
    """A sequence of pairs of consecutive scans."""

    def __len__(self) -> int: ...
    @overload
    def __getitem__(self, index: int) -> ScanPair: ...
    @overload
    def __getitem__(self, index: slice) -> Sequence[ScanPair]: ...

    def pair_name(self, number: int) -> str:
        """The name of a pair: that of the recording and its number."""


FORMATS: Mapping[str, Callable[[str | Path], Recording]] = {".log": CarmenLog, ".log.gz": CarmenLog}  # by suffix
ENDINGS = ", ".join(FORMATS)


def reader_of(path: str | Path) -> Callable[[str | Path], Recording] | None:
    """The reader of a recording by its suffix; None for other files."""
    name = Path(path).name
    return next((read for ending, read in FORMATS.items() if name.endswith(ending)), None)


def read_recording(path: str | Path) -> Recording:
    """A recording with at least one pair.

    Raises:
        ValueError: an unknown suffix, a file that cannot be read, or fewer than two scans.
    """
    read = reader_of(path)
    if read is None:
        raise ValueError(f"{path}: expected a recording ({ENDINGS}), got another name")
    recording = read(path)
    if not len(recording):
        raise ValueError(f"{path}: expected at least two scans, got one")
    return recording
