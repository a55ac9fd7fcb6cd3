"""Registers of the model's variants and their abilities, one line each; all comparisons of variant names go through them.

A new variant is a module with its function and a line here; `config` accepts its name, `variants.register` loads it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pkgutil import resolve_name
from typing import Any


@dataclass(frozen=True, slots=True, kw_only=True)
class Variant:
    """Abilities of models that use a variant.

    Attributes:
        function: its implementation, as `module:name` within the package; empty if the modules that need it handle it by name.
        has_gradient: gradients pass through the rounds to weights and points.
        takes_extras: `forward` accepts embeddings and extra log potentials, including those of an encoder.
        is_exportable: the rounds can be exported as a program without Python (`export`).
        in_loops: implemented by the loops (`fast`) too.
        takes_limit: outliers can be told by a distance in metres.
    """

    function: str = ""
    has_gradient: bool = True
    takes_extras: bool = True
    is_exportable: bool = True
    in_loops: bool = True
    takes_limit: bool = True


@dataclass(frozen=True, slots=True, kw_only=True)
class Schedule(Variant):
    """Message schedule: `function(view, start, parameters, model)` decodes.

    Attributes:
        takes_couplings: the schedule works in rounds and supports every coupling.
    """

    takes_couplings: bool = True


@dataclass(frozen=True, slots=True, kw_only=True)
class Coupling(Variant):
    """Coupling of the two chains: `function(view, start, state, found, parameters, model)` updates both.

    Attributes:
        likelihood: `function(view, plugins, parameters, model)` of the annotation.
        chain: builds the single chain over joint labels from plug-ins; empty: two separate chains.
    """

    likelihood: str
    chain: str = ""


@dataclass(frozen=True, slots=True, kw_only=True)
class Chains(Variant):
    """The chains of a model. Without clusters there is one motion; without associations those of the start are used."""

    has_association: bool = True
    has_clusters: bool = True


@dataclass(frozen=True, slots=True, kw_only=True)
class MotionMetric(Variant):
    """Estimator of motions from labels: `inference.motion.FITS`.

    Attributes:
        is_fitted: motions are fitted at all. along_surface: a point may slide along the target's surface at little cost.
    """

    is_fitted: bool = True
    along_surface: bool = True


SCHEDULES: Mapping[str, Schedule] = {
    "sweep": Schedule(function="variants.sweep:decode"),
    "flooding": Schedule(
        function="variants.flooding:decode",
        has_gradient=False,
        takes_extras=False,
        is_exportable=False,
        in_loops=False,
        takes_limit=False,
        takes_couplings=False,
    ),
}
STARTS: Mapping[str, Variant] = {  # function(view, found, parameters, inference) builds the start from that of the search
    "search": Variant(),
    "paper": Variant(function="variants.paper_start:paper_start", in_loops=False),
    "points": Variant(function="variants.points_start:points_start", in_loops=False),
}
COUPLINGS: Mapping[str, Coupling] = {
    "motions": Coupling(function="inference.joint:update_in_turns", likelihood="inference.pseudo_likelihood:pseudo_log_likelihood"),
    "lattice": Coupling(
        function="variants.lattice:update",
        likelihood="variants.lattice_likelihood:pseudo_log_likelihood",
        chain="variants.lattice_likelihood:lattice_chain",
        in_loops=False,
        takes_limit=False,
    ),
}
CHAINS: Mapping[str, Chains] = {
    "joint": Chains(),
    "matching": Chains(has_clusters=False, in_loops=False),
    "clustering": Chains(has_association=False, in_loops=False),
}
MOTION_METRICS: Mapping[str, MotionMetric] = {
    "point": MotionMetric(along_surface=False),
    "line": MotionMetric(),
    "given": MotionMetric(is_fitted=False),
}
MOTION_WEIGHTS: Mapping[str, Variant] = {"hard": Variant(), "soft": Variant()}
MOVERS: Mapping[str, Variant] = {"joint": Variant(), "threshold": Variant()}
CANDIDATE_SEARCHES: Mapping[str, Variant] = {
    "motion": Variant(),
    "position": Variant(in_loops=False),
    "shape": Variant(is_exportable=False, in_loops=False),  # the number of comparisons per chunk depends on the batch
}

OF_INFERENCE: Mapping[str, Mapping[str, Variant]] = {  # by setting of `InferenceConfig`
    "candidate_search": CANDIDATE_SEARCHES,
    "schedule": SCHEDULES,
    "motion_weights": MOTION_WEIGHTS,
    "movers": MOVERS,
    "motion_metric": MOTION_METRICS,
}
OF_MODEL: Mapping[str, Mapping[str, Variant]] = {"chains": CHAINS, "coupling": COUPLINGS, "start": STARTS}  # of `ModelConfig`
OF_ROUNDS: Mapping[str, Mapping[str, Variant]] = {**OF_INFERENCE, "chains": CHAINS, "coupling": COUPLINGS}  # for any start


def with_ability(register: Mapping[str, Variant], ability: str) -> tuple[str, ...]:
    """Names of the variants that have an ability (a boolean field of `Variant`)."""
    return tuple(name for name, variant in register.items() if getattr(variant, ability))


def load(function: str) -> Any:
    """The function at `module:name` within the package."""
    return resolve_name(f"{__package__}.{function}")
