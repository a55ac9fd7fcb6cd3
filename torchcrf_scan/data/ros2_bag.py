"""Bags of ROS 2: a database of SQLite, or a folder with `metadata.yaml` and databases or MCAP files."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from contextlib import closing
from dataclasses import replace
from pathlib import Path, PurePath
from typing import TYPE_CHECKING

import yaml

from torchcrf_scan.data.bag_records import Bag, Message, Topic
from torchcrf_scan.data.bounded_yaml import read_yaml
from torchcrf_scan.data.limits import MOST_CHUNK
from torchcrf_scan.data.mcap_bag import MAGIC, McapBag
from torchcrf_scan.errors import TorchCRFScanError

if TYPE_CHECKING:
    import sqlite3

SQLITE = b"SQLite format 3\0"
METADATA = "metadata.yaml"
SUFFIXES = (".mcap", ".db3")  # of the files in a folder that lacks it


class SqliteBag:
    """A database of messages."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def _open(self) -> closing[sqlite3.Connection]:
        import sqlite3  # some Pythons have none

        base = sqlite3.connect(f"{self.path.resolve().as_uri()}?mode=ro&immutable=1", uri=True)
        base.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, MOST_CHUNK)
        return closing(base)

    def topics(self) -> list[Topic]:
        """The topics of the database. Raises TorchCRFScanError if it cannot be read."""
        with self._open() as base:
            try:
                _check_tables(base)
                definitions = self._definitions(base)
                known = "SELECT CAST(name AS TEXT), CAST(type AS TEXT) FROM topics WHERE name NOTNULL AND type NOTNULL ORDER BY id"
                rows = base.execute(known).fetchall()
            except (base.Error, ValueError, AttributeError) as error:
                raise TorchCRFScanError(f"{self.path}: expected a database with topics, got {error}") from error
        return [Topic(name, kind, *definitions.get(kind, ("", False))) for name, kind in rows]

    def _definitions(self, base: sqlite3.Connection) -> dict[str, tuple[str, bool]]:
        """Type -> its definition and whether that is IDL; older databases hold none."""
        if not base.execute("SELECT 1 FROM sqlite_master WHERE name = 'message_definitions'").fetchone():
            return {}
        rows = base.execute("SELECT topic_type, encoded_message_definition, encoding FROM message_definitions")
        return {kind: (text, encoding.endswith("idl")) for kind, text, encoding in rows}

    def messages(self, names: Collection[str]) -> Iterator[Message]:
        """The messages of some topics as recorded.

        Raises:
            TorchCRFScanError: a damaged or cut database, with the row, after all messages before it.
        """
        topics = {topic.name: topic for topic in self.topics()}
        stored = "messages.id, CAST(name AS TEXT), CAST(timestamp AS INTEGER), CAST(data AS BLOB)"
        query = f"SELECT {stored} FROM messages JOIN topics ON topics.id = topic_id ORDER BY messages.id"
        row = 0
        with self._open() as base:
            try:
                for row, name, stamp, data in base.execute(query):
                    if name in names:
                        yield Message(topics[name], 1e-9 * stamp, data, f"{self.path}, row {row}")
            except (base.Error, TypeError) as error:
                raise TorchCRFScanError(f"{self.path}, behind row {row}: expected a whole database, got {error}") from error


def _check_tables(base: sqlite3.Connection) -> None:
    """Raises TorchCRFScanError for views and triggers: a bag has none, and they may compute for ever."""
    found = base.execute("SELECT name FROM sqlite_master WHERE type NOT IN ('table', 'index')").fetchone()
    if found:
        raise TorchCRFScanError(f"the view or trigger {found[0]!r}")


class FolderBag:
    """A folder of ROS 2: its files one after the other, as `metadata.yaml` lists them; without it, by name.

    Raises:
        TorchCRFScanError: damaged metadata, files that are missing, of another format, or packed as a whole.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        names, mode = _listed(path) if (path / METADATA).is_file() else (sorted(file.name for file in _bags_in(path)), "none")
        if mode not in ("none", "", "message"):
            raise TorchCRFScanError(f"{path}: expected messages packed one by one or not at all, got files packed by {mode}")
        self._is_packed = mode == "message"
        self._parts = [_part(path / name) for name in names]

    def topics(self) -> list[Topic]:
        """The topics of all files."""
        return list({topic.name: topic for part in self._parts for topic in part.topics()}.values())

    def messages(self, names: Collection[str]) -> Iterator[Message]:
        """The messages of some topics as recorded; raises TorchCRFScanError at a fault, as its files do."""
        for part in self._parts:
            for message in part.messages(names):
                yield replace(message, is_packed=self._is_packed)


def is_folder_bag(path: Path) -> bool:
    """Whether a folder is a bag: it has metadata, or what a recorder leaves that was killed before it wrote them."""
    return path.is_dir() and ((path / METADATA).is_file() or any(_bags_in(path)))


def _listed(path: Path) -> tuple[list[str], str]:
    """Files and kind of packing by the metadata of a folder."""
    try:
        told = read_yaml(path / METADATA)["rosbag2_bagfile_information"]
        return [PurePath(name).name for name in told["relative_file_paths"]], (told.get("compression_mode") or "none").lower()
    except (OSError, yaml.YAMLError, KeyError, TypeError, AttributeError, ValueError) as error:
        raise TorchCRFScanError(f"{path / METADATA}: expected a list of files, got {type(error).__name__}: {error}") from error


def _bags_in(path: Path) -> Iterator[Path]:
    return (file for file in path.iterdir() if file.suffix in SUFFIXES and file.is_file())


def _part(path: Path) -> Bag:
    try:
        with open(path, "rb") as file:
            head = file.read(len(SQLITE))
    except OSError as error:
        raise TorchCRFScanError(f"{path}: expected the file that {METADATA} lists, got {error}") from error
    if head.startswith(MAGIC):
        return McapBag(path)
    if head == SQLITE:
        return SqliteBag(path)
    raise TorchCRFScanError(f"{path}: expected a database of SQLite or MCAP, got another format")
