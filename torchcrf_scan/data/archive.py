"""Arrays of an `.npz` archive, read only after its directory and their headers say that they are small enough."""

from __future__ import annotations

import os
import zipfile
from collections.abc import Sequence
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.lib import format as npy
from numpy.typing import NDArray

from torchcrf_scan.data.limits import MOST_ARCHIVE, MOST_ARRAY
from torchcrf_scan.errors import TorchCRFScanError

ZIP = b"PK\x03\x04"


def read_arrays(path: Path, keys: Sequence[str]) -> dict[str, NDArray[Any]]:
    """The arrays of those keys that an archive holds.

    Raises:
        TorchCRFScanError: another format, a damaged or cut archive, one beyond `MOST_ARCHIVE`, an array of objects or beyond
            `MOST_ARRAY`.
        OSError: the file cannot be opened.
    """
    with open(path, "rb") as file:
        if file.read(len(ZIP)) != ZIP:
            raise TorchCRFScanError(f"{path}: expected a complete .npz archive, got another kind of file")
        if (size := os.fstat(file.fileno()).st_size) > MOST_ARCHIVE:
            raise TorchCRFScanError(f"{path}: expected at most {MOST_ARCHIVE} bytes, got {size}")
        try:
            with zipfile.ZipFile(file) as archive:
                held = {name.removesuffix(".npy") for name in archive.namelist() if name.endswith(".npy")}
                return {key: _read(archive, key) for key in keys if key in held}
        except Exception as error:  # of zipfile, zlib and numpy, for damaged files
            got = f"{type(error).__name__}: {error}"
            raise TorchCRFScanError(f"{path}: expected a complete .npz archive without object arrays, got {got}") from error


def _read(archive: zipfile.ZipFile, key: str) -> NDArray[Any]:
    stated = archive.getinfo(f"{key}.npy").file_size
    if stated > MOST_ARRAY:
        raise TorchCRFScanError(f"{key} of {stated} bytes, more than {MOST_ARRAY}")
    with archive.open(f"{key}.npy") as file:
        shape, in_columns, dtype = _read_header(file)
        if dtype.hasobject:
            raise TorchCRFScanError(f"{key} is an array of objects")
        size = int(np.prod(shape, dtype=object)) * dtype.itemsize
        if size > MOST_ARRAY:
            raise TorchCRFScanError(f"{key} of {size} bytes, more than {MOST_ARRAY}")
        data = file.read(size)
        if len(data) != size or file.read(1):
            raise TorchCRFScanError(f"{key} is not of {size} bytes, as its header says")
    array = np.frombuffer(data, dtype=dtype)
    return array.reshape(shape[::-1]).T if in_columns else array.reshape(shape)


def _read_header(file: IO[bytes]) -> tuple[tuple[int, ...], bool, np.dtype]:
    version = npy.read_magic(file)
    readers = {(1, 0): npy.read_array_header_1_0, (2, 0): npy.read_array_header_2_0}
    if version not in readers:
        raise TorchCRFScanError(f"an array of version {version}, expected 1.0 or 2.0")
    shape, in_columns, dtype = readers[version](file)
    return shape, in_columns, dtype
