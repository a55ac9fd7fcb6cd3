"""Checks that the tensors given to the model fit: each error names the argument, what was expected, and what was given."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import AbstractContextManager, nullcontext
from typing import Any

import torch
from torch import Tensor

from torchcrf_scan.batch import ScanPairBatch
from torchcrf_scan.errors import TorchCRFScanError
from torchcrf_scan.features.learned import ExtraLogUnary
from torchcrf_scan.inference.pseudo_likelihood import PlugIns
from torchcrf_scan.inference.start import Start

Layout = Mapping[str, tuple[tuple[str | int, ...], torch.dtype | None]]  # by field: axes and dtype; None: that of the points

BATCH: Layout = {
    "source": (("B", "N", 2), None),
    "target": (("B", "M", 2), None),
    "source_mask": (("B", "N"), torch.bool),
    "target_mask": (("B", "M"), torch.bool),
    "source_closed": (("B",), torch.bool),
    "target_closed": (("B",), torch.bool),
    "dt": (("B",), None),
    "range_noise": (("B",), None),
    "initial_motion": (("B", 3), None),
    "target_origin": (("B", 2), None),
}
TRUTH: Layout = {
    "association": (("B", "N"), torch.int64),
    "cluster": (("B", "N"), torch.int64),
    "motions": (("B", "G", 3), None),
    "known": (("B", "N"), torch.bool),
}
START: Layout = {
    "motions": (("B", "C", 3), None),
    "active": (("B", "C"), torch.bool),
    "association": (("B", "N"), torch.int64),
    "target_tangents": (("B", "M", 2), None),
    "reach": (("B", "N", "C"), None),
    "log_odds": (("B", "C"), None),
}
PLUGINS: Layout = {
    "motions": (("B", "C", 3), None),
    "active": (("B", "C"), torch.bool),
    "association": (("B", "N"), torch.int64),
    "cluster": (("B", "N"), torch.int64),
    "label": (("B", "N"), torch.int64),
    "known": (("B", "N"), torch.bool),
    "reach": (("B", "N", "C"), None),
}
EXTRA: Layout = {"outlier": (("B", "N"), None), "moving": (("B", "N"), None)}


def check_batch(batch: ScanPairBatch, weight: Tensor) -> None:
    """Raises TorchCRFScanError unless the batch's tensors fit each other, and a weight of the model in dtype and device."""
    sizes = check_fields("batch.", batch, BATCH, {}, weight)
    if batch.truth is not None:
        check_fields("batch.truth.", batch.truth, TRUTH, sizes, weight)


def check_start(start: Start, batch: ScanPairBatch) -> None:
    """Raises TorchCRFScanError unless the start fits the batch."""
    check_fields("start.", start, START, sizes_of(batch), batch.source)


def check_plugins(plugins: PlugIns, batch: ScanPairBatch) -> None:
    """Raises TorchCRFScanError unless the plug-ins of the pseudo-likelihood fit the batch."""
    check_fields("plugins.", plugins, PLUGINS, sizes_of(batch), batch.source)


def check_inputs(batch: ScanPairBatch, extra: ExtraLogUnary, embeddings: tuple[Tensor | None, Tensor | None]) -> None:
    """Raises TorchCRFScanError unless the optional inputs of `forward` fit the batch; under autocast they may have its dtype."""
    check_fields("extra_log_unary.", extra, EXTRA, sizes_of(batch), batch.source, is_learned=True)
    for name, axis, value in zip(("source_embedding", "target_embedding"), "NM", embeddings, strict=True):
        if value is not None:
            check_tensor(name, value, ("B", axis, "C"), None, sizes_of(batch), batch.source, is_learned=True)


def sizes_of(batch: ScanPairBatch) -> dict[str, int]:
    """The batch's B, N and M."""
    return {"B": batch.source.shape[0], "N": batch.source.shape[1], "M": batch.target.shape[1]}


def check_fields(
    prefix: str, given: Any, layout: Layout, sizes: Mapping[str, int], like: Tensor, *, is_learned: bool = False
) -> dict[str, int]:
    """Checks the fields of a dataclass that are not None; returns `sizes` with those of the axes met first here."""
    found = dict(sizes)
    for name, (axes, dtype) in layout.items():
        value = getattr(given, name)
        if value is not None:
            check_tensor(f"{prefix}{name}", value, axes, dtype, found, like, is_learned=is_learned)
            found |= {axis: size for axis, size in zip(axes, value.shape, strict=True) if isinstance(axis, str)}
    return found


def check_tensor(
    name: str,
    value: Tensor,
    axes: tuple[str | int, ...],
    dtype: torch.dtype | None,
    sizes: Mapping[str, int],
    like: Tensor,
    *,
    is_learned: bool = False,
) -> None:
    """Raises TorchCRFScanError unless a tensor has the shape, dtype (None: that of `like`) and device expected.

    Args:
        axes: sizes, or names of axes; a name without an entry in `sizes` is any size.
        is_learned: the output of a network, which under autocast may have autocast's dtype.
    """
    wanted = tuple(sizes.get(axis, axis) if isinstance(axis, str) else axis for axis in axes)
    is_alike = value.dim() == len(wanted) and all(isinstance(w, str) or w == n for w, n in zip(wanted, value.shape, strict=True))
    if not is_alike:
        raise TorchCRFScanError(f"{name}: expected shape {wanted}, got {tuple(value.shape)}")
    device = like.device.type
    allowed = [like.dtype if dtype is None else dtype]
    if is_learned and _is_in_autocast(device):
        allowed.append(torch.get_autocast_dtype(device))
    if value.dtype not in allowed:
        raise TorchCRFScanError(f"{name}: expected dtype {' or '.join(map(str, allowed))}, got {value.dtype}")
    if value.device != like.device:
        raise TorchCRFScanError(f"{name}: expected device {like.device}, got {value.device}")


def full_precision(device: str) -> AbstractContextManager[object]:
    """Within it autocast is off; nothing where it is off already, so that exported graphs do not name it. device: its type."""
    return torch.autocast(device, enabled=False) if _is_in_autocast(device) else nullcontext()


def _is_in_autocast(device: str) -> bool:
    return torch.amp.is_autocast_available(device) and torch.is_autocast_enabled(device)
