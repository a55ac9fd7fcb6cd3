import math

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from torchcrf_scan.inference.messages import chain_beliefs, log_partition
from torchcrf_scan.loops import messages

Potentials = tuple[NDArray[np.float64], NDArray[np.float64]]


def make_chain(n: int, s: int, seed: int, *, holes: float = 0.0, spread: float = 2.0) -> Potentials:
    """Potentials of which a share of the nodes' is impossible."""
    rng = np.random.default_rng(seed)
    nodes, edges = spread * rng.normal(size=(n, s)), spread * rng.normal(size=(max(n - 1, 0), s, s))
    nodes[rng.random((n, s)) < holes] = -np.inf
    return nodes, edges


def eager_beliefs(nodes: NDArray[np.float64], edges: NDArray[np.float64]) -> NDArray[np.float64]:
    mask = torch.ones(1, len(nodes), dtype=torch.bool)
    return chain_beliefs(torch.from_numpy(nodes)[None], torch.from_numpy(edges)[None], mask)[0].numpy()


def eager_total(nodes: NDArray[np.float64], edges: NDArray[np.float64]) -> float:
    return float(log_partition(torch.from_numpy(nodes)[None], torch.from_numpy(edges)[None]))


CHAINS = {
    "plain": make_chain(30, 9, 1),
    "many states": make_chain(12, 17, 2),
    "holes": make_chain(30, 8, 3, holes=0.3),
    "mostly holes": make_chain(9, 5, 4, holes=0.8),
    "two states": make_chain(6, 2, 5),
    "one state": make_chain(6, 1, 6),
    "one node": make_chain(1, 5, 7),
    "two nodes": make_chain(2, 4, 8),
    "wide": make_chain(25, 6, 9, spread=300.0),
    "wide holes": make_chain(25, 6, 10, holes=0.2, spread=300.0),
    "long": make_chain(400, 4, 11, spread=20.0),
}


def with_inactive() -> Potentials:
    nodes, edges = make_chain(20, 8, 12)
    nodes[:, [1, 4, 6]] = -np.inf
    return nodes, edges


def with_impossible_steps() -> Potentials:
    nodes, edges = make_chain(10, 5, 13)
    edges[:, 2:4, 1] = -np.inf
    return nodes, edges


def impossible() -> Potentials:
    nodes, edges = make_chain(5, 3, 14)
    nodes[2] = -np.inf
    return nodes, edges


CHAINS |= {"inactive": with_inactive(), "impossible steps": with_impossible_steps(), "impossible": impossible()}
CHAINS |= {"impossible everywhere": (np.full((4, 3), -np.inf), np.zeros((3, 3, 3)))}


@pytest.mark.parametrize("name", CHAINS)
def test_max_marginals_equal_the_eager_ones(name: str) -> None:
    np.testing.assert_allclose(messages.max_marginals(*CHAINS[name]), eager_beliefs(*CHAINS[name]), rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("name", CHAINS)
def test_totals_equal_the_eager_ones(name: str) -> None:
    nodes, edges = CHAINS[name]
    before = nodes.copy(), edges.copy()
    whole, without = messages.log_partition_without(nodes, edges)
    np.testing.assert_allclose(whole, eager_total(nodes, edges), rtol=1e-9, atol=1e-9)
    for k in range(nodes.shape[1]):
        less = nodes.copy()
        less[:, k] = -np.inf
        np.testing.assert_allclose(without[k], eager_total(less, edges), rtol=1e-9, atol=1e-9)
    np.testing.assert_array_equal(before[0], nodes)
    np.testing.assert_array_equal(before[1], edges)


def test_an_empty_chain() -> None:
    nothing = np.empty((0, 3)), np.empty((0, 3, 3))
    assert messages.max_marginals(*nothing).shape == (0, 3)
    whole, without = messages.log_partition_without(*nothing)
    assert [whole, *without] == [0.0] * 4


def test_what_is_dropped_far_below_the_largest_may_still_decide() -> None:
    """The best state of the first node has no way on: numbers that are not logarithms would have lost the other."""
    nodes, edges = np.zeros((3, 2)), np.zeros((2, 2, 2))
    nodes[0] = 0.0, -800.0
    edges[0, 0] = -2000.0
    assert messages.log_partition_without(nodes, edges)[0] == pytest.approx(-800 + 2 * math.log(2))
