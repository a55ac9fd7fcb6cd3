"""The operators of chains: values and gradients of the tensor forms, for any batch, under `vmap` and with fake tensors."""

import pytest
import torch
from support import assert_close, normal
from torch import Tensor
from torch._subclasses.fake_tensor import FakeTensorMode

from torchcrf_scan.inference.messages import chain_beliefs, chain_messages, log_partition, normalise_beliefs, reduce_states
from torchcrf_scan.loops.chains import MARGINALS, MAX_MARGINALS, PULL_MAX_MARGINALS, LogPartition, MaxMarginals, totals_without

SIZES = [(1, 1, 1), (2, 1, 3), (3, 7, 4), (2, 40, 9), (1, 2, 2)]


def chains(B: int, N: int, S: int, *, scale: float = 1.0, dtype: torch.dtype = torch.float64) -> tuple[Tensor, Tensor]:
    """Potentials of B chains, some states of which are impossible."""
    nodes, edges = scale * normal(B, N, S, seed=N + S), scale * normal(B, max(N - 1, 0), S, S, seed=N)
    if S > 2:
        nodes[:, ::3, 1] = -torch.inf
    return nodes.to(dtype).requires_grad_(), edges.to(dtype).requires_grad_()


def beliefs_in_tensors(nodes: Tensor, edges: Tensor) -> Tensor:
    return normalise_beliefs(nodes + sum(chain_messages(nodes, edges)), 0.0)


def total_in_tensors(nodes: Tensor, edges: Tensor) -> Tensor:
    total = nodes[:, 0]
    for node, edge in zip(nodes.unbind(1)[1:], edges.unbind(1), strict=True):
        total = reduce_states(total[:, :, None] + edge, 1, 1.0) + node
    return reduce_states(total, -1, 1.0)


@pytest.mark.parametrize("size", SIZES)
def test_beliefs_and_their_gradients_are_those_of_the_tensors(size: tuple[int, int, int]) -> None:
    potentials = chains(*size)
    slope = normal(*size, seed=3)
    found, expected = MaxMarginals.apply(*potentials), beliefs_in_tensors(*potentials)
    assert_close(found.detach(), expected.detach())
    for mine, theirs in zip(
        *(torch.autograd.grad((torch.where(of.isfinite(), of, 0.0) * slope).sum(), potentials) for of in (found, expected)),
        strict=True,
    ):
        assert_close(mine, theirs.nan_to_num())


@pytest.mark.parametrize("scale", [1.0, 400.0])
@pytest.mark.parametrize("size", SIZES)
def test_totals_and_marginals_are_those_of_the_tensors(size: tuple[int, int, int], scale: float) -> None:
    potentials = chains(*size, scale=scale)
    slope = normal(size[0], seed=3)
    found, expected = log_partition(*potentials), total_in_tensors(*potentials)
    assert_close(found.detach(), expected.detach())
    for mine, theirs in zip(
        *(torch.autograd.grad((of * slope).sum(), potentials, materialize_grads=True) for of in (found, expected)), strict=True
    ):
        assert_close(mine, theirs, tolerance=1e-8)


def test_totals_without_a_state() -> None:
    nodes, edges = (of.detach() for of in chains(3, 9, 4))
    whole, without = totals_without(nodes, edges)
    assert_close(whole, total_in_tensors(nodes, edges))
    for state in range(4):
        left = nodes.clone()
        left[..., state] = -torch.inf
        assert_close(without[:, state], total_in_tensors(left, edges))


@pytest.mark.parametrize("scale", [0.0, 3.0])
def test_totals_of_a_long_chain_stay_in_range(scale: float) -> None:
    """900 alike nodes, as of padding, have 8^900 labellings: more than a double holds."""
    nodes, edges = scale * normal(2, 900, 8, seed=1), scale * normal(2, 899, 8, 8, seed=2)
    whole, without = totals_without(nodes, edges)
    assert_close(whole, total_in_tensors(nodes, edges))
    assert_close(without[:, 3], total_in_tensors(nodes.index_fill(2, torch.tensor([3]), -torch.inf), edges))


