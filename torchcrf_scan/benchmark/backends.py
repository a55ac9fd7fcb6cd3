"""The ways in which a model can be decoded here."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import replace

from torchcrf_scan.fast.choice import is_numba_installed
from torchcrf_scan.model import JointScanCRF

BACKENDS = ("compiled", "eager")


def installed_backends() -> tuple[str, ...]:
    """Of `BACKENDS`, those that run here."""
    return BACKENDS if is_numba_installed() else ("eager",)


def choose_backends(wanted: Sequence[str]) -> tuple[str, ...]:
    """Those that are wanted, or all that run here where none is named. ValueError for one that does not."""
    there = installed_backends()
    for name in wanted:
        if name not in there:
            raise ValueError(f"--backends: expected some of {', '.join(there)}, got {name}")
    return tuple(wanted) or there


def with_backend(model: JointScanCRF, backend: str) -> JointScanCRF:
    """The same model, decoded by one of `BACKENDS`."""
    other = copy.copy(model)
    other.config = replace(model.config, inference=replace(model.config.inference, backend=backend))
    return other
