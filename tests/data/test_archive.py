"""Archives of arrays that are refused before they are unpacked."""

import io
import struct
import tracemalloc
import zipfile
from pathlib import Path

import numpy as np
import pytest

from torchcrf_scan.data.archive import ZIP, read_arrays
from torchcrf_scan.data.limits import MOST_ARCHIVE


def head_of(shape: tuple[int, ...], form: str = "<f8") -> bytes:
    text = f"{{'descr': '{form}', 'fortran_order': False, 'shape': {shape}, }}"
    text += " " * (-(len(text) + 11) % 64) + "\n"
    return b"\x93NUMPY\1\0" + struct.pack("<H", len(text)) + text.encode()


def save(folder: Path, content: bytes) -> Path:
    with zipfile.ZipFile(folder / "a.npz", "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("a.npy", content)
    return folder / "a.npz"


@pytest.mark.parametrize(
    "array", [np.zeros((0, 3)), np.arange(6.0).reshape(2, 3).T, np.float64(3), np.array("text"), np.array([True])]
)
def test_arrays_come_back(tmp_path: Path, array: np.ndarray) -> None:
    np.savez_compressed(tmp_path / "a.npz", a=array, other=np.zeros(3))
    found = read_arrays(tmp_path / "a.npz", ("a", "missing"))
    assert list(found) == ["a"]
    np.testing.assert_array_equal(found["a"], array)
    assert found["a"].dtype == np.asarray(array).dtype


def test_a_bomb_is_refused_unread(tmp_path: Path) -> None:
    count = 10_000_000
    path = save(tmp_path, head_of((count,)) + bytes(8 * count))
    tracemalloc.start()
    with pytest.raises(ValueError, match=r"a\.npz: expected .*a of 80000128 bytes, more than"):
        read_arrays(path, ("a",))
    assert tracemalloc.get_traced_memory()[1] < 2_000_000
    tracemalloc.stop()


def test_a_directory_too_large_to_hold_is_not_read(tmp_path: Path) -> None:
    with (tmp_path / "a.npz").open("wb") as file:
        file.write(ZIP)
        file.truncate(MOST_ARCHIVE + 1)  # without a block on the disk
    with pytest.raises(ValueError, match=rf"a\.npz: expected at most {MOST_ARCHIVE} bytes, got {MOST_ARCHIVE + 1}"):
        read_arrays(tmp_path / "a.npz", ("a",))


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (head_of((10**12,)), "a of 8000000000000 bytes"),
        (head_of((3,)) + bytes(16), "not of 24 bytes, as its header says"),
        (head_of((3,)) + bytes(32), "not of 24 bytes, as its header says"),
        (head_of((1,), "|O") + bytes(8), "array of objects"),
        (b"\x93NUMPY\7\0" + bytes(100), "version"),
        (b"no array", "magic"),
    ],
)
def test_what_a_header_says_is_checked(tmp_path: Path, content: bytes, message: str) -> None:
    with pytest.raises(ValueError, match=message) as error:
        read_arrays(save(tmp_path, content), ("a",))
    assert "pickle" not in str(error.value)


def test_another_kind_of_file_is_told(tmp_path: Path) -> None:
    path = tmp_path / "run.npz"
    array = io.BytesIO()
    np.save(array, np.zeros(3))
    for content in (b"", b"FLASER 1 1.0", array.getvalue()):
        path.write_bytes(content)
        with pytest.raises(ValueError, match=r"run\.npz: expected a complete \.npz archive, got another kind of file$"):
            read_arrays(path, ("a",))
