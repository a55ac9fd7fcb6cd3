import math

import numpy as np
import oracles
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from support import all_real, assert_close, generator, make_points, normal
from torch import Tensor

from torchcrf_scan.features.association import pairwise_features, shape_features
from torchcrf_scan.features.candidates import every_target
from torchcrf_scan.features.scales import Scales
from torchcrf_scan.features.shape import describe
from torchcrf_scan.inference.messages import (
    chain_beliefs,
    chain_messages,
    log_partition,
    normalise,
    pass_in_blocks,
    pass_node_by_node,
    reduce_states,
    silence_padding,
)

SEEDS = st.integers(0, 10_000)
NODES, STATES = st.integers(1, 6), st.integers(1, 5)
TEMPERATURES = st.sampled_from([0.0, 1.0])
LIMIT = 2_000  # labellings that an oracle may enumerate


def make_chain(N: int, S: int, seed: int, *, impossible: bool = False) -> tuple[Tensor, Tensor]:
    """Potentials of one chain; with `impossible`, a third of the entries is -inf, but never those of state 0."""
    unary, pairwise = 2 * normal(1, N, S, seed=seed), 2 * normal(1, N - 1, S, S, seed=seed + 1)
    if impossible:
        for potentials, keep in ((unary, (..., 0)), (pairwise, (..., 0, 0))):
            mask = torch.rand(potentials.shape, generator=generator(seed)) < 1 / 3
            mask[keep] = False
            potentials.masked_fill_(mask, -torch.inf)
    return unary, pairwise


def enumerable(N: int, S: int) -> int:
    """Fewer nodes where there would be too many labellings to enumerate."""
    return max(n for n in range(1, N + 1) if n == 1 or S**n <= LIMIT)


@given(NODES, STATES, TEMPERATURES, st.booleans(), SEEDS)
def test_beliefs_equal_brute_force(N: int, S: int, temperature: float, impossible: bool, seed: int) -> None:
    unary, pairwise = make_chain(enumerable(N, S), S, seed, impossible=impossible)
    found = chain_beliefs(unary, pairwise, all_real(unary), temperature)
    assert_close(found[0], oracles.log_marginals(unary[0].numpy(), pairwise[0].numpy(), temperature))
    assert_close(found.exp().sum(-1), torch.ones(found.shape[:2]))


@given(NODES, STATES, st.booleans(), SEEDS)
def test_the_best_states_are_the_best_labelling(N: int, S: int, impossible: bool, seed: int) -> None:
    unary, pairwise = make_chain(enumerable(N, S), S, seed, impossible=impossible)
    labels = chain_beliefs(unary, pairwise, all_real(unary))[0].argmax(-1).tolist()
    assert tuple(labels) == oracles.best_labelling(unary[0].numpy(), pairwise[0].numpy())
    best = oracles.score(unary[0].numpy(), pairwise[0].numpy(), labels)
    assert best <= float(log_partition(unary, pairwise)) + 1e-9


@pytest.mark.parametrize("temperature", [0.0, 1.0])
@pytest.mark.parametrize("impossible", [False, True])
def test_the_largest_graph_equals_brute_force(temperature: float, impossible: bool) -> None:
    unary, pairwise = make_chain(6, 5, 7, impossible=impossible)
    scores = unary[0, 0]
    for i in range(1, 6):  # (5,) * (i + 1), one axis a node
        scores = scores[..., None] + pairwise[0, i - 1] + unary[0, i]
    joint = scores.flatten()
    expected = joint.max() if temperature == 0 else joint.logsumexp(0)
    assert_close(log_partition(unary, pairwise, temperature), expected[None])
    beliefs = chain_beliefs(unary, pairwise, all_real(unary), temperature)[0]
    for i in range(6):
        others = [axis for axis in range(6) if axis != i]
        marginal = scores.amax(others) if temperature == 0 else scores.logsumexp(others)
        assert_close(beliefs[i], marginal.log_softmax(0))


@given(NODES, STATES, st.sampled_from([0.0, 0.5, 1.0, 2.0]), st.booleans(), SEEDS)
def test_log_partition_equals_brute_force(N: int, S: int, temperature: float, impossible: bool, seed: int) -> None:
    unary, pairwise = make_chain(enumerable(N, S), S, seed, impossible=impossible)
    expected = oracles.log_partition(unary[0].numpy(), pairwise[0].numpy(), temperature)
    assert_close(log_partition(unary, pairwise, temperature), [expected])


