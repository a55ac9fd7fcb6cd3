"""Files written whole: to a temporary file in the same folder, flushed to the disk, then renamed; folders and locks for them.

The temporary file has a name that nobody can guess, and is new: no link is followed.
"""

from __future__ import annotations

import os
import secrets
import shutil
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import BinaryIO

from torchcrf_scan.errors import TorchCRFScanError


@contextmanager
def whole_file(path: Path) -> Iterator[BinaryIO]:
    """A file that takes the place of `path` when the block ends: for content that comes piece by piece.

    If the block ends with an error, or the process is killed, the old content is kept.

    Raises:
        OSError: the file could not be written.
    """
    temporary = _beside(path)
    with naming(path):
        try:
            with temporary.open("xb") as file:
                yield file
                file.flush()
                os.fsync(file.fileno())
            os.replace(temporary, path)
        except BaseException:
            temporary.unlink(missing_ok=True)
            raise
    _sync(path.parent)


@contextmanager
def whole_path(path: Path) -> Iterator[Path]:
    """As `whole_file`, for libraries that write by name: the path of a file or folder of the same name, elsewhere.

    A file takes the place of a file, a folder that of a folder; a folder is never lost to a file.

    Raises:
        OSError: the block wrote nothing there, or it could not be moved; the old content is kept.
    """
    beside = _beside(path)
    beside.mkdir()
    written = beside / path.name
    with naming(path):
        try:
            yield written
            if path.is_dir() and written.is_dir():  # only an empty folder can be replaced
                os.replace(path, beside / f"{path.name}.old")
            os.replace(written, path)
        finally:
            shutil.rmtree(beside)
    _sync(path.parent)


@contextmanager
def naming(path: Path) -> Iterator[None]:
    """An error of a write that does not tell its file, as that of a full disk, tells this file or folder."""
    try:
        yield
    except OSError as error:
        if error.filename is None and error.errno is not None:
            raise OSError(error.errno, error.strerror, str(path)) from error
        raise


def move_whole(path: Path, target: Path) -> None:
    """Moves a file within its file system: it is never in both places. Raises OSError if it could not be moved."""
    os.replace(path, target)
    _sync(target.parent)


def _beside(path: Path) -> Path:
    """A name in the same folder; raises OSError where a device or pipe would be replaced, such as /dev/null by a superuser."""
    if path.exists() and not (path.is_file() or path.is_dir()):
        raise OSError(f"{path}: expected a file to write, got a device or pipe")
    return path.with_name(f".{path.name}.{secrets.token_hex(8)}")


def _sync(folder: Path) -> None:
    """Makes what was renamed in a folder durable, not only its content."""
    number = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(number)
    finally:
        os.close(number)


def write_whole(path: Path, content: bytes | str) -> None:
    """Replaces a file by new content atomically: a killed process or a full disk cannot leave it incomplete.

    Raises:
        OSError: the file could not be written; its old content is kept.
    """
    write_together({path: content})


def write_together(contents: Mapping[Path, bytes | str]) -> None:
    """As `write_whole`, files of a folder that belong together: all are whole on the disk before the first takes its place.

    Raises:
        OSError: one of them could not be written; the old ones are kept.
    """
    beside = {path: _beside(path) for path in contents}
    with ExitStack() as stack:
        for path, temporary in beside.items():
            stack.callback(temporary.unlink, missing_ok=True)
            content = contents[path]
            with naming(path), temporary.open("xb") as file:
                file.write(content.encode() if isinstance(content, str) else content)
                file.flush()
                os.fsync(file.fileno())
        for path, temporary in beside.items():
            os.replace(temporary, path)
    for folder in {path.parent for path in contents}:
        _sync(folder)


def make_folder(option: str, folder: str | Path) -> Path:
    """Creates a folder if necessary; raises TorchCRFScanError, with the name of its option, for one that cannot be."""
    if not str(folder):
        raise TorchCRFScanError(f"{option}: expected a folder, got an empty name")
    try:
        Path(folder).mkdir(parents=True, exist_ok=True)
    except (FileExistsError, NotADirectoryError) as error:
        raise TorchCRFScanError(f"{option}: expected a folder, got {folder}, where a file is in the way") from error
    return Path(folder)


@contextmanager
def alone(lock: Path, *, wait: bool) -> Iterator[bool]:
    """Holds a lock while the block runs, or until this process ends; False: another one has it and is not waited for."""
    try:
        import fcntl
    except ImportError:  # Windows has no such locks
        yield True
        return
    with lock.open("a") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB))
        except BlockingIOError:
            yield False
            return
        yield True
