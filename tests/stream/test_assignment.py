"""The assignment against brute force."""

from itertools import permutations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from torchcrf_scan.stream.assignment import assign


def best(cost: np.ndarray) -> tuple[int, float]:
    """(most pairs, least cost of so many) by trying everything; rows are at most columns."""
    rows, columns = cost.shape
    found = []
    for order in permutations(range(columns), rows):
        values = [cost[i, k] for i, k in enumerate(order) if np.isfinite(cost[i, k])]
        found.append((-len(values), sum(values)))
    fewest, least = min(found)
    return -fewest, least


@given(st.integers(1, 4), st.integers(0, 2**16))
def test_as_many_as_possible_and_of_these_the_cheapest(rows: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    cost = rng.uniform(0, 20, (rows, rng.integers(rows, 6)))
    cost[rng.random(cost.shape) < 0.4] = np.inf
    pairs = assign(cost)
    assert len({i for i, _ in pairs}) == len({k for _, k in pairs}) == len(pairs)
    assert (len(pairs), sum(cost[pair] for pair in pairs)) == pytest.approx(best(cost))


def test_nothing_within_the_gate() -> None:
    assert assign(np.full((2, 3), np.inf)) == []
