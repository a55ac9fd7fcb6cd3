"""The unrolled rounds as a program without Python: `torch.export`, and ONNX for other runtimes.

    motions ──► fixed number of rounds ──► labels, motions, beliefs

InitialiseRT has data-dependent control flow and is not exported: initial motions are inputs. For a model without early
stopping, `torch.export.export(model, (batch, start))` works too and returns a full `Prediction`; here inputs and outputs
are plain named tensors, as runtimes need them.
"""

from __future__ import annotations

from contextlib import nullcontext
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn
from torch.export import Dim, ExportedProgram
from torch.overrides import TorchFunctionMode

from torchcrf_scan.batch import ScanPairBatch
from torchcrf_scan.config import ModelConfig
from torchcrf_scan.inference.start import Start
from torchcrf_scan.model import JointScanCRF, with_config
from torchcrf_scan.variants import sweep
from torchcrf_scan.whole_file import whole_path

OPSET = 18  # ONNX opset
FROM_BATCH = (
    *("source", "target", "source_mask", "target_mask", "source_closed", "target_closed"),
    *("range_noise", "initial_motion", "target_origin"),
)
OUTPUTS = (
    *("association", "cluster", "motions", "active", "candidates", "log_association", "log_cluster"),
    *("association_confidence", "cluster_confidence"),
)


class UnrolledDecoder(nn.Module):
    """The model from given initial motions on, as a function of plain tensors; equal to the model's output at that start.

    Args:
        model: its weights are shared; it decodes on tensors (backend `eager`) without early stopping.
        iterations: rounds; None: the model's.
        plain: with `PlainOperators`, for other runtimes.
    """

    def __init__(self, model: JointScanCRF, iterations: int | None = None, *, plain: bool = False) -> None:
        super().__init__()
        self.plain = plain
        self.model = with_config(model, unrolled_config(model.config, iterations))

    def forward(
        self,
        source: Tensor,
        target: Tensor,
        source_mask: Tensor,
        target_mask: Tensor,
        source_closed: Tensor,
        target_closed: Tensor,
        range_noise: Tensor,
        initial_motion: Tensor,
        target_origin: Tensor,
        start_motions: Tensor,
        start_active: Tensor,
        start_association: Tensor | None = None,
        start_target_tangents: Tensor | None = None,
        start_reach: Tensor | None = None,
        start_log_odds: Tensor | None = None,
    ) -> dict[str, Tensor]:
        """The fields `OUTPUTS` of a `Prediction`.

        The first nine inputs are fields of a `ScanPairBatch`, the others those of a `Start`: motions (B, C, 3) and which of them
        exist (B, C), and the remaining fields of a start from InitialiseRT. Without association and tangents these are derived from
        the motions (`Start.at`).
        """
        batch = ScanPairBatch(
            source=source,
            target=target,
            source_mask=source_mask,
            target_mask=target_mask,
            source_closed=source_closed,
            target_closed=target_closed,
            dt=torch.zeros_like(range_noise),  # used by InitialiseRT only
            range_noise=range_noise,
            initial_motion=initial_motion,
            target_origin=target_origin,
        )
        if start_association is None or start_target_tangents is None:
            start = Start.at(batch, start_motions, start_active)
        else:
            start = Start(start_motions, start_active, start_association, start_target_tangents)
        start = replace(start, reach=start_reach, log_odds=start_log_odds)
        with PlainOperators() if self.plain else nullcontext():
            return self._answers(batch, start)

    def _answers(self, batch: ScanPairBatch, start: Start) -> dict[str, Tensor]:
        view = self.model.view(batch, self.model.learned_inputs(batch, start))
        fitted = self.model.fitted
        state = sweep.settle(view, view.in_unit(start), fitted, self.model.config).state
        association_confidence, cluster_confidence = fitted.calibration(state)
        return {
            "association": state.association,
            "cluster": state.cluster,
            "motions": view.in_metres(state.motions.value),
            "active": state.motions.active,
            "candidates": state.candidates,
            "log_association": state.log_association,
            "log_cluster": state.log_cluster,
            "association_confidence": association_confidence,
            "cluster_confidence": cluster_confidence,
        }


def unrolled_config(config: ModelConfig, iterations: int | None = None) -> ModelConfig:
    """The settings with a fixed number of rounds (None: the configured maximum), decoded on tensors."""
    config.require("is_exportable", "for a model to export")
    rounds = config.inference.iterations if iterations is None else iterations
    return replace(config, inference=replace(config.inference, backend="eager", stop_early=False, iterations=rounds))


