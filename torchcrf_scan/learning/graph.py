"""The module's graph for TensorBoard, which traces functions of tensors only."""

from __future__ import annotations

import warnings
from dataclasses import replace

from torch.utils.tensorboard import SummaryWriter

from torchcrf_scan.batch import ScanPairBatch
from torchcrf_scan.export import UnrolledDecoder, decoder_inputs
from torchcrf_scan.inference.start import Start
from torchcrf_scan.model import JointScanCRF

POINTS = 8  # of each scan
ROUNDS = 1  # iterations to draw; more would repeat the same nodes


def beginning(batch: ScanPairBatch, start: Start, points: int) -> tuple[ScanPairBatch, Start]:
    """The first points of both scans of the first pair, its movers already selected: selection would add its own graph."""
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
    """Writes the graph of the model's first round on a few points of one pair: tracing unrolls the loop over points.

    batch, start: B pairs, of which the first is used.
    """
    inputs = decoder_inputs(*beginning(batch, start, POINTS))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # tracing warns of every shape that it fixes, which is intended here
        writer.add_graph(UnrolledDecoder(model, ROUNDS), tuple(inputs.values()), use_strict_trace=False)
