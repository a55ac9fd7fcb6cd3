"""Bags of ROS 1 (version 2.0), record by record: http://wiki.ros.org/Bags/Format/2.0.

Whole ones list their topics at the end; those of a recording that was cut are found by reading what there is.
"""

from __future__ import annotations

import io
import struct
from collections.abc import Collection, Iterator
from pathlib import Path
from typing import BinaryIO

from torchcrf_scan.data.bag_records import DAMAGES, Message, Topic, read_exactly, type_name, unpack
from torchcrf_scan.errors import TorchCRFScanError

MAGIC = b"#ROSBAG V2.0\n"
MESSAGE, HEADER, INDEX, CHUNK, CHUNK_INFO, CONNECTION = range(2, 8)

Fields = dict[bytes, bytes]


class Ros1Bag:
    """A bag of ROS 1."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def topics(self) -> list[Topic]:
        """The topics by the bag's index, or by its records if it has none; raises TorchCRFScanError if none of them is whole."""
        connections: dict[int, Topic] = {}
        with open(self.path, "rb") as file:
            try:
                for _ in _walk(file, self._index(file), connections, skip_chunks=True):
                    pass
            except DAMAGES:
                connections.clear()
            if not connections:
                self._search(file, connections)
        return list({topic.name: topic for topic in connections.values()}.values())

    def _index(self, file: BinaryIO) -> int:
        """Where the index begins."""
        file.seek(len(MAGIC))
        fields, _ = _read_record(file)
        (position,) = struct.unpack("<Q", fields[b"index_pos"])
        if position == 0:
            raise TorchCRFScanError("expected an index, got none")
        return int(position)

    def _search(self, file: BinaryIO, connections: dict[int, Topic]) -> None:
        try:
            for _ in _walk(file, len(MAGIC), connections):
                pass
        except DAMAGES as error:
            if not connections:
                raise self._fault(file, error) from error
            # else told when the messages are read

    def messages(self, names: Collection[str]) -> Iterator[Message]:
        """The messages of some topics in the order of the file.

        Raises:
            TorchCRFScanError: a damaged or cut record, with its offset, after all messages before it.
        """
        connections: dict[int, Topic] = {}
        with open(self.path, "rb") as file:
            try:
                for topic, stamp, data, offset in _walk(file, len(MAGIC), connections):
                    if topic.name in names:
                        yield Message(topic, stamp, data, f"{self.path}, chunk at byte {offset}")
            except DAMAGES as error:
                raise self._fault(file, error) from error

    def _fault(self, file: BinaryIO, error: Exception) -> ValueError:
        return TorchCRFScanError(f"{self.path}, byte {file.tell()}: expected a whole record of a bag, got {error}")


def _walk(
    file: BinaryIO, start: int, connections: dict[int, Topic], *, skip_chunks: bool = False
) -> Iterator[tuple[Topic, float, bytes, int]]:
    """Topic, stamp, data and offset of every message from a position on; notes the connections."""
    file.seek(start)
    while (record := _next_record(file)) is not None:
        fields, data = record
        kind = fields[b"op"][0]
        if kind == CONNECTION:
            _note(fields, data, connections)
        elif kind == CHUNK and not skip_chunks:
            offset = file.tell() - len(data)
            (size,) = struct.unpack("<L", fields[b"size"])
            inner = io.BytesIO(unpack(data, fields[b"compression"].decode(), size))
            yield from ((*message, offset) for message in _messages_of(inner, connections))


def _messages_of(chunk: BinaryIO, connections: dict[int, Topic]) -> Iterator[tuple[Topic, float, bytes]]:
    while (record := _next_record(chunk)) is not None:
        fields, data = record
        if fields[b"op"][0] == CONNECTION:
            _note(fields, data, connections)
        elif fields[b"op"][0] == MESSAGE:
            seconds, nanoseconds = struct.unpack("<LL", fields[b"time"])
            yield connections[struct.unpack("<L", fields[b"conn"])[0]], seconds + 1e-9 * nanoseconds, data


def _note(fields: Fields, data: bytes, connections: dict[int, Topic]) -> None:
    told = _fields(data)
    definition = told[b"message_definition"].decode(errors="replace")
    topic = "/" + fields[b"topic"].decode().strip("/")
    connections[struct.unpack("<L", fields[b"conn"])[0]] = Topic(topic, type_name(told[b"type"].decode()), definition, is_cdr=False)


def _next_record(file: BinaryIO) -> tuple[Fields, bytes] | None:
    """The record at the present position; None at the end of the file."""
    if not file.read(1):
        return None
    file.seek(-1, io.SEEK_CUR)
    return _read_record(file)


def _read_record(file: BinaryIO) -> tuple[Fields, bytes]:
    return _fields(_sized(file)), _sized(file)


def _sized(file: BinaryIO) -> bytes:
    """Bytes behind their number."""
    (size,) = struct.unpack("<L", read_exactly(file, 4))
    return read_exactly(file, size)


def _fields(data: bytes) -> Fields:
    """The fields `name=value` of a header, each behind its length."""
    fields, file = {}, io.BytesIO(data)
    while file.tell() < len(data):
        name, _, value = _sized(file).partition(b"=")
        fields[name] = value
    return fields
