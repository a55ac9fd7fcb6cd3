"""Exact messages on one chain: max-marginals in the log domain, sums over labellings as scaled numbers; `inference.messages`."""

from __future__ import annotations

import math

import numpy as np

from torchcrf_scan.loops.jit import Array, Integers, kernel

WIDEST = 300.0  # bound on the differences of a node's and an edge's potentials, within which sums of exp stay in range
SMALL = 1e-20  # sums are rescaled below this and above its inverse
LOWEST = -700.0  # exp of less is treated as 0
T2, T3, T4, T5, T6, T7, T8, T9, T10, T11, T12 = (1 / math.factorial(k) for k in range(2, 13))  # Taylor series of exp


@kernel
def possible_states(log_unary: Array) -> Integers:
    """States of (N, S) potentials that are possible at some node, ascending."""
    N, S = log_unary.shape
    states, count = np.empty(S, np.int64), 0
    for s in range(S):
        for i in range(N):
            if log_unary[i, s] > -np.inf:
                states[count] = s
                count += 1
                break
    return states[:count]


@kernel
def _chosen_nodes(log_unary: Array, states: Integers) -> Array:
    """(N, P) columns of (N, S)."""
    chosen = np.empty((len(log_unary), len(states)))
    for i in range(len(log_unary)):
        for s in range(len(states)):
            chosen[i, s] = log_unary[i, states[s]]
    return chosen


@kernel
def _chosen_edges(log_pairwise: Array, states: Integers) -> Array:
    """(E, P, P) rows and columns of (E, S, S)."""
    P = len(states)
    chosen = np.empty((len(log_pairwise), P, P))
    for i in range(len(log_pairwise)):
        for s in range(P):
            row = log_pairwise[i, states[s]]
            for t in range(P):
                chosen[i, s, t] = row[states[t]]
    return chosen


@kernel
def forward_scores(log_unary: Array, log_pairwise: Array) -> Array:
    """(N, S) score of the best labelling of everything up to a node, in every state of it."""
    N, S = log_unary.shape
    scores = np.empty((N, S))
    scores[0] = log_unary[0]
    for i in range(1, N):
        after, edge = scores[i], log_pairwise[i - 1]
        after[:] = -np.inf
        for s in range(S):
            before, row = scores[i - 1, s], edge[s]
            if before > -np.inf:
                for t in range(S):
                    after[t] = max(after[t], before + row[t])
        for t in range(S):
            after[t] += log_unary[i, t]
    return scores


@kernel
def _largest_sum(a: Array, b: Array) -> float:
    """max of a + b; in four independent strands, to hide the latency of a comparison."""
    S = len(a)
    x = y = z = w = -np.inf
    whole = S - S % 4
    for t in range(0, whole, 4):
        x, y = max(x, a[t] + b[t]), max(y, a[t + 1] + b[t + 1])
        z, w = max(z, a[t + 2] + b[t + 2]), max(w, a[t + 3] + b[t + 3])
    for t in range(whole, S):
        x = max(x, a[t] + b[t])
    return max(max(x, y), max(z, w))


@kernel
def exp_below(x: float) -> float:
    """exp of x <= 0 to a relative error of 1e-13, 0 below -700: as the library's, but vectorised in a loop."""
    whole = np.floor(max(x, LOWEST) / math.log(2) + 0.5)
    r = max(x, LOWEST) - whole * math.log(2)  # within 0.35
    value = T8 + r * (T9 + r * (T10 + r * (T11 + r * T12)))
    value = 1 + r * (1 + r * (T2 + r * (T3 + r * (T4 + r * (T5 + r * (T6 + r * (T7 + r * value)))))))
    power = np.int64((np.int64(np.int32(whole)) + 1023) << 52).view(np.float64)  # 2^whole by its bits
    return value * power if x > LOWEST else 0.0


