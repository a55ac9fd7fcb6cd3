"""A file is there whole or not at all, and the one before stays."""

import errno
import os
import resource
from pathlib import Path

import pytest

from torchcrf_scan.whole_file import whole_path, write_whole


def fail(*_: object) -> None:
    raise OSError(errno.ENOSPC, "No space left on device")


@pytest.mark.parametrize("content", ["text, \u00fc", b"bytes"])
def test_what_is_written_takes_the_place_of_what_was_there(content: str | bytes, tmp_path: Path) -> None:
    (tmp_path / "file").write_bytes(b"before")
    write_whole(tmp_path / "file", content)
    assert (tmp_path / "file").read_bytes() == (content.encode() if isinstance(content, str) else content)
    assert [of.name for of in tmp_path.iterdir()] == ["file"]


@pytest.mark.parametrize("call", ["fsync", "replace"])
def test_what_cannot_be_written_leaves_the_file_before(call: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_whole(tmp_path / "file", b"good")
    monkeypatch.setattr(os, call, fail)
    with pytest.raises(OSError, match="No space left on device"):
        write_whole(tmp_path / "file", b"other")
    assert (tmp_path / "file").read_bytes() == b"good"
    assert [of.name for of in tmp_path.iterdir()] == ["file"]


def test_a_file_too_large_in_earnest(tmp_path: Path) -> None:
    path = tmp_path / "file"
    write_whole(path, b"good")
    least, most = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (50_000, most))
    try:
        with pytest.raises(OSError, match=r"File too large: '.*file'$"):
            write_whole(path, b"x" * 100_000)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (least, most))
    assert path.read_bytes() == b"good"
    assert [of.name for of in tmp_path.iterdir()] == ["file"]


def test_a_pipe_or_device_is_not_replaced(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(OSError, match="pipe: expected a file to write, got a device or pipe"):
        write_whole(tmp_path / "pipe", b"x")
    with pytest.raises(OSError, match="got a device or pipe"), whole_path(tmp_path / "pipe"):
        pass
    assert (tmp_path / "pipe").is_fifo()
    assert [of.name for of in tmp_path.iterdir()] == ["pipe"]


def test_a_folder_takes_the_place_of_a_folder_alone(tmp_path: Path) -> None:
    folder = tmp_path / "folder"
    folder.mkdir()
    (folder / "precious").write_text("as it was")
    with pytest.raises(IsADirectoryError), whole_path(folder) as path:
        path.write_text("a file")
    with pytest.raises(FileNotFoundError), whole_path(folder):
        pass  # nothing is written
    assert (folder / "precious").read_text() == "as it was"
    with whole_path(folder) as path:
        path.mkdir()
        (path / "new").write_text("new")
    assert [of.name for of in folder.iterdir()] == ["new"]
    assert [of.name for of in tmp_path.iterdir()] == ["folder"]


def test_a_full_disk_is_told_with_the_file_of_a_library_too(tmp_path: Path) -> None:
    with pytest.raises(OSError, match=r"No space left on device: '.*/run\.bag'"), whole_path(tmp_path / "run.bag"):
        fail()
    assert not list(tmp_path.iterdir())
