"""Exact messages on a chain, in the log domain: max-product, sum-product and temperatures in between (the paper's Eqs. 2 and 3)."""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor

from torchcrf_scan.loops.chains import LogPartition, MaxMarginals
from torchcrf_scan.loops.choice import has_operators

LARGEST_BLOCKS = 4_000  # B S^3 above which the S-fold arithmetic of blocks costs more than the steps that it saves


def reduce_states(log_values: Tensor, dim: int, temperature: float) -> Tensor:
    """max at temperature 0, temperature * logsumexp(x / temperature) above; -inf if all entries are."""
    if temperature == 0:
        return log_values.amax(dim)
    peak = log_values.detach().amax(dim, keepdim=True)
    peak = torch.where(peak > -torch.inf, peak, torch.zeros_like(peak))
    total = torch.exp((log_values - peak) / temperature).sum(dim)
    positive = total > 0
    log_total = torch.log(torch.where(positive, total, torch.ones_like(total)))
    return torch.where(positive, temperature * log_total + peak.squeeze(dim), torch.full_like(total, -torch.inf))


def normalise(log_message: Tensor) -> Tensor:
    """Subtracts the largest entry of the last axis; a message of -inf alone is unchanged."""
    peak = log_message.amax(-1, keepdim=True)
    return log_message - torch.where(peak > -torch.inf, peak, torch.zeros_like(peak)).detach()


def silence_padding(log_unary: Tensor, log_pairwise: Tensor, mask: Tensor) -> tuple[Tensor, Tensor]:
    """Potentials in which padded nodes, all at the end of a chain, send constant messages to the real ones. mask: (B, N)."""
    edge = mask[:, 1:, None, None]
    return (
        torch.where(mask[..., None], log_unary, torch.zeros_like(log_unary)),
        torch.where(edge, log_pairwise, torch.zeros_like(log_pairwise)),
    )


def chain_messages(log_unary: Tensor, log_pairwise: Tensor, temperature: float = 0.0) -> tuple[Tensor, Tensor]:
    """Forward and backward messages of B chains (spec 7.1), both directions at once.

    Args:
        log_unary: (B, N, S). log_pairwise: (B, N-1, S, S), row = state of node i, column = state of node i + 1.
        temperature: 0 = max-product, 1 = sum-product.

    Returns:
        (B, N, S) message into every node from the node before it and (B, N, S) from the node after it; 0 at the ends.
    """
    both_unary = torch.cat([log_unary, log_unary.flip(1)])  # (2B, N, S)
    both_pairwise = torch.cat([log_pairwise, log_pairwise.flip(1).transpose(-1, -2)])
    outgoing = both_unary[:, :-1, :, None] + both_pairwise  # (2B, N-1, S, S)
    first = torch.zeros_like(both_unary[:, :1])
    B, _, S = log_unary.shape
    pairs = 1 if torch.compiler.is_compiling() else B  # any number when compiled; size grows with the steps
    pass_on = pass_in_blocks if pairs * S**3 <= LARGEST_BLOCKS else pass_node_by_node
    forward, backward = torch.cat([first, pass_on(outgoing, temperature)], dim=1).unflatten(0, (2, B)).unbind()
    return forward, backward.flip(1)


def pass_node_by_node(outgoing: Tensor, temperature: float) -> Tensor:
    """(B, E, S, S) edge potentials, each with the unary of its first node, to (B, E, S) normalised outgoing messages; E steps."""
    message = torch.zeros_like(outgoing[:, :1, 0])[:, 0] if outgoing.shape[1] else outgoing[:, :0, 0]
    messages = []
    for edge in outgoing.unbind(1):
        message = normalise(reduce_states(edge + message[:, :, None], 1, temperature))
        messages.append(message)
    return torch.stack(messages, dim=1) if messages else outgoing[:, :, 0]


def pass_in_blocks(outgoing: Tensor, temperature: float) -> Tensor:
    """The same in about 2 sqrt(E) steps: sqrt(E) blocks in parallel, each for every entry state, then from block to block.

    S times the arithmetic in far fewer and larger operations, which is faster for few states.
    """
    B, E, S, _ = outgoing.shape
    length = max(1, math.isqrt(max(E, 1)))
    missing = -E % length
    stay = outgoing.new_zeros(S, S).masked_fill(~torch.eye(S, dtype=torch.bool, device=outgoing.device), -torch.inf)
    edges = torch.cat([outgoing, stay.expand(B, missing, S, S)], dim=1).unflatten(1, (-1, length))  # (B, blocks, length, S, S)
    across = list(edges[:, :, :1].unbind(2))  # from the entry of a block to each of its edges
    for edge in edges.unbind(2)[1:]:
        across.append(reduce_states(across[-1][..., None] + edge[:, :, None], -2, temperature))
    entry = torch.zeros_like(outgoing[:, :1, 0])[:, 0] if E else outgoing.new_zeros(B, S)
    entries = []
    for block in across[-1].unbind(1):
        entries.append(entry)
        entry = normalise(reduce_states(entry[:, :, None] + block, 1, temperature))
    if not entries:
        return outgoing[:, :, 0]
    entered = torch.stack(entries, dim=1)[:, :, None, :, None]  # (B, blocks, 1, S, 1)
    messages = normalise(reduce_states(entered + torch.stack(across, dim=2), -2, temperature))
    return messages.flatten(1, 2)[:, :E]


def chain_score(log_unary: Tensor, log_pairwise: Tensor, states: Tensor) -> Tensor:
    """(B,) score of one labelling, the sum of its log potentials. states: (B, N). Others as in `chain_messages`."""
    of_nodes = log_unary.gather(-1, states[..., None])[..., 0]
    rows = log_pairwise.gather(2, states[:, :-1, None, None].expand(-1, -1, 1, log_pairwise.shape[3]))[:, :, 0]
    of_edges = rows.gather(-1, states[:, 1:, None])[..., 0]
    return of_nodes.sum(-1) + of_edges.sum(-1)


