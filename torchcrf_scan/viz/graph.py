"""The module's graph for TensorBoard, which draws functions of tensors only."""

from __future__ import annotations

import copy
import warnings
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor, nn
from torch.overrides import TorchFunctionMode
from torch.utils.tensorboard import SummaryWriter

from torchcrf_scan.batch import ScanPairBatch, scale_motions
from torchcrf_scan.inference import joint
from torchcrf_scan.inference.initialise import Start
from torchcrf_scan.model import JointScanCRF

POINTS = 8  # of each scan
ROUNDS = 1  # of the iterations that are drawn; more repeat the same boxes


class TensorOnly(nn.Module):
    """The model as a function of tensors: `forward(source, target, motions)`; masks and all the rest stay those of an example.

    Args:
        model: its weights are shared. batch, start: the example, B pairs.
    """

    def __init__(self, model: JointScanCRF, batch: ScanPairBatch, start: Start) -> None:
        super().__init__()
        self.model = copy.copy(model)
        inference = replace(model.config.inference, backend="eager", stop_early=False, iterations=ROUNDS)
        self.model.config = replace(model.config, inference=inference)
        self.batch, self.start = batch.without_truth(), start

    def forward(self, source: Tensor, target: Tensor, motions: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """source: (B, N, 2). target: (B, M, 2). motions: (B, C, 3). Returns log-beliefs of both chains and the new motions."""
        batch = replace(self.batch, source=source, target=target)
        view = self.model.view(batch)
        start = replace(self.start, motions=motions).scaled(view.factor)
        last = joint.rounds(view, start, self.model.fitted, self.model.config)[
            -1
        ].state  # how sure it is, is another graph as large
        return last.log_association, last.log_cluster, scale_motions(last.motions.value, 1 / view.factor)


class BoolsAsTensors(TorchFunctionMode):
    """Makes tensors of the plain booleans that masks are combined with: the tracer has no operator for the mixture."""

    def __torch_function__(self, function: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        if function in (Tensor.__and__, Tensor.__or__, Tensor.__rand__, Tensor.__ror__) and isinstance(args[1], bool):
            args = (args[0], torch.tensor(args[1], device=args[0].device))
        return function(*args, **(kwargs or {}))


def beginning(batch: ScanPairBatch, start: Start, points: int) -> tuple[ScanPairBatch, Start]:
    """The first points of both scans of the first pair, its movers decided: weighing them up is a graph of its own."""
    row, n = slice(0, 1), slice(0, points)
    part = replace(
        batch[row].without_truth(),
        source=batch.source[row, n],
        source_mask=batch.source_mask[row, n],
        target=batch.target[row, n],
        target_mask=batch.target_mask[row, n],
    )
    association = start.association[row, n]
    first = Start(
        start.motions[row],
        start.active[row],
        association.masked_fill(association >= points, -1),
        start.target_tangents[row, n],
        None if start.reach is None else start.reach[row, n],
    )
    return part, first


def write_graph(writer: SummaryWriter, model: JointScanCRF, batch: ScanPairBatch, start: Start) -> None:
    """Writes the graph of the model's first round on the beginning of one pair: tracing repeats what is done point by point.

    batch, start: B pairs, of which the first is taken.
    """
    batch, start = beginning(batch, start, POINTS)
    module = TensorOnly(model, batch, start)
    with warnings.catch_warnings(), BoolsAsTensors():
        warnings.simplefilter("ignore")  # tracing tells of every shape that it takes for granted, which is the point here
        writer.add_graph(module, (batch.source, batch.target, start.motions), use_strict_trace=False)
