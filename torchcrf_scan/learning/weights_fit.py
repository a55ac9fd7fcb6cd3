"""The convex part of learning: the weights of one chain from its features (spec 6.3 to 6.5)."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from typing import TypeVar

import numpy as np
import torch
from scipy.optimize import OptimizeResult, minimize
from torch import Tensor

from torchcrf_scan.inference.pseudo_likelihood import Chain, Design
from torchcrf_scan.learning.losses import LOSSES
from torchcrf_scan.learning.settings import LearningConfig
from torchcrf_scan.variants.lattice_likelihood import LatticeChain

AnyChain = TypeVar("AnyChain", Chain, LatticeChain)
Watch = Callable[[int, float, float, Tensor], None]


def flatten(designs: Sequence[Design], counts: Sequence[Tensor] | None = None) -> Design:
    """All annotated nodes of many batches as one row of nodes: features (1, P, S, W), float64.

    counts: (B,) how much every pair of every batch counts; None: 1.
    """
    states = max(design.features.shape[2] for design in designs)

    def spread(values: Tensor) -> Tensor:
        own = values.shape[1] - 1  # the outlier stays the last state
        spare = values.new_zeros(len(values), states - 1 - own, *values.shape[2:])
        return torch.cat([values[:, :own], spare, values[:, own:]], dim=1)

    def rows(design: Design) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        features, mask, label = (part[design.known] for part in (design.features.detach().double(), design.mask, design.label))
        extra = features.new_zeros(mask.shape) if design.extra is None else design.extra.detach().double()[design.known]
        label = torch.where(label == design.features.shape[2] - 1, states - 1, label)
        return spread(features), spread(mask), label, spread(extra)

    parts = [rows(design) for design in designs]
    features, mask, label, extra = (torch.cat([part[k] for part in parts])[None] for k in range(4))
    known = torch.ones_like(label, dtype=torch.bool)
    return Design(features, mask, label, known, extra, None if counts is None else of_nodes(designs, counts)[None])


def of_nodes(designs: Sequence[Design], of_pairs: Sequence[Tensor]) -> Tensor:
    """(P,) values of all annotated nodes of many batches. of_pairs: (B,) of every batch."""
    return torch.cat([own[:, None].expand(of.known.shape)[of.known].double() for of, own in zip(designs, of_pairs, strict=True)])


def fit_chain(
    chains: Iterable[AnyChain | Design],
    live: Tensor,
    config: LearningConfig,
    watch: Watch | None = None,
    around: Tensor | None = None,
    counts: Sequence[Tensor] | None = None,
) -> Tensor:
    """The weights of a chain or the lattice by `config.objective`: pseudo-likelihood, or exact likelihood started at its optimum.

    Args:
        chains: batches; pseudo-likelihood processes one at a time and keeps no transitions, of which dense chains have many.
        live: (W,) 1 for the weights that are learned, 0 for those that stay.
        around: (W,) mean of the prior, where those stay; None: 0.
        counts: (B,) how much every pair of every batch counts; None: 1.

    Returns:
        (W,) float64.
    """
    is_exact = LOSSES[config.objective].is_exact
    chains = list(chains) if is_exact else chains
    design = flatten([chain.design() for chain in chains], counts)
    done = 0

    def look(step: int, loss: float, slope: float, weights: Tensor) -> None:
        nonlocal done
        done += 1  # steps of both objectives are numbered consecutively
        if watch is not None:
            watch(done, loss, slope, weights)

    weights = fit_weights(design, config, look, live=live, around=around)
    if not is_exact:
        return weights
    exact = stack([chain for chain in chains if not isinstance(chain, Design)])
    of_pairs = torch.ones(()) if counts is None else torch.cat(list(counts)).double()
    measure = lambda w: (of_pairs * exact.log_likelihood(w)).sum()  # noqa: E731
    return fit_weights(design, config, look, live=live, start=weights, log_likelihood=measure, around=around)


def stack(chains: Sequence[AnyChain]) -> AnyChain:
    """Many batches of chains as one, padded, float64 and detached; outliers stay the last states."""
    first = chains[0]
    lengths: dict[str, int] = {}
    for chain in chains:
        for name, axes in first.axes.items():
            for axis, length in zip(axes, () if getattr(chain, name) is None else getattr(chain, name).shape[1:], strict=False):
                lengths[axis] = max(lengths.get(axis, 0), length)
    own = {name: next(of for of, axes in first.axes.items() if axis in axes) for name, axis in first.labels.items()}

    held = [name for name in first.axes if getattr(first, name) is not None]

    def spread(chain: AnyChain, name: str) -> Tensor:
        values = getattr(chain, name).detach()
        if name in first.labels:
            axis = first.labels[name]
            outlier = getattr(chain, own[name]).shape[1 + first.axes[own[name]].index(axis)] - 1
            values = torch.where(values == outlier, lengths[axis] - 1, values)
        values = values.double() if values.is_floating_point() else values
        for dim, axis in enumerate(first.axes[name], start=1):
            values = _lengthen(values, dim, lengths[axis], is_states=axis not in "ne")
        return values

    return replace(first, **{name: torch.cat([spread(chain, name) for chain in chains]) for name in held})


def _lengthen(values: Tensor, dim: int, length: int, *, is_states: bool) -> Tensor:
    """Appends zeros to an axis, or inserts them before its last entry if that is the outlier state."""
    last = values.shape[dim] - int(is_states)
    shape = list(values.shape)
    shape[dim] = length - values.shape[dim]
    head, tail = values.split([last, values.shape[dim] - last], dim)
    return torch.cat([head, values.new_zeros(shape), tail], dim)


def fit_weights(
    design: Design,
    config: LearningConfig,
    watch: Watch | None = None,
    *,
    live: Tensor | None = None,
    start: Tensor | None = None,
    log_likelihood: Callable[[Tensor], Tensor] | None = None,
    around: Tensor | None = None,
) -> Tensor:
    """Minimises -log likelihood + |w - w_0|^2 / (2 s_w^2) by L-BFGS, w in units of the features' spread; convex, so one optimum.

    Args:
        design: one row of nodes, see `flatten`; its log pseudo-likelihood is the default objective.
        watch: called with (step, objective per node, largest gradient entry per node, weights) after every step.
        live: (W,) 1 for the weights that are learned, 0 for those that stay at w_0; None: all.
        start: (W,) initial weights; None: w_0.
        log_likelihood: (W,) -> (), another objective on the same features.
        around: (W,) mean w_0 of the prior; None: 0.

    Returns:
        (W,) float64 weights for unscaled features.
    """
    spread = design.features[design.mask].std(dim=0)
    per_unit = 1 / torch.where(spread > 1e-9, spread, torch.ones_like(spread))
    if live is not None:
        per_unit = per_unit * live
    base = torch.zeros_like(per_unit) if around is None else around.detach().to(per_unit)
    nodes = max(1, int(design.known.sum()))
    measure = log_likelihood or (lambda weights: design.log_likelihood(weights).sum())
    step = 0
    latest: dict[str, float] = {}  # of the objective's last call, which is the accepted one when a step ends

    def objective(values: np.ndarray) -> tuple[float, np.ndarray]:
        scaled = torch.from_numpy(values).requires_grad_()
        loss = ((scaled**2).sum() / (2 * config.prior**2) - measure(base + scaled * per_unit)) / nodes
        (slope,) = torch.autograd.grad(loss, scaled)
        latest.update(loss=loss.item(), slope=float(slope.abs().max()))
        return latest["loss"], slope.numpy()

    def look(intermediate_result: OptimizeResult) -> None:
        nonlocal step
        step += 1
        if watch is not None:
            watch(step, latest["loss"], latest["slope"], base + torch.from_numpy(intermediate_result.x) * per_unit)

    first = base if start is None else start
    first = torch.where(per_unit > 0, (first - base) / per_unit.clamp(min=1e-12), 0.0)
    idle = 0.0 if log_likelihood is None else 0.1 * config.tolerance  # least relative gain of a step: exact steps are expensive
    options = {"maxiter": config.max_steps, "gtol": config.tolerance, "ftol": idle, "maxcor": 10}
    found = minimize(objective, first.numpy(), jac=True, method="L-BFGS-B", callback=look, options=options)
    return base + torch.from_numpy(found.x) * per_unit
