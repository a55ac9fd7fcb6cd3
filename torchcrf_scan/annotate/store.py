"""The folder of annotations: a pair file for each pair, its older versions, and which pairs are done.

NAME.npz                  the newest annotation
versions/NAME/00001.npz   older ones, the oldest first
progress.json             seconds spent on every pair, and the pairs done in their order
"""

from __future__ import annotations

import json
import logging
import os
import shutil
from dataclasses import asdict, dataclass, field
from pathlib import Path

from torchcrf_scan.data.pair_file import read_pair, write_pair
from torchcrf_scan.scan import ScanPair
from torchcrf_scan.whole_file import whole_file, write_whole

logger = logging.getLogger(__name__)


@dataclass
class Progress:
    """seconds: spent on every pair by name. done: names of the pairs done, in their order."""

    seconds: dict[str, float] = field(default_factory=dict)
    done: list[str] = field(default_factory=list)


@dataclass(frozen=True, slots=True)
class Store:
    """A folder of annotations; it must be there."""

    folder: Path

    def path(self, name: str) -> Path:
        """The file of a pair."""
        return self.folder / f"{name}.npz"

    def versions(self, name: str) -> list[Path]:
        """Older versions of a pair's file, the oldest first."""
        return sorted((self.folder / "versions" / name).glob("*.npz"))

    def read(self, name: str) -> ScanPair | None:
        """The newest valid version of an annotated pair; None: there is none."""
        for path in (self.path(name), *reversed(self.versions(name))):
            try:
                return read_pair(path)
            except FileNotFoundError:
                continue
            except ValueError as error:
                logger.warning("left out, an older version counts: %s", error)
        return None

    def write(self, name: str, pair: ScanPair) -> None:
        """Replaces the file of a pair and keeps the old one as a version.

        Raises:
            OSError: the file could not be written, the old one stays.
            ValueError: a pair that no file can hold.
        """
        if self.path(name).exists():
            self._keep(name)
        write_pair(self.path(name), pair)

    def _keep(self, name: str) -> None:
        path, versions = self.path(name), self.versions(name)
        if versions and versions[-1].samefile(path):  # the write after it failed
            return
        number = int(versions[-1].stem) + 1 if versions else 1
        kept = self.folder / "versions" / name / f"{number:05d}.npz"
        kept.parent.mkdir(parents=True, exist_ok=True)
        try:
            os.link(path, kept)
        except OSError:  # a file system without links
            with path.open("rb") as old, whole_file(kept) as new:
                shutil.copyfileobj(old, new)

    def read_progress(self) -> Progress:
        """What has been done in this folder; nothing, if that cannot be read."""
        path = self.folder / "progress.json"
        try:
            found = json.loads(path.read_bytes())
            return Progress({str(k): float(v) for k, v in found["seconds"].items()}, [str(name) for name in found["done"]])
        except FileNotFoundError:
            return Progress()
        except (ValueError, KeyError, TypeError, AttributeError) as error:
            logger.warning("%s: expected seconds and done, got %r; nothing counts as done", path, error)
            return Progress()

    def write_progress(self, progress: Progress) -> None:
        """Raises OSError if it could not be written."""
        write_whole(self.folder / "progress.json", json.dumps(asdict(progress)))
