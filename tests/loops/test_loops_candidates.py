import math
from pathlib import Path

import numpy as np
import pytest
import torch
from support import all_real, make_points, normal
from torch import Tensor

from torchcrf_scan.batch import ScanPairBatch
from torchcrf_scan.data.pair_file import read_pair
from torchcrf_scan.data.simulate import simulate_pairs
from torchcrf_scan.data.worlds import WORLDS
from torchcrf_scan.features import candidates
from torchcrf_scan.loops.candidates import by_motion, with_targets
from torchcrf_scan.loops.nearest import boxes_of

PAIRS = Path(__file__).resolve().parents[3] / "shared" / "data" / "pairs"
MOTIONS = torch.tensor([[0.02, 0.5, 0.1], [3.0, 9.0, 9.0], [0.0, 1.5, 0.1], [0.1, 0.1, -0.4]], dtype=torch.float64)
ACTIVE = torch.tensor([True, False, True, True])


def assert_same_candidates(source: Tensor, target: Tensor, count: int, active: Tensor = ACTIVE) -> None:
    index, mask, nearest = by_motion(boxes_of(target.numpy()), source.numpy(), MOTIONS.numpy(), active.numpy(), count)
    expected = candidates.by_motion(source[None], target[None], all_real(target[None]), MOTIONS[None], active[None], count)
    np.testing.assert_array_equal(mask, expected.mask[0].numpy())
    np.testing.assert_array_equal(nearest, expected.nearest[0].numpy())
    assert index.shape == tuple(expected.index[0].shape)
    np.testing.assert_array_equal(index[mask], expected.index[0].numpy()[mask])


@pytest.mark.parametrize("count", [0, 1, 3, 8, 30])
@pytest.mark.parametrize(("n", "m"), [(25, 21), (1, 40), (200, 150), (6, 3), (3, 1), (0, 5)])
def test_candidates_equal_the_eager_ones(n: int, m: int, count: int) -> None:
    assert_same_candidates(normal(n, 2, seed=1), normal(m, 2, seed=2), count)
    assert_same_candidates(make_points(n, 3), make_points(m, 4, closed=True), count)


def test_one_motion_and_none() -> None:
    for active in ([True, False, False, False], [False] * 4):
        assert_same_candidates(make_points(30, 5), make_points(28, 6), 4, torch.tensor(active))


@pytest.mark.parametrize("world", ["street", "model_cars"])
def test_simulated_scans(world: str) -> None:
    batch = ScanPairBatch.collate(simulate_pairs(WORLDS[world], 1, 1, seed=3), torch.float64).without_truth()
    assert_same_candidates(batch.source[0], batch.target[0], 8)


@pytest.mark.skipif(not PAIRS.is_dir(), reason="the recorded pairs are not here")
def test_recorded_scans() -> None:
    for path in sorted(PAIRS.glob("*.npz"))[::12]:
        batch = ScanPairBatch.collate([read_pair(path)], torch.float64).without_truth()
        assert_same_candidates(batch.source[0], batch.target[0], 8)


def test_of_points_on_one_spot_the_first_are_taken() -> None:
    target, still = np.repeat([[1.0, 2.0], [5.0, 5.0]], 20, axis=0), np.zeros((1, 3))
    index, mask, nearest = by_motion(boxes_of(target), np.array([[4.9, 5.0], [1.0, 2.0]]), still, np.ones(1, np.bool_), 4)
    assert index.tolist() == [[20, 21, 22, 23], [0, 1, 2, 3]]
    assert nearest[:, 0].tolist() == [20, 0]
    assert mask.all()


def test_an_empty_target() -> None:
    nothing = boxes_of(np.empty((0, 2)))
    index, mask, nearest = by_motion(nothing, np.ones((3, 2)), np.zeros((2, 3)), np.ones(2, np.bool_), 8)
    assert index.shape == mask.shape == (3, 0)
    assert not nearest.any()


def test_given_targets_equal_the_eager_ones() -> None:
    rng = np.random.default_rng(7)
    index = np.sort(rng.permuted(np.tile(np.arange(9), (40, 1)), axis=1)[:, :4])
    mask = rng.random((40, 4)) < 0.8
    association = rng.integers(-1, 9, 40)
    found = with_targets(index, mask, association)
    expected = candidates.with_targets(*(torch.from_numpy(values)[None] for values in (index, mask, association)))
    for mine, theirs in zip(found, expected, strict=True):
        np.testing.assert_array_equal(mine, theirs[0].numpy())
    assert math.prod(found[0].shape) == 160
