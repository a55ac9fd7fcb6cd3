"""Selection of the hypothesised movers of one pair; `inference.selection` without batches."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from torchcrf_scan.fast.clustering import ClusteringModel, Tables, node_potentials, transition_potentials
from torchcrf_scan.inference.state import CAPPED
from torchcrf_scan.loops.jit import Array, Booleans, kernel
from torchcrf_scan.loops.messages import log_partition_without

if TYPE_CHECKING:
    from torchcrf_scan.inference.state import Parameters


class Worth(NamedTuple):
    """The three weights of `inference.selection.ClusterPotential`."""

    explains: float
    score: float
    bias: float


def worth_of(parameters: Parameters) -> Worth:
    """The fitted weights as numbers."""
    potential = parameters.potential
    return Worth(float(potential.explains), float(potential.score), float(potential.bias))


@kernel
def evidence(tables: Tables, active: Booleans, model: ClusteringModel) -> Array:
    """(C,) log Z of the clustering chain, minus that without the cluster; 0 for the background and for inactive clusters.

    The removed cluster's points still count as explained; otherwise its removal would favour the outlier state there.

    Args:
        tables: at the present motions and associations. active: (C,) clusters that exist.
    """
    states = np.flatnonzero(active)
    log_unary = node_potentials(tables, states, model)
    whole, without = log_partition_without(log_unary, transition_potentials(tables, states, log_unary, model))
    found = np.zeros(len(active))
    for s in range(len(states)):
        if states[s] > 0:
            found[states[s]] = whole - without[s]
    return found


@kernel
def discard_vacuous(tables: Tables, active: Booleans, log_odds: Array, model: ClusteringModel, worth: Worth) -> None:
    """Removes from `active` (C,), in place, the movers of negative potential. log_odds: (C,) of the hypotheses."""
    for _ in range(len(active) - 1):
        if not active[1:].any():
            break
        explained = evidence(tables, active, model)
        least, which = np.inf, 0
        for c in range(1, len(active)):
            if active[c]:
                scored = worth.score * min(max(log_odds[c], -CAPPED), CAPPED)
                value = worth.bias + worth.explains * math.log1p(max(explained[c], 0.0)) + scored
                if value < least:
                    least, which = value, c
        if not least < 0:
            break
        active[which] = False
