import math
from pathlib import Path

import numpy as np
import pytest
import torch
from support import make_points, normal
from torch import Tensor

from torchcrf_scan.batch import ScanPairBatch
from torchcrf_scan.data.pair_file import read_pair
from torchcrf_scan.data.simulate import simulate_pairs
from torchcrf_scan.data.worlds import WORLDS
from torchcrf_scan.features import potentials, shape
from torchcrf_scan.loops.shape import describe, resolution

PAIRS = Path(__file__).resolve().parents[3] / "shared" / "data" / "pairs"
SCANS = {
    "open": make_points(20, 1),
    "closed": make_points(20, 2, closed=True),
    "three": make_points(3, 3),
    "two": make_points(2, 4),
    "one": make_points(1, 5),
    "none": make_points(0, 6),
    "one spot": torch.tensor([[1.0, 2.0]], dtype=torch.float64).expand(7, 2).contiguous(),
    "duplicates": make_points(6, 7).repeat_interleave(2, 0).contiguous(),
    "collinear": torch.stack([torch.linspace(-1, 1, 9), torch.full((9,), 2.0)], -1).double(),
    "cloud": normal(15, 2, seed=8),
}


def assert_same_shape(points: Tensor, is_closed: bool) -> None:
    found = describe(points.numpy(), is_closed)
    mask = torch.ones(1, len(points), dtype=torch.bool)
    expected = shape.describe(points[None], mask, torch.tensor([is_closed]))
    for name in ("distance", "geodesic", "radius"):
        np.testing.assert_allclose(getattr(found, name), getattr(expected, name)[0].numpy(), rtol=1e-12, atol=1e-12)
    turn = found.angle - expected.angle[0].numpy()
    np.testing.assert_allclose((turn + 1) % (2 * math.pi), np.ones_like(turn), atol=1e-9)
    assert np.all((found.angle >= 0) & (found.angle <= 2 * math.pi))


@pytest.mark.parametrize("is_closed", [False, True])
@pytest.mark.parametrize("name", SCANS)
def test_descriptors_equal_the_eager_ones(name: str, is_closed: bool) -> None:
    assert_same_shape(SCANS[name], is_closed)


def assert_same_resolution(batch: ScanPairBatch) -> None:
    found = resolution(batch.source[0].numpy(), batch.target[0].numpy(), float(batch.range_noise[0]))
    np.testing.assert_allclose(found, potentials.resolution(batch)[0].numpy(), rtol=1e-12)


@pytest.mark.parametrize("world", ["street", "model_cars"])
def test_simulated_scans(world: str) -> None:
    batch = ScanPairBatch.collate(simulate_pairs(WORLDS[world], 1, 1, seed=3), torch.float64).without_truth()
    assert_same_shape(batch.source[0], bool(batch.source_closed[0]))
    assert_same_resolution(batch)


@pytest.mark.skipif(not PAIRS.is_dir(), reason="the recorded pairs are not here")
def test_recorded_scans() -> None:
    for path in sorted(PAIRS.glob("*.npz"))[::12]:
        batch = ScanPairBatch.collate([read_pair(path)], torch.float64).without_truth()
        assert_same_shape(batch.source[0], bool(batch.source_closed[0]))
        assert_same_shape(batch.target[0], bool(batch.target_closed[0]))
        assert_same_resolution(batch)


def test_resolution_without_points() -> None:
    nothing = np.empty((0, 2))
    assert resolution(nothing, nothing, 0.01) == pytest.approx(0.07)
    assert resolution(nothing, np.ones((1, 2)), 0.01) == pytest.approx(0.02)
