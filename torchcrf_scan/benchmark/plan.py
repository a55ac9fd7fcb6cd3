"""The plan of a benchmark: sizes, backends, pairs and models."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import product
from typing import Any

from torchcrf_scan.benchmark.scenes import MODES, in_mode, street_pairs
from torchcrf_scan.errors import TorchCRFScanError
from torchcrf_scan.model import JointScanCRF, with_config
from torchcrf_scan.scan import ScanPair

CENTRE = 361  # beams of the reference setting
GROWTH = 1.5  # assumed exponent of time over the number of beams, to predict the duration of a call
SIMULATED, RECORDED = "simulated", "recorded"
WHOLE = "whole"  # stage of the rows of whole pairs
BACKENDS = ("compiled", "eager")

Row = dict[str, Any]
Setting = tuple[int, int, int]  # batch, beams, threads


@dataclass(frozen=True, slots=True)
class Plan:
    """Settings of a benchmark.

    Attributes:
        model: name or folder. backends, beams, batches, threads: values of the rows.
        repeats: times that every pair is timed. pairs: simulated pairs of each number of beams. patience: seconds of one call.
        recorded: annotated pairs to time as well. is_full: the reference in all sizes, too.
    """

    model: str
    backends: tuple[str, ...]
    beams: tuple[int, ...]
    batches: tuple[int, ...]
    threads: tuple[int, ...]
    repeats: int
    pairs: int
    patience: float
    recorded: tuple[ScanPair, ...] = ()
    is_full: bool = False

    @property
    def centre(self) -> Setting:
        """The reference setting (batch, beams, threads), from which one value at a time is varied."""
        return min(self.batches), min(self.beams, key=lambda beams: abs(beams - CENTRE)), min(self.threads)


def settings_of(plan: Plan, backend: str) -> list[Setting]:
    """All combinations; for the slow backend `eager` those around the centre."""
    is_slow = backend == "eager" and not plan.is_full
    return around_centre(plan) if is_slow else list(product(plan.batches, plan.beams, plan.threads))


def around_centre(plan: Plan) -> list[Setting]:
    """Settings that differ from the centre in one value."""
    every = product(plan.batches, plan.beams, plan.threads)
    return [one for one in every if sum(a != b for a, b in zip(one, plan.centre, strict=True)) <= 1]


@dataclass(slots=True)
class Material:
    """The pairs and models of a plan, made on demand and cached."""

    plan: Plan
    _pairs: dict[tuple[int, str], list[ScanPair]] = field(default_factory=dict)
    _models: dict[str, JointScanCRF] = field(default_factory=dict)

    def pairs(self, beams: int, mode: str) -> list[ScanPair]:
        """Simulated pairs."""
        if (beams, mode) not in self._pairs:
            made = street_pairs(beams, self.plan.pairs)
            self._pairs.update({(beams, each): in_mode(made, each) for each in MODES})
        return self._pairs[beams, mode]

    def model(self, backend: str) -> JointScanCRF:
        """The model with one backend."""
        if backend not in self._models:
            self._models[backend] = with_backend(JointScanCRF.from_pretrained(self.plan.model), backend)
        return self._models[backend]


def place_of(row: Mapping[str, Any]) -> tuple[Any, ...]:
    """Backend, mode, batch, beams and threads, None for keys missing in the row."""
    return tuple(row.get(key) for key in ("backend", "mode", "batch", "beams", "threads"))


def choose_backends(wanted: Sequence[str]) -> tuple[str, ...]:
    """The backends wanted, by default all. Raises TorchCRFScanError for an unknown one."""
    for name in wanted:
        if name not in BACKENDS:
            raise TorchCRFScanError(f"--backends: expected some of {', '.join(BACKENDS)}, got {name}")
    return tuple(wanted) or BACKENDS


def with_backend(model: JointScanCRF, backend: str) -> JointScanCRF:
    """The same model with one of `BACKENDS`."""
    return with_config(model, replace(model.config, inference=replace(model.config.inference, backend=backend)))