def test_impossible_chains() -> None:
    nodes = torch.full((1, 3, 2), -torch.inf, dtype=torch.float64, requires_grad=True)
    edges = torch.zeros(1, 2, 2, 2, dtype=torch.float64)
    total = LogPartition.apply(nodes, edges)[0]
    assert total.tolist() == [-torch.inf]
    total.sum().backward()
    assert nodes.grad is not None
    assert nodes.grad.tolist() == [[[0.0, 0.0]] * 3]
    assert MaxMarginals.apply(nodes, edges).isneginf().all()


def test_no_chain_and_no_node() -> None:
    assert MaxMarginals.apply(torch.zeros(0, 3, 2), torch.zeros(0, 2, 2, 2)).shape == (0, 3, 2)
    assert MaxMarginals.apply(torch.zeros(2, 0, 2), torch.zeros(2, 0, 2, 2)).shape == (2, 0, 2)
    assert log_partition(torch.zeros(2, 0, 2), torch.zeros(2, 0, 2, 2)).tolist() == [0.0, 0.0]


@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
def test_other_precisions_keep_their_dtype(dtype: torch.dtype) -> None:
    nodes, edges = chains(2, 5, 3, dtype=dtype)
    found = MaxMarginals.apply(nodes, edges)
    assert found.dtype == dtype
    torch.where(found.isfinite(), found, 0.0).sum().backward()
    assert nodes.grad is not None
    assert nodes.grad.dtype == dtype


def test_operators_are_well_formed() -> None:
    nodes, edges = (of.detach() for of in chains(2, 6, 3))
    beliefs = MAX_MARGINALS(nodes, edges)
    checks = ("test_schema", "test_faketensor")
    torch.library.opcheck(MAX_MARGINALS, (nodes, edges), test_utils=checks)
    torch.library.opcheck(MARGINALS, (nodes, edges), test_utils=checks)
    torch.library.opcheck(PULL_MAX_MARGINALS, (nodes, edges, beliefs, torch.ones_like(beliefs)), test_utils=checks)


def test_vmap_is_the_loop() -> None:
    nodes, edges = (of.detach() for of in chains(2, 6, 3))
    scales = torch.tensor([0.5, 1.0, 2.0], dtype=torch.float64)

    def beliefs(scale: Tensor) -> Tensor:
        return MaxMarginals.apply(nodes * scale, edges)

    def slope(scale: Tensor) -> Tensor:
        return torch.func.grad(lambda s: log_partition(nodes.clamp(min=-9) * s, edges).sum())(scale)

    assert_close(torch.func.vmap(beliefs)(scales), torch.stack([beliefs(scale) for scale in scales]))
    assert_close(torch.func.vmap(slope)(scales), torch.stack([slope(scale) for scale in scales]))


@pytest.mark.filterwarnings("ignore:.*should not be instantiated:DeprecationWarning")  # by the compiler itself
def test_a_program_is_compiled_with_them() -> None:
    nodes, edges = (of.detach() for of in chains(2, 6, 3))
    mask = torch.ones(2, 6, dtype=torch.bool)

    def beliefs(nodes: Tensor, edges: Tensor) -> Tensor:
        return chain_beliefs(nodes, edges, mask, in_loops=True)

    compiled = torch.compile(beliefs, backend="aot_eager", fullgraph=True)
    assert torch.equal(compiled(nodes, edges), beliefs(nodes, edges))


def test_fake_tensors_have_the_shapes() -> None:
    with FakeTensorMode():
        nodes, edges = torch.zeros(4, 6, 3), torch.zeros(4, 5, 3, 3)
        assert MaxMarginals.apply(nodes, edges).shape == (4, 6, 3)
        assert log_partition(nodes, edges).shape == (4,)
