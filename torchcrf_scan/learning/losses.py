"""Register of the losses of learning with their abilities, one line each.

A new loss is a function that makes an `objectives.Objective` from the run's settings, and a line here.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

NO_STEPS = "none"  # staged fit only
STAGED = "pseudo_likelihood"  # the staged fit's first objective


@dataclass(frozen=True, slots=True, kw_only=True)
class Loss:
    """Abilities of a loss.

    Attributes:
        function: `module:name` within the package, `function(config)` makes the objective of first-order steps.
        is_staged: supported by the staged fit; otherwise first-order steps follow the staged fit with `STAGED`.
        is_exact: the staged fit continues with the exact likelihood of each chain.
        needs_start: it uses the motions of InitialiseRT.
        has_temperature: it has its own temperature of the read-out (`UnrolledConfig`).
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
