"""Where machine code lies, and how it is loaded: extension modules that `torchcrf-scan prepare` builds, one for each part.

    PART-DIGEST-LEVEL.TAG.so      the extension; DIGEST: of the sources that it depends on, LEVEL: what processors it runs on
    PART-DIGEST-LEVEL.TAG.json    its entries with the layouts of their arguments, and the checksum of the extension

They lie beside the modules or, where nothing can be written there, in the user's cache, in a folder for each installed copy.
"""

from __future__ import annotations

import hashlib
import json
import logging
import os
import platform
import re
import time
from collections.abc import Callable, Iterable
from functools import cache
from importlib.machinery import EXTENSION_SUFFIXES, ExtensionFileLoader
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
from threading import Lock
from types import ModuleType
from typing import Any, NamedTuple

from torchcrf_scan.errors import TorchCRFScanError
from torchcrf_scan.loops.background import Background

PACKAGE = Path(__file__).parents[1]
NAME = "machine"  # of every extension module: of one name, they share what pycc links to each
PARTS: dict[str, tuple[str, ...]] = {  # the modules whose entries each extension holds; what takes longest comes first
    "rounds": ("fast/decode.py", "fast/rounds.py"),
    "adjoint": ("adjoint/rounds.py",),
    "pool": ("search/pool.py", "search/background.py", "search/cold.py"),
    "survey": (
        "search/surface.py",
        "search/grid.py",
        "search/leftover.py",
        "search/sides.py",
        "search/unobserved.py",
        "search/hypotheses.py",
        "loops/shape.py",
    ),
    "choice": ("search/hypothesis_features.py", "search/accept.py", "search/choose.py"),
    "answer": ("loops/candidates.py", "loops/chains.py", "fast/uncertainty.py", "encoder/aligned_loops.py"),
}
COMPILER = ("prepare/extension.py", "prepare/record.py")  # its flags, and the types that it is given
CALLER = ("loops/jit.py", "loops/machine.py")  # what calls machine code is not compiled into it
IMPORT = re.compile(rb"^\s*from torchcrf_scan\.([\w.]+) import", re.MULTILINE)
SECONDS_BETWEEN_LOOKS = 1.0

log = logging.getLogger(__name__)


class Code(NamedTuple):
    """One entry's machine code and the layouts of its arguments, see `loops.layout`."""

    code: Callable[..., Any]
    layouts: list[Any]


def processor_level() -> str:
    """What this machine's processor can do: a level of x86-64, or `generic` elsewhere."""
    import torch

    if platform.machine().lower() not in ("x86_64", "amd64"):
        return "generic"
    return "x86-64-v3" if torch.backends.cpu.get_cpu_capability() in ("AVX2", "AVX512") else "x86-64-v2"


def folders() -> list[Path]:
    """Where machine code may lie, the first choice first."""
    own = hashlib.sha256(str(PACKAGE).encode()).hexdigest()[:16]
    user = Path(os.environ.get("XDG_CACHE_HOME") or Path("~/.cache").expanduser())
    return [PACKAGE / "machine", user / "torchcrf_scan" / own]


def writable_folder() -> Path:
    """The first folder that can be written.

    Raises:
        OSError: none can.
    """
    for folder in folders():
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError:
            continue
        if os.access(folder, os.W_OK):
            return folder
    raise OSError(f"expected a folder for machine code that can be written, got {', '.join(map(str, folders()))}")


@cache
def stem(part: str, level: str) -> str:
    """The name of a part's files without their suffix, at the present state of its sources."""
    return f"{part}-{digest_of(PARTS[part])}-{level}"


def digest_of(modules: Iterable[str]) -> str:
    """Of some modules and all of the package that they import: their constants are in the machine code."""
    waiting, seen = list(modules), set(CALLER)
    digest = hashlib.sha256(b"".join((PACKAGE / name).read_bytes() for name in COMPILER))
    while waiting:
        name = waiting.pop()
        if name not in seen and (PACKAGE / name).is_file():
            seen.add(name)
            source = (PACKAGE / name).read_bytes()
            digest.update(name.encode() + source)
            waiting += [f"{found.decode().replace('.', '/')}.py" for found in IMPORT.findall(source)]
    return digest.hexdigest()[:16]


def library(folder: Path, part: str, level: str) -> Path:
    """The file of a part's extension."""
    return folder / (stem(part, level) + EXTENSION_SUFFIXES[0])


def is_there(part: str, level: str) -> bool:
    """Whether a part has been built for a level."""
    return any(library(folder, part, level).with_suffix(".json").is_file() for folder in folders())


def part_of(name: str) -> str | None:
    """The part that holds an entry's machine code."""
    module = name.rpartition(".")[0].replace(".", "/") + ".py"
    return next((part for part, modules in PARTS.items() if module in modules), None)


def missing(level: str) -> list[str]:
    """The parts that are not built."""
    return [part for part in PARTS if not is_there(part, level)]


def load(part: str, level: str) -> dict[str, Code] | None:
    """The entries of a part; None where it has not been built, or is damaged: then its files are set aside."""
    for folder in folders():
        path = library(folder, part, level)
        try:
            told = json.loads(path.with_suffix(".json").read_bytes())
            if hashlib.sha256(path.read_bytes()).hexdigest() != told["sha256"]:
                raise TorchCRFScanError("not what was written")
            extension = _import(path, part)
            return {name: Code(getattr(extension, symbol(name)), layouts) for name, layouts in told["entries"].items()}
        except FileNotFoundError:
            continue
        except (OSError, ValueError, KeyError, TypeError, AttributeError, ImportError) as error:
            log.warning("machine code is damaged and set aside, %s.damaged: %s", path, error)
            _set_aside(path)
    return None


def symbol(name: str) -> str:
    """An entry's name in an extension."""
    return name.replace(".", "__")


def _import(path: Path, part: str) -> ModuleType:
    name = f"{__name__}.{part}.{NAME}"
    spec = spec_from_file_location(name, path, loader=ExtensionFileLoader(name, str(path)))
    assert spec is not None
    assert spec.loader is not None
    module = module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def _set_aside(path: Path) -> None:
    for file in (path.with_suffix(".json"), path):
        try:
            os.replace(file, f"{file}.damaged")
        except OSError as error:
            log.debug("cannot set aside %s: %s", file, error)


class Store:
    """The machine code of this process, which comes as it is built. `NUMBA_DISABLE_JIT=1`: none."""

    def __init__(self) -> None:
        self.entries: dict[str, Code] = {}
        self.waiting = set[str]() if os.environ.get("NUMBA_DISABLE_JIT", "0") not in ("", "0") else set(PARTS)
        self.next_look = 0.0
        self.lock = Lock()
        self.background = Background()

    def find(self, name: str) -> Code | None:
        """An entry's machine code; looks for new extensions at most once a second."""
        if name not in self.entries and self.waiting and time.monotonic() >= self.next_look:
            with self.lock:
                if time.monotonic() >= self.next_look:
                    self._look()
                    self.next_look = time.monotonic() + SECONDS_BETWEEN_LOOKS
        return self.entries.get(name)

    def _look(self) -> None:
        level = processor_level()
        for part in sorted(self.waiting):
            found = load(part, level)
            if found is not None:
                self.entries |= found
                self.waiting.discard(part)
        if not self.waiting:
            self.background.complete()
            return
        try:
            self.background.care(writable_folder())
        except OSError as error:
            log.debug("no background build: %s", error)

    def unlock(self) -> None:
        """In a forked child, where the thread that held the lock does not exist."""
        self.lock = Lock()


STORE = Store()
find = STORE.find
if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=STORE.unlock)
