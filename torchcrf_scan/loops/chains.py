"""Max-marginals and partition functions of B chains by the loops, as operators of torch with gradients, `vmap` and fake tensors.

    torchcrf_scan::max_marginals       (B, N, S) nodes, (B, N-1, S, S) edges -> (B, N, S) log-beliefs
    torchcrf_scan::pull_max_marginals  its way back
    torchcrf_scan::marginals           -> (B,) log Z, and its slopes, the marginals of nodes and of edges

The tensor forms in `inference.messages` are for other devices, other temperatures and exported programs.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from torchcrf_scan.loops.jit import Array, entry
from torchcrf_scan.loops.messages import log_partition_without, max_marginals, sum_marginals
from torchcrf_scan.loops.pair import array_of
from torchcrf_scan.loops.pull_messages import pull_max_marginals
from torchcrf_scan.loops.threads import for_each


@entry
def beliefs_of_chain(log_unary: Array, log_pairwise: Array) -> Array:
    """`max_marginals`."""
    return max_marginals(log_unary, log_pairwise)


@entry
def pull_beliefs_of_chain(log_unary: Array, log_pairwise: Array, log_beliefs: Array, slopes: Array) -> tuple[Array, Array]:
    """`pull_max_marginals`."""
    return pull_max_marginals(log_unary, log_pairwise, log_beliefs, slopes)


@entry
def marginals_of_chain(log_unary: Array, log_pairwise: Array) -> tuple[float, Array, Array]:
    """`sum_marginals`."""
    return sum_marginals(log_unary, log_pairwise)


@entry
def totals_of_chain(log_unary: Array, log_pairwise: Array) -> tuple[float, Array]:
    """`log_partition_without`."""
    return log_partition_without(log_unary, log_pairwise)


@torch.no_grad()
def totals_without(log_unary: Tensor, log_pairwise: Tensor) -> tuple[Tensor, Tensor]:
    """(B,) log Z of B chains, and (B, S) log Z where no node has a state, for every state."""
    rows = _of_chains(totals_of_chain, log_unary, log_pairwise)
    whole = torch.tensor([total for total, _ in rows], dtype=torch.float64).to(log_unary)
    return whole, _stacked([without for _, without in rows], log_unary[:, 0])


def _of_chains(function: Callable[..., Any], *batches: Tensor) -> list[Any]:
    """function(row, ...) of every chain."""
    arrays = [array_of(batch) for batch in batches]
    return for_each(lambda b: function(*(array[b] for array in arrays)), range(len(arrays[0])))


def _stacked(rows: list[Any], like: Tensor) -> Tensor:
    return torch.from_numpy(np.stack(rows)).to(like) if rows else torch.zeros_like(like)


def _max_marginals(log_unary: Tensor, log_pairwise: Tensor) -> Tensor:
    return _stacked(_of_chains(beliefs_of_chain, log_unary, log_pairwise), log_unary)


def _pull_max_marginals(log_unary: Tensor, log_pairwise: Tensor, log_beliefs: Tensor, slopes: Tensor) -> tuple[Tensor, Tensor]:
    rows = _of_chains(pull_beliefs_of_chain, log_unary, log_pairwise, log_beliefs, slopes)
    return _stacked([nodes for nodes, _ in rows], log_unary), _stacked([edges for _, edges in rows], log_pairwise)


def _marginals(log_unary: Tensor, log_pairwise: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    rows = _of_chains(marginals_of_chain, log_unary, log_pairwise)
    totals = torch.tensor([total for total, _, _ in rows], dtype=torch.float64).to(log_unary)
    return totals, _stacked([nodes for _, nodes, _ in rows], log_unary), _stacked([edges for *_, edges in rows], log_pairwise)


def _alike(*tensors: Tensor) -> tuple[Tensor, ...]:
    return tuple(torch.empty_like(tensor, memory_format=torch.contiguous_format) for tensor in tensors)


def _define(name: str, schema: str, function: Callable[..., Any], fake: Callable[..., Any]) -> Any:
    """An operator with its fake kernel, and a rule for `vmap`: more chains."""
    qualified = f"torchcrf_scan::{name}"
    torch.library.define(qualified, schema)
    torch.library.impl(qualified, "cpu", function)
    torch.library.register_fake(qualified, fake)
    operator = getattr(torch.ops.torchcrf_scan, name)

    def over_more(info: Any, places: tuple[int | None, ...], *tensors: Tensor) -> tuple[Any, Any]:
        rows = [
            (of.expand(info.batch_size, *of.shape) if place is None else of.movedim(place, 0)).flatten(0, 1)
            for of, place in zip(tensors, places, strict=True)
        ]
        found = operator(*rows)
        if isinstance(found, Tensor):
            return found.unflatten(0, (info.batch_size, -1)), 0
        return tuple(of.unflatten(0, (info.batch_size, -1)) for of in found), (0,) * len(found)

    torch.library.register_vmap(qualified, over_more)
    return operator


MAX_MARGINALS = _define(
    "max_marginals", "(Tensor log_unary, Tensor log_pairwise) -> Tensor", _max_marginals, lambda u, p: _alike(u)[0]
)
PULL_MAX_MARGINALS = _define(
    "pull_max_marginals",
    "(Tensor log_unary, Tensor log_pairwise, Tensor log_beliefs, Tensor slopes) -> (Tensor, Tensor)",
    _pull_max_marginals,
    lambda u, p, b, s: _alike(u, p),
)
MARGINALS = _define(
    "marginals",
    "(Tensor log_unary, Tensor log_pairwise) -> (Tensor, Tensor, Tensor)",
    _marginals,
    lambda u, p: (u.new_empty(u.shape[0]), *_alike(u, p)),
)


class MaxMarginals(torch.autograd.Function):
    """(B, N, S) normalised log max-marginals of (B, N, S) nodes and (B, N-1, S, S) edges."""

    generate_vmap_rule = True

    @staticmethod
    def forward(log_unary: Tensor, log_pairwise: Tensor) -> Tensor:
        """See `max_marginals`."""
        found: Tensor = MAX_MARGINALS(log_unary, log_pairwise)
        return found

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Tensor, Tensor], output: Tensor) -> None:
        """Keeps what the way back needs."""
        ctx.save_for_backward(*inputs, output)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, slopes: Tensor) -> tuple[Tensor, Tensor]:
        """Slopes of the potentials."""
        found: tuple[Tensor, Tensor] = PULL_MAX_MARGINALS(*ctx.saved_tensors, slopes)
        return found


class LogPartition(torch.autograd.Function):
    """(B,) log of the summed score of all labellings; its slopes are the marginals of nodes and edges."""

    generate_vmap_rule = True

    @staticmethod
    def forward(log_unary: Tensor, log_pairwise: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """See `sum_marginals`."""
        found: tuple[Tensor, Tensor, Tensor] = MARGINALS(log_unary, log_pairwise)
        return found

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Tensor, Tensor], output: tuple[Tensor, Tensor, Tensor]) -> None:
        """Keeps the marginals."""
        ctx.mark_non_differentiable(*output[1:])
        ctx.save_for_backward(*output[1:])

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, slope: Tensor, *_: Tensor) -> tuple[Tensor, Tensor]:
        """Slopes of the potentials."""
        nodes, edges = ctx.saved_tensors
        return slope[:, None, None] * nodes, slope[:, None, None, None] * edges
