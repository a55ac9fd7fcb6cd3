"""The compiled matching by shape against the eager one."""

from pathlib import Path

import numpy as np
import pytest
import torch
from support import make_points, normal
from torch import Tensor

pytest.importorskip("numba")

from torchcrf_scan.batch import ScanPairBatch
from torchcrf_scan.data.pair_file import read_pair
from torchcrf_scan.data.simulate import simulate_pairs
from torchcrf_scan.data.worlds import WORLDS
from torchcrf_scan.features.potentials import PairView
from torchcrf_scan.geometry import se2
from torchcrf_scan.inference import cold as eager
from torchcrf_scan.search import cold as compiled

PAIRS = Path(__file__).resolve().parents[3] / "shared" / "data" / "pairs"
RECORDED = ("datmo_overtake_red_0030", "datmo_overtakes_0199", "kitti0001_f057_g2", "kitti0001_f078_g3")


def of_points(source: Tensor, target: Tensor, is_closed: bool = False) -> ScanPairBatch:
    return ScanPairBatch(
        source=source[None],
        target=target[None],
        source_mask=torch.ones(1, len(source), dtype=torch.bool),
        target_mask=torch.ones(1, len(target), dtype=torch.bool),
        source_closed=torch.tensor([is_closed]),
        target_closed=torch.tensor([is_closed]),
        dt=torch.tensor([0.1], dtype=torch.float64),
        range_noise=torch.tensor([0.01], dtype=torch.float64),
        initial_motion=torch.zeros(1, 3, dtype=torch.float64),
    )


def associate(batch: ScanPairBatch) -> list[int]:
    closed = bool(batch.source_closed[0]), bool(batch.target_closed[0])
    source, target = batch.source[0].contiguous().numpy(), batch.target[0].contiguous().numpy()
    return compiled.shape_association(source, target, float(batch.range_noise[0]), *closed).tolist()


def assert_same_association(batch: ScanPairBatch) -> None:
    assert associate(batch) == eager.shape_association(PairView.of(batch, length_unit="spacing"))[0].tolist()


@pytest.mark.parametrize("is_closed", [False, True])
@pytest.mark.parametrize(("n", "m"), [(1, 1), (2, 3), (3, 40), (40, 3), (60, 57), (20, 33)])
def test_random_scans(n: int, m: int, is_closed: bool) -> None:
    source = make_points(n, 1, closed=is_closed)
    motion = torch.tensor([0.4, 1.0, -2.0], dtype=torch.float64)
    assert_same_association(of_points(source, make_points(m, 2, closed=is_closed), is_closed))
    assert_same_association(of_points(source, se2.apply(motion, source) + 0.002 * normal(n, 2, seed=3), is_closed))


@pytest.mark.parametrize("world", ["street", "model_cars"])
def test_simulated_pairs(world: str) -> None:
    for seed in range(3):
        pairs = simulate_pairs(WORLDS[world], 1, 1, seed=seed)
        assert_same_association(ScanPairBatch.collate(pairs, torch.float64).without_truth())


@pytest.mark.parametrize("name", RECORDED)
def test_recorded_pairs(name: str) -> None:
    path = PAIRS / f"{name}.npz"
    if not path.exists():
        pytest.skip(f"needs the real pairs, which are not part of the repository: no {path}")
    assert_same_association(ScanPairBatch.collate([read_pair(path)], torch.float64).without_truth())


def test_points_that_say_nothing() -> None:
    spot = torch.ones(40, 2, dtype=torch.float64)
    wall = torch.stack([torch.linspace(3.0, 1.0, 35, dtype=torch.float64), torch.full((35,), 2.0, dtype=torch.float64)], dim=1)
    for source, target in ((spot, spot[:7]), (spot, wall), (wall, spot), (wall, wall)):
        found = associate(of_points(source, target))
        assert len(found) == len(source)
        assert -1 <= min(found) <= max(found) < len(target)
    assert associate(of_points(wall[:0], wall)) == []
    assert associate(of_points(wall, wall[:0])) == [-1] * len(wall)


@pytest.mark.parametrize("points", [0, 1, 2, 3, 50])
def test_ransac(points: int) -> None:
    source = make_points(points, 1) if points else torch.zeros(0, 2, dtype=torch.float64)
    target = se2.apply(torch.tensor([0.3, 1.0, 2.0], dtype=torch.float64), source) + 0.05 * normal(points, 2, seed=2)
    if points == 50:
        target[::3] += normal(len(target[::3]), 2, seed=3)
    found = compiled.ransac_motions(source.numpy(), target.numpy(), 0.1, 4)
    expected = eager.ransac_motions(source, target, torch.tensor(0.1, dtype=torch.float64), 4)
    np.testing.assert_allclose(found, expected.numpy(), rtol=1e-9, atol=1e-9)


def test_ransac_of_one_spot() -> None:
    spot = torch.ones(5, 2, dtype=torch.float64)
    found = compiled.ransac_motions(spot.numpy(), spot.numpy() + 2.0, 0.1, 4)
    np.testing.assert_allclose(found, [[0.0, 2.0, 2.0]] * 4, atol=1e-12)
