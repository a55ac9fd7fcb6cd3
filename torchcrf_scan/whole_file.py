"""Atomic writing of files: to a temporary file in the same folder, flushed to the disk, then renamed."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO


@contextmanager
def whole_file(path: Path) -> Iterator[BinaryIO]:
    """A file that takes the place of `path` when the block ends: for content that comes piece by piece.

    If the block ends with an error, or the process is killed, the old content is kept.

    Raises:
        OSError: the file could not be written.
    """
    temporary = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        with temporary.open("wb") as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, path)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise
    folder = os.open(path.parent, os.O_RDONLY)
    try:
        os.fsync(folder)  # makes the rename durable, not only the content
    finally:
        os.close(folder)


def write_whole(path: Path, content: bytes | str) -> None:
    """Replaces a file by new content atomically: a killed process or a full disk cannot leave it incomplete.

    Raises:
        OSError: the file could not be written; its old content is kept.
    """
    with whole_file(path) as file:
        file.write(content.encode() if isinstance(content, str) else content)