@kernel
def log_softmax(row: Array) -> None:
    """In place; a row of -inf alone is unchanged. row: (S,)."""
    peak = -np.inf
    for s in range(len(row)):
        peak = max(peak, row[s])
    if peak == -np.inf:
        return
    total = 0.0
    for s in range(len(row)):
        row[s] -= peak
        total += exp_below(row[s])
    log_total = math.log(total)
    for s in range(len(row)):
        row[s] -= log_total


@kernel
def _max_marginals(log_unary: Array, log_pairwise: Array) -> Array:
    N, S = log_unary.shape
    beliefs = forward_scores(log_unary, log_pairwise)
    ahead, back = np.zeros(S), np.empty(S)  # a message from the node after, and with that node's potentials
    for i in range(N - 2, -1, -1):
        for t in range(S):
            back[t] = ahead[t] + log_unary[i + 1, t]
        for s in range(S):
            ahead[s] = _largest_sum(log_pairwise[i, s], back) if beliefs[i, s] > -np.inf else -np.inf
            beliefs[i, s] += ahead[s]
    for i in range(N):
        log_softmax(beliefs[i])
    return beliefs


@kernel
def max_marginals(log_unary: Array, log_pairwise: Array) -> Array:
    """Normalised log max-marginals (N, S): `chain_beliefs` at temperature 0. States that are impossible at all nodes cost nothing.

    Args:
        log_unary: (N, S). log_pairwise: (N-1, S, S), row = state of node i, column = state of node i + 1. Either may hold -inf.
    """
    N, S = log_unary.shape
    if N == 0:
        return np.empty((0, S))
    states = possible_states(log_unary)
    if len(states) == S:
        return _max_marginals(log_unary, log_pairwise)
    some = _max_marginals(_chosen_nodes(log_unary, states), _chosen_edges(log_pairwise, states))
    beliefs = np.full((N, S), -np.inf)
    for i in range(N):
        for s in range(len(states)):
            beliefs[i, states[s]] = some[i, s]
    return beliefs


@kernel
def _extent(row: Array) -> tuple[float, float]:
    """Least and largest; in four independent strands, to hide the latency of a comparison. row: (P,)."""
    a = b = c = d = np.inf
    x = y = z = w = -np.inf
    whole = len(row) - len(row) % 4
    for k in range(0, whole, 4):
        a, b, c, d = min(a, row[k]), min(b, row[k + 1]), min(c, row[k + 2]), min(d, row[k + 3])
        x, y, z, w = max(x, row[k]), max(y, row[k + 1]), max(z, row[k + 2]), max(w, row[k + 3])
    for k in range(whole, len(row)):
        a, x = min(a, row[k]), max(x, row[k])
    return min(min(a, b), min(c, d)), max(max(x, y), max(z, w))


@kernel
def _tables(log_unary: Array, log_pairwise: Array) -> tuple[Array, Array, float, bool]:
    """exp(value - largest) of every node (N, S) and edge (N-1, S, S), the sum of the largest, and whether sums stay in range.

    They do if no state of a node can become less than exp(-WIDEST) of another: impossible nodes can be left out, but an impossible
    edge may leave only states whose sums have already underflowed.
    """
    N, S = log_unary.shape
    nodes, edges = np.empty((N, S)), np.empty((max(N - 1, 0), S, S))
    offset, is_safe, before = 0.0, True, 0.0
    for i in range(N):
        least, peak = np.inf, -np.inf
        for s in range(S):
            peak = max(peak, log_unary[i, s])
            if log_unary[i, s] > -np.inf:
                least = min(least, log_unary[i, s])
        is_safe = is_safe and peak - least + before < WIDEST
        offset += peak
        for s in range(S):
            nodes[i, s] = exp_below(log_unary[i, s] - peak) if log_unary[i, s] > -np.inf else 0.0
        if i < N - 1:
            row, into = log_pairwise[i].reshape(S * S), edges[i].reshape(S * S)
            least, peak = _extent(row)
            before = peak - least
            is_safe = is_safe and before < WIDEST
            offset += peak
            for e in range(S * S):
                into[e] = exp_below(row[e] - peak)
    return nodes, edges, offset, is_safe


