"""The losses that learning descends, by name, and what each can do: one line each.

A new loss is a function of the run's settings that makes an `objectives.Objective`, and a line here.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

NO_STEPS = "none"  # the staged fit is all
STAGED = "pseudo_likelihood"  # what the staged fit descends first


@dataclass(frozen=True, slots=True, kw_only=True)
class Loss:
    """What a loss can do.

    Attributes:
        function: `module:name` within the package, `function(config)` makes the objective of first-order steps.
        is_staged: the staged fit knows it; otherwise first-order steps follow the fit of `STAGED`.
        is_exact: the staged fit goes on with the exact likelihood of each chain.
        needs_start: it looks at the pairs under InitialiseRT's motions.
        has_temperature: of its own, at which beliefs are read out (`UnrolledConfig`).
    """

    function: str
    is_staged: bool = True
    is_exact: bool = False
    needs_start: bool = True
    has_temperature: bool = False


LOSSES: Mapping[str, Loss] = {
    STAGED: Loss(function="learning.objectives:make_pseudo_likelihood", needs_start=False),
    "likelihood": Loss(function="learning.objectives:make_likelihood", is_exact=True),
    "unrolled": Loss(function="learning.unrolled:make_unrolled", is_staged=False, has_temperature=True),
}
