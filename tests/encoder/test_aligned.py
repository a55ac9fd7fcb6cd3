"""What the encoder sees: the same whoever computes it, in whatever frame, unit and batch, and 0 of what is not there."""

import math
from dataclasses import replace

import pytest
import torch
from scenes import tiny_scan
from support import assert_close, normal

from torchcrf_scan import ScanPair, ScanPairBatch
from torchcrf_scan.data.simulate import simulate_pairs
from torchcrf_scan.data.worlds import WORLDS
from torchcrf_scan.encoder.aligned import aligned_inputs
from torchcrf_scan.encoder.channels import CHANNELS, FARTHEST
from torchcrf_scan.geometry import se2
from torchcrf_scan.inference.start import Start

MOTIONS = torch.tensor([[0.02, -0.3, 0.05], [0.0, 0.4, -0.1], [0.3, 0.0, 0.0]], dtype=torch.float64)


def channel(inputs: torch.Tensor, name: str) -> torch.Tensor:
    return inputs[..., CHANNELS.index(name)]


def simulated(world: str = "street", count: int = 2) -> ScanPairBatch:
    scanner = replace(WORLDS[world], beams=91)
    return ScanPairBatch.collate(simulate_pairs(scanner, count, 1, seed=8), torch.float64).without_truth()


def started(batch: ScanPairBatch, *, reach: torch.Tensor | None = None) -> Start:
    """A background, a mover and one that the score would not accept, everywhere within reach if nothing else is said."""
    B, N, M = len(batch), batch.source.shape[1], batch.target.shape[1]
    active = torch.tensor([[True, True, False]]).expand(B, 3)
    log_odds = torch.tensor([[torch.inf, 0.7, -1.0]], dtype=torch.float64).expand(B, 3)
    reach = torch.zeros(B, N, 3, dtype=torch.float64) if reach is None else reach
    nothing = torch.full((B, N), -1), torch.zeros(B, M, 2, dtype=torch.float64)
    return Start(MOTIONS.expand(B, 3, 3), active, *nothing, reach, log_odds)


@pytest.mark.parametrize("world", ["street", "model_cars"])
def test_compiled_code_sees_the_same(world: str) -> None:
    batch = simulated(world)
    offset = torch.tensor([[0.4, 2.0, -1.0]], dtype=torch.float64).expand(len(batch), 3)
    reach = normal(len(batch), batch.source.shape[1], 3, seed=3).clamp(min=0)
    unknown = replace(started(batch), reach=None)
    for of, start in ((batch, started(batch)), (batch.displaced(offset), started(batch, reach=reach)), (batch, unknown)):
        for found, expected in zip(aligned_inputs(of, start, "compiled"), aligned_inputs(of, start, "eager"), strict=True):
            assert_close(found, expected, tolerance=1e-9)
    assert len(aligned_inputs(batch, started(batch), "compiled", both=False)) == 1


@pytest.mark.parametrize("backend", ["eager", "auto"])
def test_scans_with_hardly_a_point(backend: str) -> None:
    pairs = [ScanPair(tiny_scan(n), tiny_scan(m)) for n, m in ((0, 0), (0, 5), (1, 0), (1, 1), (2, 9))]
    batch = ScanPairBatch.collate(pairs, torch.float64)
    for inputs, mask in zip(aligned_inputs(batch, started(batch), backend), (batch.source_mask, batch.target_mask), strict=True):
        assert inputs.shape == (*mask.shape, len(CHANNELS))
        assert inputs.isfinite().all()
        assert (inputs[~mask] == 0).all()
        assert (channel(inputs, "is there")[mask] == 1).all()


def test_padding_is_invisible() -> None:
    batch = simulated(count=3)
    for b in range(3):
        one = batch.select(torch.tensor([b]))
        start = started(one)
        for together, alone in zip(
            aligned_inputs(batch, started(batch), "eager"), aligned_inputs(one, start, "eager"), strict=True
        ):
            assert_close(together[b : b + 1, : alone.shape[1]], alone)


def test_unit_and_frame_do_not_matter() -> None:
    batch = simulated()
    start = started(batch)
    expected = aligned_inputs(batch, start, "eager")
    tenth = torch.full((len(batch),), 0.1, dtype=torch.float64)
    offset = torch.tensor([[1.1, -3.0, 0.5]], dtype=torch.float64).expand(len(batch), 3)
    moved = replace(start, motions=se2.compose(offset[:, None].expand(-1, 3, 3), start.motions))
    for found in (
        aligned_inputs(batch.scaled(tenth), start.scaled(tenth), "eager"),
        aligned_inputs(batch.displaced(offset), moved, "eager"),
    ):
        for one, other in zip(found, expected, strict=True):
            assert_close(one, other, tolerance=1e-6)


def test_the_nearest_point_is_that_of_all_where_it_is_near() -> None:
    batch = simulated(count=1)
    inputs = aligned_inputs(batch, started(batch), "eager")[0]
    moved = se2.apply(MOTIONS[:1], batch.source)
    step = math.radians(2.0)  # 91 beams over a half circle
    unit = batch.range_noise[:, None] + torch.linalg.vector_norm(batch.source, dim=-1) * step
    nearest = torch.cdist(moved, batch.target).amin(-1) / unit
    near = (nearest < 2) & batch.source_mask
    assert int(near.sum()) > 20
    assert_close(channel(inputs, "distance to its nearest point")[near], torch.log1p(nearest)[near], tolerance=1e-3)


def test_movers_count_where_they_are_within_reach() -> None:
    batch = simulated(count=1)
    nowhere = torch.ones(1, batch.source.shape[1], 3, dtype=torch.float64)
    inputs = aligned_inputs(batch, started(batch, reach=nowhere), "eager")[0][batch.source_mask]
    assert (channel(inputs, "probability of that mover") == 0).all()
    assert_close(channel(inputs, "distance under the best mover").exp(), torch.full((len(inputs),), 1 + FARTHEST))
    inputs = aligned_inputs(batch, started(batch), "eager")[0][batch.source_mask]
    assert (channel(inputs, "probability of that mover") > 0).any()