@kernel
def _advance(sums: Array, edge: Array, node: Array, keep: Array, after: Array) -> float:
    """Advances the sums to the next node, four states at a time. Returns the largest.

    sums, node: (S,); edge: (S, S); keep: (S,) 0 for a state that is left out, else 1; after: (S,) scratch.
    """
    S = len(sums)
    whole = S - S % 4
    for t in range(0, whole, 4):
        x = y = z = w = 0.0
        for s in range(S):
            share = sums[s]
            x += share * edge[s, t]
            y += share * edge[s, t + 1]
            z += share * edge[s, t + 2]
            w += share * edge[s, t + 3]
        after[t], after[t + 1], after[t + 2], after[t + 3] = x, y, z, w
    for t in range(whole, S):
        x = 0.0
        for s in range(S):
            x += sums[s] * edge[s, t]
        after[t] = x
    peak = 0.0
    for t in range(S):
        sums[t] = after[t] * node[t] * keep[t]
        peak = max(peak, sums[t])
    return peak


@kernel
def _log_totals(log_unary: Array, log_pairwise: Array, without: Integers) -> Array:
    """(R,) log Z in the log domain throughout: always accurate, but slow. without: (R,) states to leave out, -1 for none."""
    N, S = log_unary.shape
    totals = np.empty(len(without))
    before, after, terms = np.empty(S), np.empty(S), np.empty(S)
    for k in range(len(without)):
        for i in range(N):
            for t in range(S):
                if i > 0:
                    for s in range(S):
                        terms[s] = before[s] + log_pairwise[i - 1, s, t]
                after[t] = log_unary[i, t] + (log_sum(terms) if i > 0 else 0.0) if t != without[k] else -np.inf
            before[:] = after
        totals[k] = log_sum(before)
    return totals


@kernel
def log_sum(terms: Array) -> float:
    """logsumexp; -inf if all terms are. terms: (S,)."""
    peak = -np.inf
    for s in range(len(terms)):
        peak = max(peak, terms[s])
    if peak == -np.inf:
        return peak
    total = 0.0
    for s in range(len(terms)):
        total += math.exp(terms[s] - peak)
    return peak + math.log(total)


@kernel
def _totals(log_unary: Array, log_pairwise: Array, without: Integers) -> Array:
    """(R,) log Z without some states, -1 for none; every table is exponentiated once."""
    N, S = log_unary.shape
    nodes, edges, offset, is_safe = _tables(log_unary, log_pairwise)
    if not is_safe:
        return _log_totals(log_unary, log_pairwise, without)
    R = len(without)
    totals, keep, sums, after = np.empty(R), np.ones((R, S)), np.empty((R, S)), np.empty(S)
    for k in range(R):
        totals[k] = offset
        if without[k] >= 0:
            keep[k, without[k]] = 0.0
        for s in range(S):
            sums[k, s] = nodes[0, s] * keep[k, s]
    for i in range(1, N):
        for k in range(R):
            peak = _advance(sums[k], edges[i - 1], nodes[i], keep[k], after)
            if 0 < peak < SMALL or peak > 1 / SMALL:
                totals[k] += math.log(peak)
                for s in range(S):
                    sums[k, s] /= peak
    for k in range(R):
        total = 0.0
        for s in range(S):
            total += sums[k, s]
        totals[k] = totals[k] + math.log(total) if total > 0 else -np.inf
    return totals


@kernel
def log_partition_without(log_unary: Array, log_pairwise: Array) -> tuple[float, Array]:
    """log Z of all labellings, and (S,) log Z of those where no node has state k, for every k. Arguments as in `max_marginals`."""
    N, S = log_unary.shape
    states = possible_states(log_unary)
    if N == 0 or len(states) == 0:
        nothing = 0.0 if N == 0 else -np.inf
        return nothing, np.full(S, nothing)
    P = len(states)
    without = np.arange(-1, P)
    if P == S:
        totals = _totals(log_unary, log_pairwise, without)
    else:
        totals = _totals(_chosen_nodes(log_unary, states), _chosen_edges(log_pairwise, states), without)
    each = np.full(S, totals[0])
    for k in range(P):
        each[states[k]] = totals[k + 1]
    return totals[0], each