def log_partition(log_unary: Tensor, log_pairwise: Tensor, temperature: float = 1.0) -> Tensor:
    """(B,) log of the summed (temperature 0: of the largest) score of all labellings. Arguments as in `chain_messages`.

    Above temperature 0 its gradient is computed as the marginals, by a backward pass; it is not differentiable twice.
    """
    if torch.compiler.is_compiling():
        return _total_by_halves(log_unary, log_pairwise, temperature)
    if temperature == 1 and has_operators(log_unary):
        total: Tensor = LogPartition.apply(log_unary, log_pairwise)[0]
        return total
    if temperature > 0:
        return _LogPartition.apply(log_unary, log_pairwise, temperature)[0]
    return _running_totals(log_unary, log_pairwise, temperature)[-1]


def _running_totals(log_unary: Tensor, log_pairwise: Tensor, temperature: float) -> list[Tensor]:
    """N tensors (B, S), the log-summed score of all prefixes that end at a node in a given state; last, the (B,) total."""
    totals = [log_unary[:, 0]]
    for node, edge in zip(log_unary.unbind(1)[1:], log_pairwise.unbind(1), strict=True):
        totals.append(reduce_states(totals[-1][:, :, None] + edge, 1, temperature) + node)
    return [*totals, reduce_states(totals[-1], -1, temperature)]


def _total_by_halves(log_unary: Tensor, log_pairwise: Tensor, temperature: float) -> Tensor:
    """(B,) the same total in log2(N) steps, each joining neighbouring segments: S times the arithmetic, but a small graph."""
    scores = log_pairwise + log_unary[:, 1:, None]  # (B, E, S, S) of every segment, by the state before it and its last state
    while (E := scores.shape[1]) > 1:
        left, right = scores[:, : E - E % 2 : 2], scores[:, 1::2]
        joined = reduce_states(left[..., None] + right[:, :, None], -2, temperature)
        scores = torch.cat([joined, scores[:, E - E % 2 :]], dim=1)
    last = log_unary[:, 0, :, None]
    last = reduce_states(last + scores[:, 0], 1, temperature) if E else last[..., 0]
    return reduce_states(last, -1, temperature)


class _LogPartition(torch.autograd.Function):
    """The log partition function, its gradient computed as marginals of nodes and edges: several times faster than autograd."""

    generate_vmap_rule = True

    @staticmethod
    def forward(log_unary: Tensor, log_pairwise: Tensor, temperature: float) -> tuple[Tensor, Tensor]:
        *ahead, total = _running_totals(log_unary, log_pairwise, temperature)
        return total, torch.stack(ahead, dim=1)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Tensor, Tensor, float], output: tuple[Tensor, Tensor]) -> None:
        log_unary, log_pairwise, ctx.temperature = inputs
        total, ahead = output
        ctx.mark_non_differentiable(ahead)
        ctx.save_for_backward(log_unary, log_pairwise, ahead, total)

    @staticmethod
    def backward(ctx: Any, slope: Tensor, _: Tensor) -> tuple[Tensor, Tensor, None]:
        log_unary, log_pairwise, ahead, total = ctx.saved_tensors
        back = _running_totals(log_unary.flip(1), log_pairwise.flip(1).mT, ctx.temperature)[:-1]
        after = torch.stack(back, dim=1).flip(1)  # (B, N, S)
        edges = ahead[:, :-1, :, None] + log_pairwise + after[:, 1:, None]
        nodes = ahead + after - torch.where(log_unary > -torch.inf, log_unary, torch.zeros_like(log_unary))
        return _share(nodes, total, slope, ctx.temperature), _share(edges, total, slope, ctx.temperature), None


def _share(log_scores: Tensor, total: Tensor, slope: Tensor, temperature: float) -> Tensor:
    """slope * exp((scores - total) / temperature), 0 for impossible entries. total, slope: (B,)."""
    shape = (-1, *[1] * (log_scores.dim() - 1))
    possible = torch.where(total > -torch.inf, total, torch.zeros_like(total)).view(shape)
    return slope.view(shape) * torch.exp((log_scores - possible) / temperature)


def chain_beliefs(
    log_unary: Tensor, log_pairwise: Tensor, mask: Tensor, temperature: float = 0.0, *, in_loops: bool = False
) -> Tensor:
    """Normalised log-beliefs (B, N, S): max-marginals at temperature 0, marginals at 1; padding is ignored (Eq. 3).

    `log_softmax` of unary plus messages; at temperature 1 these are log marginal probabilities. in_loops: max-marginals on the
    CPU are computed by an operator of `loops.chains`.
    """
    log_unary, log_pairwise = silence_padding(log_unary, log_pairwise, mask)
    if in_loops and temperature == 0 and has_operators(log_unary):
        beliefs: Tensor = MaxMarginals.apply(log_unary, log_pairwise)
        return beliefs
    forward, backward = chain_messages(log_unary, log_pairwise, temperature)
    return normalise_beliefs(log_unary + forward + backward, temperature)


def normalise_beliefs(beliefs: Tensor, temperature: float) -> Tensor:
    """`log_softmax` over the last axis, of beliefs in units of the temperature; rows of -inf alone are unchanged."""
    possible = beliefs.amax(-1, keepdim=True) > -torch.inf
    beliefs = torch.log_softmax(torch.where(possible, beliefs if temperature == 0 else beliefs / temperature, 0.0), dim=-1)
    return torch.where(possible, beliefs, -torch.inf)
