"""Lines of a text file, plain or gzipped, read in pieces of bounded size."""

from __future__ import annotations

import gzip
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import IO

from torchcrf_scan.data.limits import MOST_LINE
from torchcrf_scan.errors import TorchCRFScanError

GZIP = b"\x1f\x8b"


@dataclass(frozen=True, slots=True)
class Line:
    """A line without its end.

    Attributes:
        number: from 1. offset: of its first byte in the unpacked text. is_whole: it has an end; a cut file's last one has none.
    """

    text: str
    number: int
    offset: int
    path: Path
    is_whole: bool = True

    @property
    def where(self) -> str:
        """File, line and byte, for errors."""
        return f"{self.path}, line {self.number} (byte {self.offset})"


def read_lines(path: Path) -> Iterator[Line]:
    """The lines of a text file, one at a time.

    Raises:
        TorchCRFScanError: after the last whole line, where the file is damaged, cut, binary, or has a line beyond `MOST_LINE`.
        OSError: it cannot be opened.
    """
    number, offset = 1, 0
    with open_unpacked(path) as file:
        while raw := _next_line(file, path, number, offset):
            yield Line(raw.decode("utf-8", errors="replace").rstrip("\r\n"), number, offset, path, raw.endswith(b"\n"))
            number, offset = number + 1, offset + len(raw)


def is_gzipped(path: Path) -> bool:
    """Whether a file's first bytes are those of gzip."""
    with open(path, "rb") as file:
        return file.read(len(GZIP)) == GZIP


def open_unpacked(path: Path) -> IO[bytes]:
    """The file's contents, unpacked if it is gzipped."""
    return gzip.open(path) if is_gzipped(path) else open(path, "rb")  # type: ignore[return-value]


def _next_line(file: IO[bytes], path: Path, number: int, offset: int) -> bytes:
    where = f"{path}, line {number} (byte {offset})"
    try:
        raw = file.readline(MOST_LINE + 1)
    except (OSError, EOFError, zlib.error) as error:
        raise TorchCRFScanError(f"{where}: expected a whole file, got {error}") from error
    if len(raw) > MOST_LINE:
        raise TorchCRFScanError(f"{where}: expected lines of at most {MOST_LINE} bytes, got a longer one")
    if b"\0" in raw:
        raise TorchCRFScanError(f"{where}: expected text, got binary data")
    return raw
