"""The unrolled rounds as a program without Python: `torch.export`, and ONNX for other runtimes.

    motions ──► fixed number of rounds ──► labels, motions, beliefs

InitialiseRT follows what it sees and stays outside: the motions to begin with are given. For a model that does not stop early,
`torch.export.export(model, (batch, start))` works too and has all of a `Prediction`; here there are plain tensors with names, which
is what a runtime takes.
"""

from __future__ import annotations

import copy
import os
from collections.abc import Callable
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn
from torch.export import Dim, ExportedProgram

from torchcrf_scan.batch import ScanPairBatch, scale_motions
from torchcrf_scan.config import ModelConfig
from torchcrf_scan.inference import joint
from torchcrf_scan.inference.initialise import Start
from torchcrf_scan.model import JointScanCRF

OPSET = 18  # of ONNX
FROM_BATCH = (
    *("source", "target", "source_mask", "target_mask", "source_closed", "target_closed"),
    *("range_noise", "initial_motion", "target_origin"),
)
OF_TARGET = ("target", "target_mask", "target_tangents")  # inputs whose second axis counts target points
OUTPUTS = (
    *("association", "cluster", "motions", "active", "candidates", "log_association", "log_cluster"),
    *("association_confidence", "cluster_confidence"),
)


class UnrolledDecoder(nn.Module):
    """The model from given motions on, as a function of plain tensors; its answers are those of the model at that start.

    Args:
        model: its weights are shared; it decodes on tensors (backend `eager`) and does not stop early.
        iterations: rounds; None: the model's.
    """

    def __init__(self, model: JointScanCRF, iterations: int | None = None) -> None:
        super().__init__()
        self.model = copy.copy(model)
        self.model.config = unrolled_config(model.config, iterations)

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
        motions: Tensor,
        active: Tensor,
        association: Tensor | None = None,
        target_tangents: Tensor | None = None,
        reach: Tensor | None = None,
        log_odds: Tensor | None = None,
    ) -> dict[str, Tensor]:
        """The fields `OUTPUTS` of a `Prediction`.

        The first nine inputs are those of a `ScanPairBatch`, the others those of a `Start`: motions (B, C, 3) and which of them
        exist, active (B, C), and where InitialiseRT found them, all that it says. Without association and target_tangents these
        follow from the motions (`Start.at`).
        """
        batch = ScanPairBatch(
            source=source,
            target=target,
            source_mask=source_mask,
            target_mask=target_mask,
            source_closed=source_closed,
            target_closed=target_closed,
            dt=torch.zeros_like(range_noise),  # only InitialiseRT asks for it
            range_noise=range_noise,
            initial_motion=initial_motion,
            target_origin=target_origin,
        )
        if association is None or target_tangents is None:
            start = Start.at(batch, motions, active)
        else:
            start = Start(motions, active, association, target_tangents)
        view = self.model.view(batch)
        start = replace(start, reach=reach, log_odds=log_odds).scaled(view.factor)
        fitted = self.model.fitted
        state = joint.settle(view, start, fitted, self.model.config).state
        association_confidence, cluster_confidence = fitted.calibration(state)
        return {
            "association": state.association,
            "cluster": state.cluster,
            "motions": scale_motions(state.motions.value, 1 / view.factor),
            "active": state.motions.active,
            "candidates": state.candidates,
            "log_association": state.log_association,
            "log_cluster": state.log_cluster,
            "association_confidence": association_confidence,
            "cluster_confidence": cluster_confidence,
        }


def unrolled_config(config: ModelConfig, iterations: int | None = None) -> ModelConfig:
    """The settings with a fixed number of rounds (None: as many as there may be) on tensors."""
    if config.inference.schedule != "sweep":
        raise ValueError(f"schedule: expected sweep for a model to export, got {config.inference.schedule}")
    rounds = config.inference.iterations if iterations is None else iterations
    return replace(config, inference=replace(config.inference, backend="eager", stop_early=False, iterations=rounds))


