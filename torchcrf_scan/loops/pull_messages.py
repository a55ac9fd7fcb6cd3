"""The way back through the max-marginals of a chain: slopes of its potentials from slopes of its beliefs.

A slope is the derivative of a loss. The max-product keeps one choice for every message: all of a message's slope goes there.
"""

from __future__ import annotations

import math

import numpy as np

from torchcrf_scan.loops.jit import Array, Integers, kernel


@kernel
def pull_softmax(log_beliefs: Array, slopes: Array) -> Array:
    """(N, S) slopes of scores of which `log_beliefs` (N, S) are the log-softmax; 0 for impossible states."""
    N, S = log_beliefs.shape
    pulled = np.zeros((N, S))
    for i in range(N):
        total = 0.0
        for s in range(S):
            total += slopes[i, s]
        for s in range(S):
            if log_beliefs[i, s] > -np.inf:
                pulled[i, s] = slopes[i, s] - math.exp(log_beliefs[i, s]) * total
    return pulled


@kernel
def _choose(scores: Array, edge: Array, forward: bool, largest: Array, choice: Integers) -> None:
    """Writes the largest score (S,) of every state and the neighbour's state it comes from, -1 for none.

    scores: (S,) of the neighbour. edge: (S, S), rows = states of the earlier node. forward: the neighbour is the earlier node.
    """
    S = len(scores)
    for t in range(S):
        largest[t], choice[t] = -np.inf, -1
    for s in range(S):
        if scores[s] > -np.inf:
            for t in range(S):
                value = scores[s] + (edge[s, t] if forward else edge[t, s])
                if value > largest[t]:
                    largest[t], choice[t] = value, s


@kernel
def _pull_direction(log_unary: Array, log_pairwise: Array, own: Array, forward: bool, nodes: Array, edges: Array) -> None:
    """Adds the slopes that reach the potentials through the messages of one direction. own: (N, S) slopes of the scores."""
    N, S = log_unary.shape
    choices, scores, largest = np.empty((N, S), np.int64), np.empty(S), np.empty(S)
    scores[:] = log_unary[0 if forward else N - 1]
    for step in range(1, N):
        i = step if forward else N - 1 - step
        edge = log_pairwise[i - 1 if forward else i]
        _choose(scores, edge, forward, largest, choices[i])
        for t in range(S):
            scores[t] = largest[t] + log_unary[i, t]
    message = own[N - 1 if forward else 0].copy()
    for step in range(N - 1, 0, -1):
        i = step if forward else N - 1 - step
        j = i - 1 if forward else i + 1
        edge = edges[min(i, j)]
        for s in range(S):
            scores[s] = 0.0
        for t in range(S):
            s = choices[i, t]
            if s >= 0 and message[t] != 0 and log_unary[i, t] > -np.inf:
                scores[s] += message[t]
                if forward:
                    edge[s, t] += message[t]
                else:
                    edge[t, s] += message[t]
        for s in range(S):
            nodes[j, s] += scores[s]
            message[s] = own[j, s] + scores[s]


@kernel
def pull_max_marginals(log_unary: Array, log_pairwise: Array, log_beliefs: Array, slopes: Array) -> tuple[Array, Array]:
    """Slopes of `max_marginals`: (N, S) of the potentials of nodes and (N-1, S, S) of edges.

    Args:
        log_unary: (N, S). log_pairwise: (N-1, S, S). log_beliefs: (N, S) the max-marginals. slopes: (N, S) of these.
    """
    own = pull_softmax(log_beliefs, slopes)
    if len(own) == 0:
        return own, np.zeros_like(log_pairwise)
    nodes, edges = own.copy(), np.zeros_like(log_pairwise)
    _pull_direction(log_unary, log_pairwise, own, True, nodes, edges)
    _pull_direction(log_unary, log_pairwise, own, False, nodes, edges)
    return nodes, edges