@kernel
def _backward_sums(nodes: Array, edges: Array, scale: Array) -> Array:
    """(N, S) sums over all that comes after a node, in every state of it, over the scales (N,) of the forward sums."""
    N, S = nodes.shape
    sums = np.ones((N, S))
    for i in range(N - 2, -1, -1):
        for s in range(S):
            total = 0.0
            for t in range(S):
                total += edges[i, s, t] * nodes[i + 1, t] * sums[i + 1, t]
            sums[i, s] = total / scale[i + 1]
    return sums


@kernel
def _sum_marginals(nodes: Array, edges: Array) -> tuple[float, Array, Array]:
    """log Z and marginals of tables of factors. nodes: (N, S), N >= 1; edges: (N-1, S, S); no sum may underflow."""
    N, S = nodes.shape
    sums, scale, total = nodes.copy(), np.empty(N), 0.0
    for i in range(N):
        if i > 0:
            for t in range(S):
                sums[i, t] = 0.0
                for s in range(S):
                    sums[i, t] += sums[i - 1, s] * edges[i - 1, s, t]
                sums[i, t] *= nodes[i, t]
        scale[i] = sums[i].sum()
        if scale[i] == 0:
            return -np.inf, np.zeros((N, S)), np.zeros_like(edges)
        total += math.log(scale[i])
        for t in range(S):
            sums[i, t] /= scale[i]
    after, of_edges = _backward_sums(nodes, edges, scale), np.empty_like(edges)
    for i in range(N - 1):
        for s in range(S):
            for t in range(S):
                of_edges[i, s, t] = sums[i, s] * edges[i, s, t] * nodes[i + 1, t] * after[i + 1, t] / scale[i + 1]
    for i in range(N):
        for s in range(S):
            sums[i, s] *= after[i, s]
    return total, sums, of_edges


@kernel
def _slow_sum_marginals(log_unary: Array, log_pairwise: Array) -> tuple[float, Array, Array]:
    """The same in the log domain throughout: always accurate, but slow."""
    N, S = log_unary.shape
    ahead, after, terms = log_unary.copy(), np.zeros((N, S)), np.empty(S)
    for i in range(1, N):
        for t in range(S):
            for s in range(S):
                terms[s] = ahead[i - 1, s] + log_pairwise[i - 1, s, t]
            ahead[i, t] += log_sum(terms)
    for i in range(N - 2, -1, -1):
        for s in range(S):
            for t in range(S):
                terms[t] = log_pairwise[i, s, t] + log_unary[i + 1, t] + after[i + 1, t]
            after[i, s] = log_sum(terms)
    total, of_nodes, of_edges = log_sum(ahead[N - 1]), np.zeros((N, S)), np.zeros_like(log_pairwise)
    for i in range(N if total > -np.inf else 0):
        for s in range(S):
            of_nodes[i, s] = math.exp(ahead[i, s] + after[i, s] - total)
            for t in range(S if i < N - 1 else 0):
                score = ahead[i, s] + log_pairwise[i, s, t] + log_unary[i + 1, t] + after[i + 1, t]
                of_edges[i, s, t] = math.exp(score - total)
    return total, of_nodes, of_edges


@kernel
def sum_marginals(log_unary: Array, log_pairwise: Array) -> tuple[float, Array, Array]:
    """log Z at temperature 1, and the marginals (N, S) of nodes and (N-1, S, S) of edges. Arguments as in `max_marginals`."""
    if len(log_unary) == 0:
        return 0.0, np.zeros_like(log_unary), np.zeros_like(log_pairwise)
    nodes, edges, offset, is_safe = _tables(log_unary, log_pairwise)
    if not is_safe:
        return _slow_sum_marginals(log_unary, log_pairwise)
    total, of_nodes, of_edges = _sum_marginals(nodes, edges)
    return total + offset, of_nodes, of_edges
