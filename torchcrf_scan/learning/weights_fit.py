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


def flatten(designs: Sequence[Design]) -> Design:
    """All annotated nodes of many batches as one row of nodes: features (1, P, S, W), float64."""
    states = max(design.features.shape[2] for design in designs)

    def rows(design: Design) -> tuple[Tensor, Tensor, Tensor]:
        own = design.features.shape[2] - 1
        features, mask, label = (part[design.known] for part in (design.features.detach().double(), design.mask, design.label))
        spare = states - design.features.shape[2]  # the outlier stays the last state
        features = torch.cat([features[:, :own], features.new_zeros(len(features), spare, features.shape[2]), features[:, own:]], 1)
        mask = torch.cat([mask[:, :own], mask.new_zeros(len(mask), spare), mask[:, own:]], dim=1)
        return features, mask, torch.where(label == own, states - 1, label)

    parts = [rows(design) for design in designs]
    features, mask, label = (torch.cat([part[k] for part in parts])[None] for k in range(3))
    return Design(features, mask, label, torch.ones_like(label, dtype=torch.bool))


def fit_chain(chains: Iterable[AnyChain], live: Tensor, config: LearningConfig, watch: Watch | None = None) -> Tensor:
    """The weights of a chain or the lattice by `config.objective`: pseudo-likelihood, or exact likelihood started at its optimum.

    Args:
        chains: batches; pseudo-likelihood processes one at a time and keeps no transitions, of which dense chains have many.
        live: (W,) 1 for the weights that are learned, 0 for those fixed at 0.

    Returns:
        (W,) float64.
    """
    is_exact = LOSSES[config.objective].is_exact
    chains = list(chains) if is_exact else chains
    design = flatten([chain.design() for chain in chains])
    done = 0

    def look(step: int, loss: float, slope: float, weights: Tensor) -> None:
        nonlocal done
        done += 1  # steps of both objectives are numbered consecutively
        if watch is not None:
            watch(done, loss, slope, weights)

    weights = fit_weights(design, config, look, live=live)
    if not is_exact:
        return weights
    exact = stack(list(chains))
    return fit_weights(design, config, look, live=live, start=weights, log_likelihood=lambda w: exact.log_likelihood(w).sum())


def stack(chains: Sequence[AnyChain]) -> AnyChain:
    """Many batches of chains as one, padded, float64 and detached; outliers stay the last states."""
    first = chains[0]
    lengths: dict[str, int] = {}
    for chain in chains:
        for name, axes in first.axes.items():
            for axis, length in zip(axes, getattr(chain, name).shape[1:], strict=False):
                lengths[axis] = max(lengths.get(axis, 0), length)
    own = {name: next(of for of, axes in first.axes.items() if axis in axes) for name, axis in first.labels.items()}

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

    return replace(first, **{name: torch.cat([spread(chain, name) for chain in chains]) for name in first.axes})


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
) -> Tensor:
    """Minimises -log likelihood + w^T w / (2 s_w^2) by L-BFGS, w in units of the features' spread; convex, so one optimum.

    Args:
        design: one row of nodes, see `flatten`; its log pseudo-likelihood is the default objective.
        watch: called with (step, objective per node, largest gradient entry per node, weights) after every step.
        live: (W,) 1 for the weights that are learned, 0 for those fixed at 0; None: all.
        start: (W,) initial weights; None: 0.
        log_likelihood: (W,) -> (), another objective on the same features.

    Returns:
        (W,) float64 weights for unscaled features.
    """
    spread = design.features[design.mask].std(dim=0)
    per_unit = 1 / torch.where(spread > 1e-9, spread, torch.ones_like(spread))
    if live is not None:
        per_unit = per_unit * live
    nodes = max(1, int(design.known.sum()))
    measure = log_likelihood or (lambda weights: design.log_likelihood(weights).sum())
    step = 0
    latest: dict[str, float] = {}  # of the objective's last call, which is the accepted one when a step ends

    def objective(values: np.ndarray) -> tuple[float, np.ndarray]:
        scaled = torch.from_numpy(values).requires_grad_()
        loss = ((scaled**2).sum() / (2 * config.prior**2) - measure(scaled * per_unit)) / nodes
        (slope,) = torch.autograd.grad(loss, scaled)
        latest.update(loss=loss.item(), slope=float(slope.abs().max()))
        return latest["loss"], slope.numpy()

    def look(intermediate_result: OptimizeResult) -> None:
        nonlocal step
        step += 1
        if watch is not None:
            watch(step, latest["loss"], latest["slope"], torch.from_numpy(intermediate_result.x) * per_unit)

    first = torch.zeros_like(per_unit) if start is None else torch.where(per_unit > 0, start / per_unit.clamp(min=1e-12), 0.0)
    idle = 0.0 if log_likelihood is None else 0.1 * config.tolerance  # least relative gain of a step: exact steps are expensive
    options = {"maxiter": config.max_steps, "gtol": config.tolerance, "ftol": idle, "maxcor": 10}
    found = minimize(objective, first.numpy(), jac=True, method="L-BFGS-B", callback=look, options=options)
    return torch.from_numpy(found.x) * per_unit
