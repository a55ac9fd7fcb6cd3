"""MCAP files of ROS, record by record: https://mcap.dev/spec.

Whole ones list their channels in a summary at the end; those of a recording that was cut are found by reading what there is.
"""

from __future__ import annotations

import io
import struct
from collections.abc import Collection, Iterator
from pathlib import Path
from typing import BinaryIO

from torchcrf_scan.data.bag_records import DAMAGES, Message, Topic, read_exactly, type_name, unpack
from torchcrf_scan.errors import TorchCRFScanError

MAGIC = b"\x89MCAP0\r\n"
FOOTER, SCHEMA, CHANNEL, MESSAGE, CHUNK, DATA_END = 2, 3, 4, 5, 6, 15
FOOTER_BYTES = 9 + 20 + len(MAGIC)


class McapBag:
    """An MCAP file of ROS 2 or ROS 1."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def topics(self) -> list[Topic]:
        """The topics by the file's summary, or by its records if it has none; raises TorchCRFScanError if none of them is whole."""
        found = _Channels()
        with open(self.path, "rb") as file:
            for start in (self._summary(file), len(MAGIC)):
                if start is not None and not found.topics:
                    self._search(file, start, found)
        return list({topic.name: topic for topic in found.topics.values()}.values())

    def _summary(self, file: BinaryIO) -> int | None:
        """Where the summary begins; None: there is none."""
        size = file.seek(0, io.SEEK_END)
        file.seek(max(size - FOOTER_BYTES, 0))
        end = file.read()
        if len(end) != FOOTER_BYTES or end[0] != FOOTER or not end.endswith(MAGIC):
            return None
        start = int(struct.unpack("<Q", end[9:17])[0])
        return start if 0 < start < size else None

    def _search(self, file: BinaryIO, start: int, found: _Channels) -> None:
        try:
            for _ in _walk(file, start, found):
                pass
        except DAMAGES as error:
            if not found.topics and start == len(MAGIC):
                raise self._fault(file, error) from error
            # else told when the messages are read

    def messages(self, names: Collection[str]) -> Iterator[Message]:
        """The messages of some topics in the order of the file.

        Raises:
            TorchCRFScanError: a damaged or cut record, with its offset, after all messages before it.
        """
        with open(self.path, "rb") as file:
            try:
                for topic, stamp, data, offset in _walk(file, len(MAGIC), _Channels()):
                    if topic.name in names:
                        yield Message(topic, stamp, data, f"{self.path}, record at byte {offset}")
            except DAMAGES as error:
                raise self._fault(file, error) from error

    def _fault(self, file: BinaryIO, error: Exception) -> ValueError:
        return TorchCRFScanError(f"{self.path}, byte {file.tell()}: expected a whole record of MCAP, got {error}")


class _Channels:
    """Schemas and channels as they are met."""

    def __init__(self) -> None:
        self.schemas: dict[int, tuple[str, str, str]] = {}
        self.topics: dict[int, Topic] = {}

    def note(self, kind: int, data: bytes) -> None:
        file = io.BytesIO(data)
        (number,) = struct.unpack("<H", file.read(2))
        if kind == SCHEMA:
            self.schemas[number] = (_string(file), _string(file), _string(file))
            return
        (schema,) = struct.unpack("<H", file.read(2))
        name, encoding, definition = self.schemas.get(schema, ("", "", ""))
        topic, written = _string(file), _string(file)
        self.topics[number] = Topic(topic, type_name(name), definition, encoding.endswith("idl"), written != "ros1")


def _walk(file: BinaryIO, start: int, found: _Channels) -> Iterator[tuple[Topic, float, bytes, int]]:
    """Topic, stamp, data and offset of every message from a position to the end of the data or of the summary."""
    file.seek(start)
    while True:
        offset = file.tell()
        kind, data = _read_record(file)
        if kind in (DATA_END, FOOTER):
            return
        if kind == CHUNK:
            records = _unpack(data)
            inner = io.BytesIO(records)
            while inner.tell() < len(records):
                yield from _read_message(*_read_record(inner), found, offset)
        else:
            yield from _read_message(kind, data, found, offset)


def _read_message(kind: int, data: bytes, found: _Channels, offset: int) -> Iterator[tuple[Topic, float, bytes, int]]:
    if kind in (SCHEMA, CHANNEL):
        found.note(kind, data)
    elif kind == MESSAGE:
        channel, _, stamp = struct.unpack("<HIQ", data[:14])
        yield found.topics[channel], 1e-9 * stamp, data[22:], offset


def _read_record(file: BinaryIO) -> tuple[int, bytes]:
    head = read_exactly(file, 9)
    return head[0], read_exactly(file, int(struct.unpack("<Q", head[1:])[0]))


def _unpack(data: bytes) -> bytes:
    """The records of a chunk."""
    size, _ = struct.unpack("<QI", data[16:28])
    file = io.BytesIO(data)
    file.seek(28)
    compression = _string(file)
    (length,) = struct.unpack("<Q", file.read(8))
    return unpack(read_exactly(file, length), compression, size)


def _string(file: BinaryIO) -> str:
    (size,) = struct.unpack("<I", read_exactly(file, 4))
    return read_exactly(file, size).decode(errors="replace")