def decoder_inputs(batch: ScanPairBatch, start: Start | Tensor) -> dict[str, Tensor]:
    """The arguments of `UnrolledDecoder.forward` by name.

    Args:
        start: output of InitialiseRT, or (B, C, 3) motions alone, all of which exist.
    """
    if isinstance(start, Tensor):
        of_start = {"motions": start, "active": torch.ones_like(start[..., 0], dtype=torch.bool)}
    else:
        of_start = {f.name: getattr(start, f.name) for f in fields(start) if getattr(start, f.name) is not None}
    of_batch = {name: getattr(batch, name) for name in FROM_BATCH}
    # names are unique within a graph, and `motions` is an output too
    return of_batch | {f"start_{name}": value for name, value in of_start.items()}


def export_program(
    model: JointScanCRF, batch: ScanPairBatch, start: Start | Tensor, iterations: int | None = None
) -> ExportedProgram:
    """The unrolled rounds as a `torch.export` program of `UnrolledDecoder`, for any number of pairs.

    The message passing is unrolled over the source points, so N is fixed to that of the example: pad scans to the longest expected.
    """
    inputs = {name: value if len(value) > 1 else torch.cat([value, value]) for name, value in decoder_inputs(batch, start).items()}
    pairs = Dim("pairs")
    shapes = {name: {0: pairs} for name in inputs}
    decoder = UnrolledDecoder(model, iterations, plain=True)
    with torch.no_grad():
        return torch.export.export(decoder, (), inputs, dynamic_shapes=shapes, strict=False)


def export_onnx(path: str | Path, program: ExportedProgram) -> None:
    """Writes a program from `export_program` as an ONNX file of opset `OPSET`, atomically; needs the extra `export`.

    Inputs are `decoder_inputs`, outputs `OUTPUTS`; the indices of impossible candidates may differ from the model's.
    """
    names = list(OUTPUTS)
    # not simplified here, which takes minutes: a runtime does it in a second when it loads the file
    written = torch.onnx.export(program, opset_version=OPSET, output_names=names, dynamo=True, optimize=False, verbose=False)
    assert written is not None
    with whole_path(Path(path)) as beside:
        written.save(beside)


class PlainOperators(TorchFunctionMode):
    """Context that replaces operators missing in ONNX by supported ones and ignores switches of the gradient mode: each switch
    would become a nested program, which takes a fifth of the time of an export.
    """

    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        """The function itself, or its replacement."""
        if func is torch._C._set_grad_enabled and args[0] == torch.is_grad_enabled():
            return None
        own = {
            torch.searchsorted: count_below,
            Tensor.nanmedian: middle_of_known,
            Tensor.cummax: largest_so_far,
            torch.linalg.solve_ex: eliminate,
        }
        return own.get(func, func)(*args, **(kwargs or {}))


def count_below(sorted_sequence: Tensor, values: Tensor) -> Tensor:
    """`torch.searchsorted` from the left, by comparing every value with every entry. sorted_sequence: (R, M); values: (R, P)."""
    return (sorted_sequence[:, None] < values[..., None]).sum(-1)


def largest_so_far(values: Tensor, dim: int) -> torch.return_types.cummax:
    """`torch.cummax` of whole numbers along the last dimension, by comparing every place with every one, and where they are."""
    assert dim == -1
    place = torch.arange(values.shape[-1], device=values.device)
    known = values[..., None, :].masked_fill(place > place[:, None], torch.iinfo(values.dtype).min)
    return torch.return_types.cummax((known.amax(-1), known.argmax(-1)))


def middle_of_known(values: Tensor, dim: int, *, keepdim: bool = False) -> torch.return_types.nanmedian:
    """`torch.nanmedian`: the lower of the two middle values, and its index; NaN if all values are NaN."""
    ordered, index = values.masked_fill(values.isnan(), torch.inf).sort(dim)
    known = (~values.isnan()).sum(dim, keepdim=True)
    place = (known - 1).clamp(min=0) // 2
    middle, index = torch.where(known > 0, ordered.gather(dim, place), torch.nan), index.gather(dim, place)
    return torch.return_types.nanmedian((middle, index) if keepdim else (middle.squeeze(dim), index.squeeze(dim)))


def eliminate(matrix: Tensor, right: Tensor) -> tuple[Tensor, Tensor]:
    """`torch.linalg.solve_ex` for positive definite systems with one right side, by elimination without pivoting; never fails.

    matrix: (..., n, n); right: (..., n). Returns (..., n) and (...) zeros.
    """
    n = right.shape[-1]
    rows = [[*matrix[..., i, :].unbind(-1), right[..., i]] for i in range(n)]
    for i in range(n):
        for below in range(i + 1, n):
            share = rows[below][i] / rows[i][i]
            rows[below] = [b - share * a for a, b in zip(rows[i], rows[below], strict=True)]
    solution: list[Tensor] = []  # in reverse order
    for i in reversed(range(n)):
        rest = sum((a * x for a, x in zip(rows[i][n - 1 : i : -1], solution, strict=True)), start=torch.zeros_like(rows[i][n]))
        solution.append((rows[i][n] - rest) / rows[i][i])
    return torch.stack(solution[::-1], dim=-1), torch.zeros_like(right[..., 0], dtype=torch.int32)
