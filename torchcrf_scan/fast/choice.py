"""Choice of the engine of the rounds: the loops (`torchcrf_scan.fast`), or tensors (`torchcrf_scan.inference`)."""

from __future__ import annotations

from collections.abc import Sequence

import torch

from torchcrf_scan.config import ModelConfig
from torchcrf_scan.errors import TorchCRFScanError


def can_run(backend: str, device: torch.device) -> bool:
    """Whether loops can replace tensors without gradient on a device.

    Raises:
        TorchCRFScanError: `backend` is `compiled`, and they cannot.
    """
    return _decide(backend, _why_not_here(device))


def can_decode(
    model: ModelConfig,
    device: torch.device,
    *,
    slopes: Sequence[str] = (),
    has_embeddings: bool = False,
    is_transformed: bool = False,
) -> bool:
    """Whether loops run the rounds of a model; errors as in `can_run`.

    Args:
        slopes: what a gradient is asked for beside weights and extra log potentials, e.g. `batch.source`.
        has_embeddings: some were given, or the model's encoder makes them.
        is_transformed: the call is inside a transform of `torch.func`.
    """
    unknown = [f"{name}: {value}" for name, value in model.without("in_loops").items()]
    reason = _why_not_here(device)
    if model.inference.temperature > 0:
        unknown.append(f"temperature: {model.inference.temperature}")
    if model.features.smooth > 0:
        unknown.append(f"smooth: {model.features.smooth}")
    if unknown:
        reason = f"settings that it knows, got {', '.join(unknown)}"
    elif has_embeddings:
        reason = "no embeddings, got some (backend eager or auto takes them)"
    elif slopes:
        reason = f"no gradient to be asked for by {', '.join(slopes)} (torch.no_grad)"
    elif is_transformed:
        reason = "no call inside a transform of torch.func"
    return _decide(model.inference.backend, reason)


def _why_not_here(device: torch.device) -> str | None:
    """The reason why loops cannot run on a device, or None."""
    if torch.compiler.is_compiling():
        return "an ordinary call, not a compiled or exported one"
    return f"scans on the CPU, got {device}" if device.type != "cpu" else None


def _decide(backend: str, reason: str | None) -> bool:
    if backend == "compiled" and reason is not None:
        raise TorchCRFScanError(f"backend: expected for compiled {reason}")
    return backend != "eager" and reason is None