def decoder_inputs(batch: ScanPairBatch, start: Start | Tensor) -> dict[str, Tensor]:
    """The arguments of `UnrolledDecoder.forward` by name.

    start: what InitialiseRT found, or (B, C, 3) motions alone, all of which exist.
    """
    if isinstance(start, Tensor):
        of_start = {"motions": start, "active": torch.ones_like(start[..., 0], dtype=torch.bool)}
    else:
        of_start = {f.name: getattr(start, f.name) for f in fields(start) if getattr(start, f.name) is not None}
    return {name: getattr(batch, name) for name in FROM_BATCH} | of_start


def export_program(
    model: JointScanCRF, batch: ScanPairBatch, start: Start | Tensor, iterations: int | None = None
) -> ExportedProgram:
    """The unrolled rounds as a `torch.export` program of `UnrolledDecoder`, for any number of pairs.

    The steps of the messages follow the source points one by one, so N is that of the example: pad scans to the longest to come.
    """
    inputs = {name: value if len(value) > 1 else torch.cat([value, value]) for name, value in decoder_inputs(batch, start).items()}
    pairs = Dim("pairs")
    shapes = {name: {0: pairs} for name in inputs}
    with torch.no_grad():
        return torch.export.export(UnrolledDecoder(model, iterations), (), inputs, dynamic_shapes=shapes, strict=False)


def export_onnx(path: str | Path, program: ExportedProgram) -> None:
    """Writes what `export_program` made as an ONNX file of opset `OPSET`, whole or not at all; needs the extra `export`.

    Inputs are `decoder_inputs` (without those that the model does not ask for), outputs `OUTPUTS`.
    """
    path = Path(path)
    temporary = path.with_name(f".{path.name}.{os.getpid()}")
    small = program.run_decompositions(onnx_decompositions())
    written = torch.onnx.export(small, opset_version=OPSET, output_names=list(OUTPUTS), dynamo=True, verbose=False)
    assert written is not None
    written.save(temporary)
    os.replace(temporary, path)


def onnx_decompositions() -> dict[Any, Callable[..., Any]]:
    """The usual decompositions, and what ONNX has no operator for in terms of what it has."""
    own = {
        torch.ops.aten.searchsorted.Tensor: count_below,
        torch.ops.aten.nanmedian.dim: middle_of_known,
        torch.ops.aten._linalg_solve_ex.default: eliminate,
    }
    return {**torch.export.default_decompositions(), **own}


def count_below(sorted_sequence: Tensor, values: Tensor, **_: Any) -> Tensor:
    """`torch.searchsorted` from the left, every value against every entry. sorted_sequence: (R, M); values: (R, P)."""
    return (sorted_sequence[:, None] < values[..., None]).sum(-1)


def middle_of_known(values: Tensor, dim: int, keepdim: bool = False) -> tuple[Tensor, Tensor]:
    """`torch.nanmedian`, the lower of two middle ones, and its index; NaN where all are."""
    ordered, index = values.masked_fill(values.isnan(), torch.inf).sort(dim)
    known = (~values.isnan()).sum(dim, keepdim=True)
    place = (known - 1).clamp(min=0) // 2
    middle = torch.where(known > 0, ordered.gather(dim, place), torch.nan)
    found = middle, index.gather(dim, place)
    return found if keepdim else (found[0].squeeze(dim), found[1].squeeze(dim))


def eliminate(matrix: Tensor, right: Tensor, **_: Any) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """`torch.linalg.solve_ex` of positive definite systems of one right side by elimination without a pivot.

    matrix: (..., n, n); right: (..., n). Beside the solution there are factors, pivots and info, which nobody reads.
    """
    n = right.shape[-1]
    rows = [[*matrix[..., i, :].unbind(-1), right[..., i]] for i in range(n)]
    for i in range(n):
        for below in range(i + 1, n):
            share = rows[below][i] / rows[i][i]
            rows[below] = [b - share * a for a, b in zip(rows[i], rows[below], strict=True)]
    solution: list[Tensor] = []  # from the last
    for i in reversed(range(n)):
        rest = sum((a * x for a, x in zip(rows[i][n - 1 : i : -1], solution, strict=True)), start=torch.zeros_like(rows[i][n]))
        solution.append((rows[i][n] - rest) / rows[i][i])
    unread = torch.zeros_like(right, dtype=torch.int32)
    return torch.stack(solution[::-1], dim=-1), matrix.clone(), unread, unread[..., 0].clone()
