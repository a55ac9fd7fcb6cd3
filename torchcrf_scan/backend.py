"""Which code answers: torch, or the same in machine code (`torchcrf_scan.compiled`)."""

from __future__ import annotations

from functools import cache
from importlib.util import find_spec

import torch
from torch import Tensor

from torchcrf_scan.config import ModelConfig

COMPILED_SETTINGS = {  # of `InferenceConfig` and `ModelConfig`: what the compiled decoding knows
    "candidate_search": ("motion",),
    "schedule": ("sweep",),
    "temperature": (0.0,),
    "motion_weights": ("hard",),
    "chains": ("joint",),
    "coupling": ("motions",),
}


@cache
def is_numba_installed() -> bool:
    """Whether the extra `fast` is there."""
    return find_spec("numba") is not None


def can_search(backend: str, points: Tensor) -> bool:
    """Whether compiled code looks for motions (`InitialiseRT`, which has no gradient anyway) in the scans of some tensor.

    Raises:
        ValueError: `backend` asks for it and it is impossible.
    """
    return _decide(backend, _why_not_here(points))


def can_decode(model: ModelConfig, points: Tensor, *, needs_gradient: bool, has_embeddings: bool = False) -> bool:
    """Whether compiled code decodes a model; arguments and errors as in `can_search`.

    has_embeddings: some were given, or the model's encoder makes them.
    """
    inference = model.inference
    chosen = {name: getattr(inference if hasattr(inference, name) else model, name) for name in COMPILED_SETTINGS}
    unknown = [f"{name}: {chosen[name]}" for name, known in COMPILED_SETTINGS.items() if chosen[name] not in known]
    reason = _why_not_here(points)
    if model.features.smooth > 0:
        unknown.append(f"smooth: {model.features.smooth}")
    if unknown:
        reason = f"settings that it knows, got {', '.join(unknown)}"
    elif has_embeddings:
        reason = "no embeddings, got some (backend eager or auto takes them)"
    elif needs_gradient:
        reason = "no gradient to be asked for (torch.no_grad)"
    return _decide(inference.backend, reason)


def _why_not_here(points: Tensor) -> str | None:
    """What compiled code would need, where it cannot run."""
    if torch.compiler.is_compiling():
        return "an ordinary call, not a compiled or exported one"
    if not is_numba_installed():
        return "numba (pip install torchcrf-scan[fast])"
    return f"scans on the CPU, got {points.device}" if points.device.type != "cpu" else None


def _decide(backend: str, reason: str | None) -> bool:
    if backend == "compiled" and reason is not None:
        raise ValueError(f"backend: expected for compiled {reason}")
    return backend != "eager" and reason is None
