"""Limits on what a file may make a reader hold at once, far above what sensors give."""

from __future__ import annotations

from torchcrf_scan.beams import MOST_BEAMS
from torchcrf_scan.errors import TorchCRFScanError

MOST_LINE = 1 << 22  # bytes of a line of text, more than that many beams of CARMEN's longest kind fill
MOST_SILENCE = 1 << 26  # bytes of text without a scan
MOST_CHUNK = 1 << 28  # bytes of an unpacked chunk or message of a bag
MOST_ARRAY = 1 << 24  # bytes of an array of an .npz archive
MOST_ARCHIVE = 1 << 26  # bytes of the archive, whose directory is read whole


def check_beams(count: int, where: str) -> None:
    """Raises TorchCRFScanError for more beams than `MOST_BEAMS`; where: file and place."""
    if count > MOST_BEAMS:
        raise TorchCRFScanError(f"{where}: expected at most {MOST_BEAMS} beams, got {count}")
