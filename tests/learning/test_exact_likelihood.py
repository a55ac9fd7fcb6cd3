"""The exact likelihood of a chain: against enumeration, over stacked batches, and as an objective."""

from dataclasses import replace
from itertools import pairwise as pairwise_of

import oracles
import pytest
import torch
from support import assert_close, normal

from torchcrf_scan.batch import ScanPairBatch
from torchcrf_scan.config import InferenceConfig
from torchcrf_scan.data.simulate import simulate_pairs
from torchcrf_scan.data.worlds import SimulatorConfig
from torchcrf_scan.features.potentials import Boosters, PairView
from torchcrf_scan.features.scales import Scales
from torchcrf_scan.inference.pseudo_likelihood import Chain, association_chain, clustering_chain, true_plugins
from torchcrf_scan.learning.settings import LearningConfig
from torchcrf_scan.learning.weights_fit import fit_chain, stack


def make_chain(B: int, N: int, S: int, seed: int) -> Chain:
    """Random features of three unary and two pairwise weights; everything is known and possible."""
    generator = torch.Generator().manual_seed(seed)
    unary = torch.randn(B, N, S, 3, generator=generator, dtype=torch.float64)
    pairwise = torch.randn(B, N - 1, S, S, 2, generator=generator, dtype=torch.float64)
    label = torch.randint(S, (B, N), generator=generator)
    return Chain(unary, pairwise, torch.ones(B, N, S, dtype=torch.bool), label, torch.ones(B, N, dtype=torch.bool))


WEIGHTS = torch.tensor([0.5, -1.0, 0.3, 0.8, -0.2], dtype=torch.float64)


def test_it_equals_enumeration():
    chain = make_chain(2, 4, 3, 0)
    found = chain.log_likelihood(WEIGHTS)
    for b in range(2):
        unary, pairwise = (chain.unary[b] @ WEIGHTS[:3]).numpy(), (chain.pairwise[b] @ WEIGHTS[3:]).numpy()
        label = chain.label[b].tolist()
        score = sum(unary[i, s] for i, s in enumerate(label))
        score += sum(pairwise[i, s, t] for i, (s, t) in enumerate(pairwise_of(label)))
        assert_close(found[b], torch.tensor(score - oracles.log_partition(unary, pairwise)))


def test_an_unknown_node_cuts_the_chain_and_an_impossible_state_takes_no_part():
    chain = make_chain(1, 5, 3, 1)
    known = chain.known.clone()
    known[0, 2] = False
    cut = replace(chain, known=known).log_likelihood(WEIGHTS)
    parts = [
        Chain(chain.unary[:, a:b], chain.pairwise[:, a : b - 1], chain.mask[:, a:b], chain.label[:, a:b], chain.known[:, a:b])
        for a, b in ((0, 2), (3, 5))
    ]
    assert_close(cut, sum(part.log_likelihood(WEIGHTS) for part in parts))


def test_stacked_batches_are_the_sum_of_their_parts():
    parts = [make_chain(2, 4, 3, 2), make_chain(1, 6, 5, 3)]
    together = stack(parts)
    expected = torch.cat([part.log_likelihood(WEIGHTS) for part in parts])
    assert_close(together.log_likelihood(WEIGHTS), expected)


def test_a_batch_is_its_pairs():
    pairs = [simulate_pairs(SimulatorConfig(beams=beams), 1, 1, 5)[0] for beams in (31, 61, 23)]

    def values(some):
        batch = ScanPairBatch.collate(some, torch.float64)
        batch.truth.known[:, 3] = False
        plugins, scales, boosters = true_plugins(batch, 4), Scales().double(), Boosters(1).double()
        association = association_chain(PairView.of(batch), plugins, scales, boosters, InferenceConfig(candidates=4))
        clustering = clustering_chain(PairView.of(batch), plugins, scales)
        return torch.stack([association.log_likelihood(normal(23)), clustering.log_likelihood(normal(21))])

    assert_close(values(pairs), torch.cat([values([pair]) for pair in pairs], dim=-1))


@pytest.mark.parametrize("objective", ["pseudo_likelihood", "likelihood"])
def test_the_fit_is_an_optimum_of_its_objective(objective: str):
    chain = make_chain(8, 6, 3, 4)
    live = torch.ones(5, dtype=torch.float64)
    live[1] = 0
    config = LearningConfig(objective=objective, prior=1e3, tolerance=1e-7)
    weights = fit_chain([chain], live, config)
    assert weights[1] == 0

    def value(w: torch.Tensor) -> torch.Tensor:
        of_nodes = chain.design().log_likelihood(w).sum()
        return of_nodes if objective == "pseudo_likelihood" else chain.log_likelihood(w).sum()

    slope = torch.func.grad(value)(weights)
    assert (slope[live > 0].abs() < 1e-3).all()
