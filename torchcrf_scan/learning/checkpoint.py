"""Checkpoints, written atomically, so that a killed process or a full disk cannot damage them."""

from __future__ import annotations

import io
import logging
import random
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from torchcrf_scan.errors import TorchCRFScanError
from torchcrf_scan.model import JointScanCRF
from torchcrf_scan.pretrained import check_weights
from torchcrf_scan.whole_file import write_whole

log = logging.getLogger(__name__)

NAME = "checkpoint.pt"
FORMAT = 1  # version of the file format


@dataclass(slots=True)
class Store:
    """The checkpoint of a run folder.

    Attributes:
        folder: the run folder. settings: by name, those that must be equal when a run is resumed.
        last: step of the last valid checkpoint, None before the first.
    """

    folder: Path
    settings: dict[str, Any]
    last: int | None = None

    @property
    def path(self) -> Path:
        """Path of the checkpoint."""
        return self.folder / NAME

    def write(self, step: int, state: dict[str, Any]) -> bool:
        """Writes a checkpoint; on failure logs a warning, keeps the old one and returns False, so that training can continue."""
        content = io.BytesIO()
        torch.save({"format": FORMAT, "settings": self.settings, "random": random_state(), **state}, content)
        try:
            write_whole(self.path, content.getvalue())
        except OSError as error:
            kept = "there is none before it" if self.last is None else f"that of step {self.last} is kept"
            log.warning("checkpoint of step %d not written, %s: %s", step, kept, error)
            return False
        self.last = step
        return True

    def read(self) -> dict[str, Any] | None:
        """The last valid checkpoint, or None.

        Raises:
            TorchCRFScanError: a checkpoint with other settings, which are listed, or an invalid file.
        """
        for left in self.folder.glob(f".{NAME}.*"):  # of a process that was killed while writing
            left.unlink()
        if not self.path.exists():
            return None
        try:
            state = torch.load(self.path, map_location="cpu", weights_only=True)
            written, settings = state["format"], state["settings"]
        except Exception as error:  # of torch, zipfile and pickle, for damaged files
            raise TorchCRFScanError(f"resume: expected a checkpoint of this program, got {self.path}: {error}") from error
        if written != FORMAT:
            raise TorchCRFScanError(f"resume: expected a checkpoint of format {FORMAT}, got {written}: {self.path}")
        other = [name for name in self.settings if settings.get(name) != self.settings[name]]
        if other:
            told = ", ".join(f"{name} = {self.settings[name]!r} after {settings.get(name)!r}" for name in other[:5])
            raise TorchCRFScanError(f"resume: expected the settings of the run in {self.folder}, got {told}")
        for part in ("model", "best"):
            check_weights(f"resume: {self.path}: {part}", state.get(part) or {})
        self.last = state["step"]
        return dict(state)


def load_weights(model: JointScanCRF, origin: str | JointScanCRF) -> None:
    """Loads the weights of a model, or of a saved one by its folder or name; parts missing there are unchanged.

    Raises:
        TorchCRFScanError: no such model, or one of other features.
    """
    saved = (origin if isinstance(origin, JointScanCRF) else JointScanCRF.from_pretrained(origin)).state_dict()
    fresh = model.optional_state | {name: value for name, value in model.state_dict().items() if name.startswith("encoder.")}
    try:
        model.load_state_dict(fresh | saved)
    except RuntimeError as error:
        raise TorchCRFScanError(f"init: expected a model with the features of `model.features`, got {origin}: {error}") from error


def random_state() -> dict[str, Any]:
    """The states of all global random generators, in types that are safe to load."""
    words = np.random.get_state(legacy=False)
    assert isinstance(words, dict)
    version, numbers, spare = random.getstate()
    state: dict[str, Any] = {
        "torch": torch.get_rng_state(),
        "numpy": {
            **words,
            "state": {"key": torch.from_numpy(words["state"]["key"].astype(np.int64)), "pos": words["state"]["pos"]},
        },
        "python": [version, list(numbers), spare],
    }
    if torch.cuda.is_available():
        state["cuda"] = torch.cuda.get_rng_state_all()
    return state


def set_random_state(state: dict[str, Any]) -> None:
    """Restores the states of all global random generators."""
    torch.set_rng_state(state["torch"])
    words = state["numpy"]
    np.random.set_state({**words, "state": {**words["state"], "key": words["state"]["key"].numpy().astype(np.uint32)}})
    version, numbers, spare = state["python"]
    random.setstate((version, tuple(numbers), spare))
    if "cuda" in state and torch.cuda.is_available():
        torch.cuda.set_rng_state_all(state["cuda"])
