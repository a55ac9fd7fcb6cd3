"""Pairs as arrays: the same numbers whichever way they come."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from torchcrf_scan.batch import ScanPairBatch
from torchcrf_scan.data.simulate import simulate_pairs
from torchcrf_scan.data.worlds import WORLDS
from torchcrf_scan.loops.pair import Pair, padded, pair_of, pair_of_scans
from torchcrf_scan.scan import Scan, ScanPair


def pairs() -> list[ScanPair]:
    """Streets and a closed scan, one with odometry, and pairs with little in them whose sensors state their noise."""
    simulated = [*simulate_pairs(WORLDS["street"], 2, 2, 3), *simulate_pairs(WORLDS["model_cars"], 1, 1, 4)]
    assert simulated[0].annotation is not None
    known = replace(simulated[0], initial_motion=simulated[0].annotation.motions[0] + 0.01, dt=0.07)
    bearings = np.linspace(-0.5, 0.5, 9)
    few, none = (Scan.from_ranges(np.where(np.arange(9) < n, 4.1, np.inf), bearings, range_noise=0.013) for n in (2, 0))
    return [*simulated, known, ScanPair(few, simulated[1].target), ScanPair(few, none)]


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_scans_give_the_arrays_that_their_batch_gives(dtype: torch.dtype) -> None:
    every = pairs()
    batch = ScanPairBatch.collate(every, dtype)
    for b, pair in enumerate(every):
        found, expected = pair_of_scans(pair, dtype), pair_of(batch, b)
        for name in Pair._fields:
            one, other = getattr(found, name), getattr(expected, name)
            np.testing.assert_array_equal(one, other, err_msg=name)
            assert type(one) is type(other), name
        assert found.fewest_points == min(len(pair.source), len(pair.target))
        assert found.source.dtype == found.initial_motion.dtype == np.float64
        assert found.source.flags.c_contiguous


def test_parts_lie_in_corners_of_their_own() -> None:
    parts = [np.arange(6.0).reshape(3, 2), np.zeros((0, 2)), np.ones((1, 1))]
    found = padded(parts, (3, 2), -7.0)
    assert found.shape == (3, 3, 2)
    assert found[0].tolist() == [[0, 1], [2, 3], [4, 5]]
    assert found[1].tolist() == [[-7, -7]] * 3
    assert found[2].tolist() == [[1, -7], [-7, -7], [-7, -7]]
    numbers = padded([np.array([3]), np.array([], np.int64)], (2,), -1)
    assert numbers.dtype == torch.int64
    assert numbers.tolist() == [[3, -1], [-1, -1]]
