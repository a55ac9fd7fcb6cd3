"""What a model is chosen from by name, and what every variant can do: one line each, asked by all who would compare names.

A new variant is a module with its function and a line here; `config` accepts its name, `variants.register` loads it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pkgutil import resolve_name
from typing import Any


@dataclass(frozen=True, slots=True, kw_only=True)
class Variant:
    """What models with a variant can do.

    Attributes:
        function: what computes it, as `module:name` within the package; empty where the modules that need it know it by name.
        has_gradient: gradients pass through the rounds to weights and points.
        takes_extras: `forward` takes embeddings and extra log potentials, which an encoder makes too.
        is_exportable: the rounds are a program without Python (`export`).
        in_loops: the loops (`fast`) have it.
    """

    function: str = ""
    has_gradient: bool = True
    takes_extras: bool = True
    is_exportable: bool = True
    in_loops: bool = True


@dataclass(frozen=True, slots=True, kw_only=True)
class Schedule(Variant):
    """In which order messages pass: `function(view, start, parameters, model)` decodes.

    Attributes:
        takes_couplings: it goes in rounds, of any coupling.
    """

    takes_couplings: bool = True


@dataclass(frozen=True, slots=True, kw_only=True)
class Coupling(Variant):
    """How the chains see each other: `function(view, start, state, found, parameters, model)` updates both.

    Attributes:
        likelihood: `function(view, plugins, parameters, model)` of the annotation.
        chain: what makes the one chain of both labels from plug-ins, for a model that has no chain alone; empty: two chains.
    """

    likelihood: str
    chain: str = ""


@dataclass(frozen=True, slots=True, kw_only=True)
class Chains(Variant):
    """Which chains a model has. One that has no clusters has one motion, one that has no associations takes those given."""

    has_association: bool = True
    has_clusters: bool = True


@dataclass(frozen=True, slots=True, kw_only=True)
class MotionMetric(Variant):
    """How motions follow from labels: `inference.motion.FITS`.

    Attributes:
        is_fitted: motions are fitted at all. along_surface: a point may slide along the target's surface at next to no cost.
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
        takes_couplings=False,
    ),
}
STARTS: Mapping[str, Variant] = {  # function(view, found, parameters, inference) makes it from that of the search
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
MOTION_WEIGHTS: Mapping[str, Variant] = {"hard": Variant(), "soft": Variant(in_loops=False)}
MOVERS: Mapping[str, Variant] = {"joint": Variant(), "threshold": Variant()}
CANDIDATE_SEARCHES: Mapping[str, Variant] = {
    "motion": Variant(),
    "position": Variant(in_loops=False),
    "shape": Variant(is_exportable=False, in_loops=False),  # how many points are compared at once depends on the pairs
}

OF_INFERENCE: Mapping[str, Mapping[str, Variant]] = {  # by setting of `InferenceConfig`
    "candidate_search": CANDIDATE_SEARCHES,
    "schedule": SCHEDULES,
    "motion_weights": MOTION_WEIGHTS,
    "movers": MOVERS,
    "motion_metric": MOTION_METRICS,
}
OF_MODEL: Mapping[str, Mapping[str, Variant]] = {"chains": CHAINS, "coupling": COUPLINGS, "start": STARTS}  # of `ModelConfig`
OF_ROUNDS: Mapping[str, Mapping[str, Variant]] = {**OF_INFERENCE, "chains": CHAINS, "coupling": COUPLINGS}  # whatever the start


def with_ability(register: Mapping[str, Variant], ability: str) -> tuple[str, ...]:
    """The names of the variants that have an ability, a field of `Variant`."""
    return tuple(name for name, variant in register.items() if getattr(variant, ability))


def load(function: str) -> Any:
    """The function that `module:name` names within the package."""
    return resolve_name(f"{__package__}.{function}")