@given(NODES, STATES, st.booleans(), SEEDS)
def test_marginals_are_the_gradient_of_the_log_partition(N: int, S: int, impossible: bool, seed: int) -> None:
    unary, pairwise = make_chain(N, S, seed, impossible=impossible)
    unary.requires_grad_()
    (gradient,) = torch.autograd.grad(log_partition(unary, pairwise).sum(), unary)
    assert_close(gradient, chain_beliefs(unary.detach(), pairwise, all_real(unary), 1.0).exp())


@given(NODES, STATES, SEEDS)
def test_the_gradient_at_temperature_0_is_the_best_labelling(N: int, S: int, seed: int) -> None:
    unary, pairwise = make_chain(enumerable(N, S), S, seed)
    unary.requires_grad_()
    (gradient,) = torch.autograd.grad(log_partition(unary, pairwise, 0).sum(), unary)
    best = oracles.best_labelling(unary[0].detach().numpy(), pairwise[0].numpy())
    assert_close(gradient[0], torch.nn.functional.one_hot(torch.tensor(best), S))


def test_a_small_temperature_is_nearly_max_product() -> None:
    unary, pairwise = make_chain(6, 4, 1)
    cold = chain_beliefs(unary, pairwise, all_real(unary), 1e-3)
    assert torch.equal(cold.argmax(-1), chain_beliefs(unary, pairwise, all_real(unary), 0).argmax(-1))
    assert_close(log_partition(unary, pairwise, 1e-3), log_partition(unary, pairwise, 0), tolerance=1e-2)


def test_messages_by_hand() -> None:
    unary = torch.tensor([[[1.0, 0.0], [2.0, 0.0]]])
    pairwise = torch.tensor([[[[0.0, 3.0], [0.0, -1.0]]]])
    forward, backward = chain_messages(unary, pairwise)
    assert forward.tolist() == [[[0.0, 0.0], [-3.0, 0.0]]]  # max(1+0, 0+0) = 1 and max(1+3, 0-1) = 4, less the larger
    assert backward.tolist() == [[[0.0, -1.0], [0.0, 0.0]]]  # max(0+2, 3+0) = 3 and max(0+2, -1+0) = 2


