"""The sequences that a model was trained on, recorded beside its weights, and the check that none of them is tested.

A sequence is known by its name. Simulated ones are named by their seed: worlds of the same seed share their random draws, so they
count as the same whatever the world. Pairs that are simulated during the steps have seeds of their own and are not recorded.
"""

from __future__ import annotations

import json
import logging
from collections.abc import Iterable
from dataclasses import asdict, dataclass
from pathlib import Path

from torchcrf_scan.checks import check_fields, from_values
from torchcrf_scan.errors import TorchCRFScanError
from torchcrf_scan.pretrained import find_weights
from torchcrf_scan.scan import ScanPair
from torchcrf_scan.whole_file import write_whole

log = logging.getLogger(__name__)

RECORD = "trained_on.json"


@dataclass(frozen=True)
class TrainedOn:
    """Sequences that a model was trained on.

    Attributes:
        sequences: their names.
        is_complete: whether these are all; otherwise the model began from weights without a record.
    """

    sequences: tuple[str, ...] = ()
    is_complete: bool = True

    def __post_init__(self) -> None:
        check_fields(self)

    @classmethod
    def of_model(cls, name_or_path: str) -> TrainedOn:
        """The record of a saved model, or of a shipped one by name; an incomplete one is logged. An empty name: nothing.

        Raises:
            TorchCRFScanError: no such model, or a file that is no record.
        """
        if not name_or_path:
            return cls()
        path = find_weights(name_or_path) / RECORD
        try:
            found = from_values(cls, json.loads(path.read_text()), RECORD) if path.is_file() else cls(is_complete=False)
        except (ValueError, RecursionError) as error:
            raise TorchCRFScanError(f"{path}: {error}") from error
        if not found.is_complete:
            log.warning("%s: no complete record of what it was trained on, so a test on the same sequences is not refused", path)
        return found

    def plus(self, pairs: Iterable[ScanPair]) -> TrainedOn:
        """The record of a model that is trained on these pairs too."""
        return TrainedOn(tuple(sorted({*self.sequences, *(pair.sequence for pair in pairs)})), self.is_complete)

    def write(self, folder: Path) -> None:
        """Writes the record into the folder of a saved model, atomically."""
        write_whole(folder / RECORD, json.dumps(asdict(self), indent=1) + "\n")

    def refuse(self, tested: Iterable[ScanPair], setting: str) -> None:
        """Raises TorchCRFScanError if a tested pair is of one of the sequences: their pairs overlap in time.

        setting: the one that names what was trained on.
        """
        both = sorted({*self.sequences} & {pair.sequence for pair in tested})
        if both:
            told = ", ".join(name or "one without a name" for name in both[:5])
            raise TorchCRFScanError(f"{setting}: expected no sequence in both training and test pairs, got {told}")
