"""What the formats of bags have in common: topics, messages, and chunks that are unpacked up to a limit."""

from __future__ import annotations

import bz2
import struct
from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO, Protocol

from torchcrf_scan.data.limits import MOST_CHUNK
from torchcrf_scan.errors import TorchCRFScanError

DAMAGES = (OSError, EOFError, ValueError, KeyError, IndexError, struct.error)  # of unpacking and parsing what is damaged


@dataclass(frozen=True, slots=True)
class Topic:
    """A topic of a bag.

    Attributes:
        name: e.g. /scan. type: e.g. sensor_msgs/msg/LaserScan. definition: of the type, as the bag holds it; may be empty.
        is_idl: whether that is in IDL. is_cdr: whether messages are in CDR, as ROS 2 writes them; else as ROS 1 does.
    """

    name: str
    type: str
    definition: str
    is_idl: bool = False
    is_cdr: bool = True


def type_name(name: str) -> str:
    """A type's name as in ROS 2: sensor_msgs/LaserScan is sensor_msgs/msg/LaserScan."""
    package, _, kind = name.rpartition("/")
    return f"{package.removesuffix('/msg')}/msg/{kind}"


@dataclass(frozen=True, slots=True)
class Message:
    """A message. stamp: seconds, when it was recorded. where: file and place, for errors. is_packed: by zstd."""

    topic: Topic
    stamp: float
    data: bytes
    where: str
    is_packed: bool = False


class Bag(Protocol):
    """A bag in any format."""

    path: Path

    def topics(self) -> list[Topic]:
        """The topics, in the order in which they were found."""

    def messages(self, names: Collection[str]) -> Iterator[Message]:
        """The messages of some topics as recorded; raises TorchCRFScanError, with its offset, at a fault, after all before it."""


def read_exactly(file: BinaryIO, size: int) -> bytes:
    """The next `size` bytes; raises EOFError if there are fewer, TorchCRFScanError for more than `MOST_CHUNK`."""
    if size > MOST_CHUNK:
        raise TorchCRFScanError(f"expected at most {MOST_CHUNK} bytes, got {size}")
    data = file.read(size)
    if len(data) != size:
        raise EOFError(f"{len(data)} of {size} bytes")
    return data


def unpack(data: bytes, compression: str, size: int) -> bytes:
    """Unpacks a chunk of a stated size; raises TorchCRFScanError if it is beyond the limit, or not of that size."""
    if size > MOST_CHUNK:
        raise TorchCRFScanError(f"expected chunks of at most {MOST_CHUNK} bytes, got one of {size}")
    if compression in ("", "none"):
        return data
    makers: dict[str, Callable[[], Any]] = {"bz2": bz2.BZ2Decompressor, "lz4": _lz4, "zstd": _zstd}
    if compression not in makers:
        raise TorchCRFScanError(f"expected compression by {', '.join(makers)} or none, got {compression!r}")
    unpacked = _decompress(makers[compression](), data, size + 1)
    if len(unpacked) != size:
        raise TorchCRFScanError(f"expected a chunk of {size} bytes, got {'more' if len(unpacked) > size else len(unpacked)}")
    return unpacked


def unpack_message(data: bytes) -> bytes:
    """Unpacks a message packed by zstd; raises TorchCRFScanError if it is damaged, or beyond the limit."""
    decompressor = _zstd()
    unpacked = _decompress(decompressor, data, MOST_CHUNK)
    if not decompressor.eof:
        raise TorchCRFScanError(f"expected a whole message of at most {MOST_CHUNK} bytes, got {len(unpacked)} and more")
    return unpacked


def _decompress(decompressor: Any, data: bytes, most: int) -> bytes:
    try:
        return decompressor.decompress(data, most)
    except Exception as error:  # each library has its own
        raise TorchCRFScanError(f"expected data that can be unpacked, got {error}") from error


def _lz4() -> Any:
    try:
        from lz4.frame import LZ4FrameDecompressor
    except ImportError as error:
        raise TorchCRFScanError(f"expected the library lz4, which unpacks this (extra `ros`), got {error}") from error
    return LZ4FrameDecompressor()


def _zstd() -> Any:
    try:
        from compression import zstd
    except ImportError:
        try:
            from backports import zstd
        except ImportError as error:
            raise TorchCRFScanError(
                f"expected the library backports.zstd, which unpacks this (extra `ros`), got {error}"
            ) from error
    return zstd.ZstdDecompressor()
