"""How the loops of this package are compiled, and where the machine code is kept."""

from __future__ import annotations

import hashlib
import logging
import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar, cast

import numba
import numpy as np
from numba.core import event
from numpy.typing import NDArray

F = TypeVar("F", bound=Callable[..., Any])
Array = NDArray[np.float64]
Integers = NDArray[np.int64]
Booleans = NDArray[np.bool_]

SAFE_MATH = {"reassoc", "contract", "nsz", "arcp"}  # not those that assume finite numbers: impossible states are -inf
PACKAGE = Path(__file__).parents[1]
SOURCES = ("loops/*.py", "search/*.py", "fast/*.py", "encoder/*.py", "features/*.py", "inference/*.py", "names.py")  # compiled in

log = logging.getLogger(__name__)


def cache_folder() -> str | None:
    """Where machine code is kept; None where nothing can be written, and every process compiles anew.

    A folder for each state of the sources, for numba itself knows when a function has changed, but not what it calls. It lies
    beside the modules, or in the user's cache; `NUMBA_CACHE_DIR` overrules both.
    """
    if numba.config.CACHE_DIR:  # type: ignore[attr-defined]
        return str(numba.config.CACHE_DIR)  # type: ignore[attr-defined]
    digest = hashlib.sha256()
    for path in sorted(path for source in SOURCES for path in PACKAGE.glob(source)):
        digest.update(path.read_bytes())
    for parent in (PACKAGE / "loops" / "__pycache__", Path("~/.cache/torchcrf_scan").expanduser()):
        folder = parent / f"numba-{digest.hexdigest()[:16]}"
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError:
            continue
        if os.access(folder, os.W_OK):
            for old in parent.glob("numba-*"):
                if old != folder:
                    shutil.rmtree(old, ignore_errors=True)
            return str(folder)
    return None


CACHE = cache_folder()


def kernel(function: F) -> F:
    """Compiles a function of numbers and arrays when it is first called, keeps the code on disk and lets other threads run."""
    before = numba.config.CACHE_DIR  # type: ignore[attr-defined]
    numba.config.CACHE_DIR = CACHE or before  # type: ignore[attr-defined]
    try:
        options: dict[str, Any] = {"nogil": True, "error_model": "numpy", "fastmath": SAFE_MATH}
        return cast(F, numba.njit(cache=CACHE is not None, **options)(function))
    finally:
        numba.config.CACHE_DIR = before  # type: ignore[attr-defined]


class _Patience(event.Listener):
    """Says once why the first pair ever takes so long."""

    def on_start(self, event: event.Event) -> None:
        log.warning("compiling the loops for this machine, once: this takes a minute or two")
        numba.core.event.unregister("numba:compile", self)

    def on_end(self, event: event.Event) -> None:
        pass


event.register("numba:compile", _Patience())