@given(st.integers(2, 6), st.integers(2, 5), TEMPERATURES, SEEDS)
def test_a_message_never_answers_its_target(N: int, S: int, temperature: float, seed: int) -> None:
    unary, pairwise = make_chain(N, S, seed)
    forward, backward = chain_messages(unary, pairwise, temperature)
    changed = unary.clone()
    changed[:, N // 2] += normal(S, seed=seed + 2)
    new_forward, new_backward = chain_messages(changed, pairwise, temperature)
    assert torch.equal(new_forward[:, : N // 2 + 1], forward[:, : N // 2 + 1])
    assert torch.equal(new_backward[:, N // 2 :], backward[:, N // 2 :])
    assert not forward[:, 0].any()
    assert not backward[:, -1].any()


@given(NODES, STATES, TEMPERATURES, SEEDS)
def test_messages_are_normalised(N: int, S: int, temperature: float, seed: int) -> None:
    for messages in chain_messages(*make_chain(N, S, seed, impossible=True), temperature):
        assert_close(messages.amax(-1), torch.zeros(1, N))


@pytest.mark.parametrize("temperature", [0.0, 1.0])
def test_a_reversed_chain_has_reversed_beliefs(temperature: float) -> None:
    unary, pairwise = make_chain(6, 4, 2)
    turned = chain_beliefs(unary.flip(1), pairwise.flip(1).mT, all_real(unary), temperature)
    assert_close(turned.flip(1), chain_beliefs(unary, pairwise, all_real(unary), temperature))


@given(NODES, STATES, TEMPERATURES, st.floats(-1e3, 1e3), SEEDS)
def test_a_constant_changes_no_belief(N: int, S: int, temperature: float, constant: float, seed: int) -> None:
    unary, pairwise = make_chain(N, S, seed)
    mask = all_real(unary)
    shifted = chain_beliefs(unary + constant, pairwise - 2 * constant, mask, temperature)
    assert_close(shifted, chain_beliefs(unary, pairwise, mask, temperature))


def test_long_chains_neither_overflow_nor_vanish() -> None:
    unary, pairwise = (50 * potentials.float() for potentials in make_chain(2000, 3, 0))
    for temperature in (0.0, 1.0):
        beliefs = chain_beliefs(unary, pairwise, all_real(unary), temperature)
        assert beliefs.isfinite().all()
        assert_close(beliefs.exp().sum(-1), torch.ones(1, 2000))


# Padding and batches.


@given(
    st.lists(NODES, min_size=1, max_size=4),
    STATES,
    TEMPERATURES,
    st.integers(0, 3),
    st.sampled_from([7.0, -math.inf, math.nan]),
    SEEDS,
)
def test_padding_and_other_chains_are_invisible(
    lengths: list[int], S: int, temperature: float, extra: int, rubbish: float, seed: int
) -> None:
    chains = [make_chain(n, S, seed + b, impossible=b % 2 == 0) for b, n in enumerate(lengths)]
    N = max(lengths) + extra
    unary, pairwise = torch.full((len(chains), N, S), rubbish).double(), torch.full((len(chains), N - 1, S, S), rubbish).double()
    for b, (own_unary, own_pairwise) in enumerate(chains):
        unary[b, : lengths[b]], pairwise[b, : lengths[b] - 1] = own_unary[0], own_pairwise[0]
    mask = torch.arange(N) < torch.tensor(lengths)[:, None]
    together = chain_beliefs(unary, pairwise, mask, temperature)
    for b, (own_unary, own_pairwise) in enumerate(chains):
        alone = chain_beliefs(own_unary, own_pairwise, all_real(own_unary), temperature)
        assert_close(together[b, : lengths[b]], alone[0])


def test_padding_gets_no_gradient() -> None:
    unary, pairwise = (potentials.requires_grad_() for potentials in make_chain(5, 3, 0))
    mask = torch.arange(5)[None] < 3
    for temperature in (0.0, 1.0):
        value = chain_beliefs(unary, pairwise, mask, temperature)[:, :3, 0].sum()
        of_unary, of_pairwise = torch.autograd.grad(value, (unary, pairwise))
        assert not of_unary[:, 3:].any()
        assert not of_pairwise[:, 2:].any()
        assert of_unary[:, :3].any()


def test_silence_padding_keeps_what_is_real() -> None:
    unary, pairwise = make_chain(4, 2, 0)
    silent_unary, silent_pairwise = silence_padding(unary, pairwise, torch.tensor([[True, True, False, False]]))
    assert torch.equal(silent_unary[:, :2], unary[:, :2])
    assert torch.equal(silent_pairwise[:, :1], pairwise[:, :1])
    assert not silent_unary[:, 2:].any()
    assert not silent_pairwise[:, 1:].any()


def test_a_chain_of_padding_alone_is_finite() -> None:
    unary, pairwise = make_chain(3, 4, 0)
    beliefs = chain_beliefs(unary, pairwise, ~all_real(unary), 1.0)
    assert_close(beliefs, torch.full((1, 3, 4), -math.log(4), dtype=torch.float64))


def test_batch_equals_loop() -> None:
    unary, pairwise = normal(3, 5, 4, seed=1), normal(3, 4, 4, 4, seed=2)
    for temperature in (0.0, 1.0):
        together = chain_beliefs(unary, pairwise, all_real(unary), temperature)
        totals = log_partition(unary, pairwise, temperature)
        for b in range(3):
            one = slice(b, b + 1)
            assert_close(together[one], chain_beliefs(unary[one], pairwise[one], all_real(unary[one]), temperature))
            assert_close(totals[one], log_partition(unary[one], pairwise[one], temperature))


# Impossible states.


def test_reduce_states() -> None:
    values = torch.tensor([[0.0, 1.0], [-torch.inf, 2.0], [-torch.inf, -torch.inf]])
    assert reduce_states(values, -1, 0).tolist() == [1.0, 2.0, -math.inf]
    assert_close(reduce_states(values, -1, 1.0), [math.log(1 + math.e), 2.0, -math.inf])
    assert_close(reduce_states(values, 0, 0.5), [0.0, 0.5 * math.log(math.exp(2) + math.exp(4))])
    assert_close(reduce_states(torch.tensor([1e4, 1e4]), 0, 1.0), 1e4 + math.log(2), tolerance=1e-6)


def test_an_impossible_message_stays_impossible() -> None:
    messages = torch.tensor([[-torch.inf, -torch.inf], [-torch.inf, 3.0]])
    assert normalise(messages).tolist() == [[-math.inf, -math.inf], [-math.inf, 0.0]]


@pytest.mark.parametrize("temperature", [0.0, 1.0])
def test_gradients_with_impossible_states_are_finite(temperature: float) -> None:
    unary, pairwise = (potentials.requires_grad_() for potentials in make_chain(6, 4, 3, impossible=True))
    beliefs = chain_beliefs(unary, pairwise, all_real(unary), temperature)
    possible = beliefs[beliefs > -torch.inf].sum() + log_partition(unary, pairwise, temperature).sum()
    for gradient in torch.autograd.grad(possible, (unary, pairwise)):
        assert gradient.isfinite().all()


@pytest.mark.parametrize("temperature", [0.0, 1.0])
def test_an_impossible_chain_is_impossible_and_spoils_no_other(temperature: float) -> None:
    unary, pairwise = normal(2, 4, 3, seed=1), normal(2, 3, 3, 3, seed=2)
    expected = chain_beliefs(unary, pairwise, all_real(unary), temperature)
    unary[0, 2] = -torch.inf
    found = chain_beliefs(unary, pairwise, all_real(unary), temperature)
    assert log_partition(unary, pairwise, temperature)[0].item() == -math.inf
    assert_close(found[1], expected[1])
    assert_close(found[0], torch.full((4, 3), -torch.inf))


# Gradients.


def test_gradient_of_beliefs() -> None:
    unary, pairwise = (potentials.requires_grad_() for potentials in (normal(2, 4, 3), normal(2, 3, 3, 3, seed=1)))
    mask = torch.tensor([[True] * 4, [True, True, True, False]])
    assert torch.autograd.gradcheck(lambda u, p: chain_beliefs(u, p, mask, 1.0), (unary, pairwise))
    assert torch.autograd.gradcheck(lambda u, p: chain_beliefs(u, p, mask, 0.0), (unary, pairwise))  # no ties here


@pytest.mark.parametrize("temperature", [0.0, 0.7, 1.0])
def test_gradient_of_the_log_partition(temperature: float) -> None:
    unary, pairwise = (potentials.requires_grad_() for potentials in (normal(2, 4, 3), normal(2, 3, 3, 3, seed=1)))
    assert torch.autograd.gradcheck(lambda u, p: log_partition(u, p, temperature), (unary, pairwise))


# With features.


@given(st.integers(2, 12), SEEDS)
def test_identical_scans_are_matched_point_by_point(n: int, seed: int) -> None:
    points, scales = make_points(n, seed)[None], Scales().double()
    shape, candidates = describe(points, all_real(points), torch.tensor([False])), every_target(points, all_real(points))[0]
    inliers = shape_features(shape, shape, candidates, scales).sum(-1)
    unary = torch.cat([inliers, torch.full((1, n, 1), -9.0)], dim=-1).double()
    pairwise = pairwise_features(points, points, candidates, scales) @ torch.tensor([1.0, -1.0, 1.0, 1.0]).double()
    labels = chain_beliefs(unary, pairwise, all_real(points)).argmax(-1)
    assert labels[0].tolist() == np.arange(n).tolist()


@given(st.integers(0, 40), STATES, st.sampled_from([0.0, 0.5, 1.0]), st.booleans(), SEEDS)
def test_blocks_pass_on_what_node_after_node_passes_on(E: int, S: int, temperature: float, impossible: bool, seed: int) -> None:
    unary, pairwise = make_chain(E + 1, S, seed, impossible=impossible)
    edges = (unary[:, :-1, :, None] + pairwise).requires_grad_()
    found, expected = (pass_on(edges, temperature) for pass_on in (pass_in_blocks, pass_node_by_node))
    assert_close(found, expected)
    if E and not impossible:
        slopes = normal(*found.shape, seed=seed)
        assert_close(*(torch.autograd.grad((m * slopes).sum(), edges)[0] for m in (found, expected)))
