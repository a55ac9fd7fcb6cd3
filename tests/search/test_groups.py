"""Sets of points that may be one object: segments, pieces, parts, runs and neighbours, each once."""

import numpy as np
import oracles_movers as oracles
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from surveyed import SCENES, any_scan, oracle_of, survey

from torchcrf_scan.loops.jit import Array
from torchcrf_scan.search.grid import grid_of
from torchcrf_scan.search.groups import Groups, ends, groups_of
from torchcrf_scan.search.leftover import Unexplained, pieces
from torchcrf_scan.search.surface import Surface


def sets_of(groups: Groups) -> list[tuple[int, ...]]:
    return [tuple(groups.members[a:b].tolist()) for a, b in zip(groups.start, groups.start[1:], strict=False)]


def assert_same_groups(scan: Surface, residual: Array) -> list[tuple[int, ...]]:
    """Every set once, in the order of the sets' rows of flags."""
    some = np.zeros(len(residual), np.int64)
    found = sets_of(groups_of(Unexplained(grid_of(scan), some.astype(float), residual, some, pieces(scan))))
    assert set(found) == oracles.groups(oracle_of(scan), residual.tolist())
    flags = [[i in s for i in range(len(residual))] for s in found]
    assert flags == sorted(flags)
    assert len(found) == len(set(found))
    return found


@given(any_scan(), st.integers(1, 9), st.integers(0, 10_000))
@settings(max_examples=100)
def test_groups_of_any_scan_equal_the_oracle(scan: Surface, run: int, seed: int) -> None:
    """Residuals come in runs of some points that are about as large."""
    random = np.random.default_rng(seed)
    level = np.repeat(random.choice([0.2, 1.0, 2.0], len(scan.points) // run + 1), run)[: len(scan.points)]
    assert_same_groups(scan, level + random.uniform(-0.1, 0.1, len(level)))


@pytest.mark.parametrize("name", SCENES)
def test_groups_of_scenes_equal_the_oracle(name: str) -> None:
    found = survey(name)
    sets = assert_same_groups(found.source, found.leftover.source.residual)
    assert_same_groups(found.target, found.leftover.target.residual)
    if len(found.found.motions):
        assert sets_of(found.found.groups) == sets


def test_ends_of_a_set_that_leads_round_the_seam() -> None:
    sets = [[2, 3, 4], [0, 1, 8, 9], [9], [*range(10)], [0, 9]]
    assert [ends(np.array(points), 10) for points in sets] == [(2, 4), (8, 1), (9, 9), (5, 4), (9, 0)]
    assert [ends(np.array(points), 10) for points in sets] == [oracles.ends(points, 10) for points in sets]
