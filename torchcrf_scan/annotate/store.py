"""The folder of annotations: pair files that are finished, and aside what is not for training.

NAME.npz                            finished annotations: all that `FOLDER/*` and `FOLDER/**/*.npz` match
.annotate/unfinished/NAME.npz       those begun but not finished; a pair lies in one of both places
.annotate/versions/NAME/00001.npz   older ones, the oldest first
.annotate/progress.json             seconds spent on every pair, and the pairs finished in their order
.annotate/lock                      held by the process that works here
"""

from __future__ import annotations

import json
import logging
import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from pathlib import Path

from torchcrf_scan.data.pair_file import read_pair, write_pair
from torchcrf_scan.errors import TorchCRFScanError
from torchcrf_scan.safe_names import file_name
from torchcrf_scan.scan import ScanPair
from torchcrf_scan.whole_file import alone, move_whole, whole_file, write_whole

logger = logging.getLogger(__name__)


@dataclass
class Progress:
    """seconds: spent on every pair by name. done: names of the pairs finished, in their order."""

    seconds: dict[str, float] = field(default_factory=dict)
    done: list[str] = field(default_factory=list)


@dataclass(frozen=True, slots=True)
class Store:
    """A folder of annotations; it must be there."""

    folder: Path

    @property
    def _aside(self) -> Path:
        return self.folder / ".annotate"

    def finished(self, name: str) -> Path:
        """The file of a pair once it is finished."""
        return self.folder / f"{file_name(name)}.npz"

    def unfinished(self, name: str) -> Path:
        """The file of a pair until then."""
        return self._aside / "unfinished" / f"{file_name(name)}.npz"

    def versions(self, name: str) -> list[Path]:
        """Older versions of a pair's file, the oldest first."""
        return sorted((self._aside / "versions" / file_name(name)).glob("*.npz"))

    @contextmanager
    def alone(self) -> Iterator[None]:
        """Keeps other processes away while the block runs; a killed one keeps nobody away.

        Raises:
            TorchCRFScanError: another process works here.
        """
        self._aside.mkdir(exist_ok=True)
        with alone(self._aside / "lock", wait=False) as is_alone:
            if not is_alone:
                raise TorchCRFScanError(f"{self.folder}: expected nobody at work here, got another `torchcrf-scan annotate`")
            yield

    def read(self, name: str) -> ScanPair | None:
        """The newest valid version of an annotated pair; None: there is none."""
        for path in (self.unfinished(name), self.finished(name), *reversed(self.versions(name))):
            try:
                return read_pair(path)
            except FileNotFoundError:
                continue
            except ValueError as error:
                logger.warning("left out, an older version counts: %s", error)
        return None

    def write(self, name: str, pair: ScanPair) -> None:
        """Replaces the file of a pair, which is unfinished then, and keeps the old one as a version.

        Raises:
            OSError: the file could not be written, the old one stays.
            TorchCRFScanError: a pair that no file can hold.
        """
        path = self.unfinished(name)
        path.parent.mkdir(parents=True, exist_ok=True)
        if self.finished(name).exists():
            move_whole(self.finished(name), path)
        if path.exists():
            self._keep(name)
        write_pair(path, pair)

    def finish(self, name: str) -> None:
        """Puts the file of a pair among those finished; raises OSError if it cannot be moved."""
        if self.unfinished(name).exists():
            move_whole(self.unfinished(name), self.finished(name))

    def _keep(self, name: str) -> None:
        path, versions = self.unfinished(name), self.versions(name)
        if versions and versions[-1].samefile(path):  # the write after it failed
            return
        number = int(versions[-1].stem) + 1 if versions else 1
        kept = self._aside / "versions" / file_name(name) / f"{number:05d}.npz"
        kept.parent.mkdir(parents=True, exist_ok=True)
        try:
            os.link(path, kept)
        except OSError:  # a file system without links
            with path.open("rb") as old, whole_file(kept) as new:
                shutil.copyfileobj(old, new)

    def read_progress(self) -> Progress:
        """What was done here, as far as that can be read; only what lies among the finished counts as done."""
        path, progress = self._aside / "progress.json", Progress()
        try:
            found = json.loads(path.read_bytes())
            progress = Progress({str(k): float(v) for k, v in found["seconds"].items()}, [str(name) for name in found["done"]])
        except FileNotFoundError:
            pass
        except (ValueError, KeyError, TypeError, AttributeError) as error:
            logger.warning("%s: expected seconds and done, got %r; their order is lost", path, error)
        progress.done = [name for name in progress.done if self.finished(name).exists()]
        return progress

    def write_progress(self, progress: Progress) -> None:
        """Writes what was done here; raises OSError if it cannot."""
        self._aside.mkdir(exist_ok=True)
        write_whole(self._aside / "progress.json", json.dumps(asdict(progress)))
