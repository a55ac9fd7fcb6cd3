"""Nearest points from the grid of a scan, against looking at every point; and how much every point counts."""

import math

import numpy as np
import oracles_search as oracles
import torch
from hypothesis import given
from hypothesis import strategies as st
from support import assert_close, normal
from surveyed import any_scan, array, seen
from torch import Tensor

from torchcrf_scan.loops.jit import Array
from torchcrf_scan.search.grid import COST_SHARE, LENGTH_SHARE, ScanGrid, grid_of, locate, share_of
from torchcrf_scan.search.surface import Surface

SEEDS = st.integers(0, 10_000)


def nearest_points(moved: Tensor, scan: ScanGrid) -> tuple[Array, Array]:
    """(P,) squared distance to and index of the nearest point of a scan. moved: (P, 2)."""
    squared, index = np.empty(len(moved)), np.empty(len(moved), np.int64)
    locate(array(moved.T), scan, squared, index)
    return squared, index


@given(any_scan(), SEEDS)
def test_nearest_points(scan: Surface, seed: int) -> None:
    extent = float(np.abs(scan.points - scan.origin).max()) + 1.0
    near = torch.from_numpy(scan.points) + 0.02 * normal(len(scan.points), 2, seed=seed)
    moved = torch.cat([torch.from_numpy(scan.origin) + extent * normal(50, 2, seed=seed + 1), near, torch.from_numpy(scan.points)])
    squared, index = nearest_points(moved, grid_of(scan))
    for i, place in enumerate(moved.tolist()):
        least, first = oracles.nearest(scan.points, place)
        assert_close(squared[i], least**2)
        assert_close(math.dist(scan.points[index[i]], place) ** 2, least**2)
        assert index[i] == first or np.isclose(squared[i], math.dist(scan.points[first], place) ** 2, rtol=1e-12)


@given(st.integers(1, 20), SEEDS)
def test_points_count_by_the_surface_that_they_stand_for(count: int, seed: int) -> None:
    length = normal(count, seed=seed).abs().numpy() ** 3
    usual = oracles.lower_median(length.tolist())
    assert_close(share_of(length, 0.25, 4.0), np.clip(length / max(usual, 1e-6), 0.25, 4.0))


def test_a_scan_knows_how_much_its_points_count() -> None:
    scan = seen(5 * normal(30, 2))
    grid = grid_of(scan)
    assert_close(grid.pull, share_of(scan.length, *LENGTH_SHARE))
    assert_close(grid.charge, share_of(scan.length, *COST_SHARE))
    assert_close(grid.features[:, :2], scan.points)
    assert_close(grid.features[:, 4], scan.spacing / 2)
