"""What became of the hypotheses of a search, for evaluation: the pool, those considered, those kept."""

from __future__ import annotations

import numpy as np

from torchcrf_scan.evaluation.causes.trace import SearchTrace
from torchcrf_scan.loops.jit import Booleans
from torchcrf_scan.loops.pair import Pair
from torchcrf_scan.search.accept import Score, select
from torchcrf_scan.search.choose import CONSIDERED, judge
from torchcrf_scan.search.hypotheses import members_of
from torchcrf_scan.search.survey import Survey


def trace_of(pair: Pair, seen: Survey | None, score: Score, active: Booleans) -> SearchTrace:
    """The trace of one pair from its survey and the clusters (C,) that were there at the end; without a survey, an empty pool."""
    N, none = len(pair.source), np.zeros(0, np.int64)
    if seen is None:
        nothing = np.zeros((0, N), np.bool_)
        empty = none.astype(np.bool_)
        return SearchTrace(pair.initial_motion, np.zeros((0, 3)), nothing, empty, none, empty, np.full(N, np.inf))
    leftover = seen.leftover
    hypotheses, probabilities = judge(seen.hypotheses, seen.features, seen.sides, score)
    considered = select(leftover, hypotheses, probabilities, CONSIDERED, len(active) - 1)  # as `choose_movers` did
    members = members_of(hypotheses, np.arange(len(probabilities)), N)
    kept = active[1 : 1 + len(considered)]
    units = np.maximum(leftover.source.units, leftover.unit)
    return SearchTrace(leftover.background, hypotheses.motions, members, probabilities >= CONSIDERED, considered, kept, units)
