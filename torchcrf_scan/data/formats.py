"""Formats of recordings, recognised by what a file holds, never by its name: one module and one line each."""

from __future__ import annotations

import gzip
import zlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

from torchcrf_scan.data import mcap_bag, ros1_bag, ros2_bag
from torchcrf_scan.data.archive import ZIP
from torchcrf_scan.data.carmen import read_carmen
from torchcrf_scan.data.carmen_survey import NotCarmenError
from torchcrf_scan.data.csv_scans import FIRST, read_csv_scans
from torchcrf_scan.data.options import AS_RECORDED, AUTO, ReadOptions
from torchcrf_scan.data.pair_file import read_pair_scans
from torchcrf_scan.data.reading import Reading
from torchcrf_scan.data.recording import Recording
from torchcrf_scan.data.ros_bag import read_folder_bag, read_mcap, read_ros1_bag, read_sqlite_bag
from torchcrf_scan.data.text_lines import open_unpacked
from torchcrf_scan.errors import TorchCRFScanError

HEAD = 512  # bytes
STARTS = (ZIP, ros1_bag.MAGIC, mcap_bag.MAGIC, ros2_bag.SQLITE)
BINARY = b"\x80\x93"  # first bytes of a pickle and of an array of numpy

Reader = Callable[[Path, ReadOptions], Iterator[Reading]]


@dataclass(frozen=True, slots=True)
class Format:
    """A format of recordings.

    Attributes:
        name: for messages. fits: whether a file that begins like this (unpacked if it is gzipped) has it. read: its reader.
        options: of `ReadOptions`, those that it takes beside `on_bad`.
    """

    name: str
    fits: Callable[[bytes], bool]
    read: Reader
    options: tuple[str, ...] = ("topic", "odometry", "no_return")

    def check(self, path: str | Path, options: ReadOptions) -> None:
        """Raises TorchCRFScanError for an option without meaning in this format; `auto` odometry is what comes with the scans."""
        for name in ("topic", "odometry", "no_return"):
            value = getattr(options, name)
            if name not in self.options and value not in (None, AUTO):
                raise TorchCRFScanError(f"{path}: {name}: expected none, as this is a {self.name}, got {value}")


def _begins(start: bytes) -> Callable[[bytes], bool]:
    return lambda head: head.startswith(start)


def _is_csv(head: bytes) -> bool:
    return head.removeprefix(b"\xef\xbb\xbf").replace(b'"', b"").startswith(f"{FIRST},".encode())


def _is_text(head: bytes) -> bool:
    return head.strip() != b"" and head[0] not in BINARY and min(head) >= ord("\t")


def _read_text(path: Path, options: ReadOptions) -> Iterator[Reading]:
    """The scans of a text, which is taken for a CARMEN log; one without any is told the formats that are read."""
    try:
        yield from read_carmen(path, options)
    except NotCarmenError as error:
        raise TorchCRFScanError(f"{path}: expected one of {NAMES}, got another text ({error})") from error


PAIR = Format("pair file", _begins(ZIP), read_pair_scans, ())
FOLDER = Format("folder of ROS 2", lambda head: False, read_folder_bag)
FORMATS = (  # the first that fits
    PAIR,
    Format("ROS 1 bag", _begins(ros1_bag.MAGIC), read_ros1_bag),
    Format("MCAP file", _begins(mcap_bag.MAGIC), read_mcap),
    Format("ROS 2 database", _begins(ros2_bag.SQLITE), read_sqlite_bag),
    Format("CSV of ranges", _is_csv, read_csv_scans, ("no_return",)),
    Format("CARMEN log", _is_text, _read_text, ("topic", "no_return")),
    FOLDER,
)
NAMES = ", ".join(form.name for form in FORMATS)


def find_format(path: str | Path) -> Format | None:
    """The format of a file or folder; None if it is none of `FORMATS`. Raises OSError if it cannot be read."""
    path = Path(path)
    if path.is_dir():
        return FOLDER if ros2_bag.is_folder_bag(path) else None
    head = _head(path)
    return None if _is_cut(head) else next((form for form in FORMATS if form.fits(head)), None)


def _head(path: Path) -> bytes:
    """The first bytes of a file, unpacked; none of a packed one that is damaged."""
    with open_unpacked(path) as file:
        try:
            return file.read(HEAD)
        except (EOFError, gzip.BadGzipFile, zlib.error):
            return b""


def _is_cut(head: bytes) -> bool:
    """Whether a file ends within the bytes that tell its format."""
    return any(len(head) < len(start) and start.startswith(head) for start in STARTS)


def read_scans(
    path: str | Path,
    topic: str | None = None,
    *,
    odometry: str | None = None,
    no_return: float | None = None,
    on_bad: Callable[[ValueError], None] | None = None,
) -> Iterator[Reading]:
    """The scans of a recording in any format, one at a time; the options are those of `ReadOptions`.

    Raises:
        TorchCRFScanError: another format, or what its reader says; of a damaged or cut file after every scan before the fault, with
            its place.
        OSError: the file cannot be opened.
    """
    options = ReadOptions(topic, odometry, no_return, on_bad)
    return _reader(path, options)(Path(path), options)


def read_recording(path: str | Path, options: ReadOptions = AS_RECORDED) -> Recording:
    """The pairs of consecutive scans of a recording in any format; `on_bad` is told once of what is left out.

    Raises:
        TorchCRFScanError: another format, a file that cannot be read, or fewer than two scans.
        OSError: the file cannot be opened.
    """
    read, quiet = _reader(path, options), replace(options, on_bad=options.on_bad and _ignore)
    return Recording(path, partial(read, Path(path), options), partial(read, Path(path), quiet))


def _ignore(error: ValueError) -> None:
    """Of what was told before."""


def _reader(path: str | Path, options: ReadOptions) -> Reader:
    form = find_format(path)
    if form is None:
        raise TorchCRFScanError(f"{path}: expected one of {NAMES}, got {_unknown(Path(path))}")
    form.check(path, options)
    return form.read


def _unknown(path: Path) -> str:
    """What a file is that has none of the formats."""
    if path.is_dir() or not _is_cut(_head(path)):
        return "none of these"
    size = path.stat().st_size
    return f"a file that is cut after {size} bytes" if size else "an empty file"
