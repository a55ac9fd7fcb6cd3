"""The convex part of learning: the weights of one chain from its designs (spec 6.3, 6.4)."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import torch
from scipy.optimize import OptimizeResult, minimize
from torch import Tensor

from torchcrf_scan.config import LearningConfig
from torchcrf_scan.inference.pseudo_likelihood import Design

Watch = Callable[[int, float, float, Tensor], None]


def flatten(designs: Sequence[Design], live: Tensor) -> Design:
    """All known nodes of many batches as one row of nodes: features (1, P, S, W), float64, dead columns zero."""
    states = max(design.features.shape[2] for design in designs)

    def rows(design: Design) -> tuple[Tensor, Tensor, Tensor]:
        spare = states - design.features.shape[2]  # the outlier stays the last state
        features = design.features.detach().double()[design.known] * live
        mask, label = design.mask[design.known], design.label[design.known]
        own = design.features.shape[2] - 1
        label = torch.where(label == own, states - 1, label)
        features = torch.cat([features[:, :own], features.new_zeros(len(features), spare, features.shape[2]), features[:, own:]], 1)
        mask = torch.cat([mask[:, :own], mask.new_zeros(len(mask), spare), mask[:, own:]], dim=1)
        return features, mask, label

    parts = [rows(design) for design in designs]
    features, mask, label = (torch.cat([part[k] for part in parts])[None] for k in range(3))
    return Design(features, mask, label, torch.ones_like(label, dtype=torch.bool))


def fit_weights(design: Design, config: LearningConfig, watch: Watch | None = None) -> Tensor:
    """Minimises -PL(w) + w^T w / (2 s_w^2) over standardised features by L-BFGS from 0; convex, so one optimum.

    Args:
        design: one row of nodes, see `flatten`.
        watch: called with (step, objective per node, largest gradient entry per node, weights) after every step.

    Returns:
        (W,) float64 weights for the features as they are.
    """
    spread = design.features[design.mask].std(dim=0)
    spread = torch.where(spread > 1e-9, spread, torch.ones_like(spread))
    scaled = Design(design.features / spread, design.mask, design.label, design.known)
    nodes = max(1, int(design.known.sum()))
    step = 0

    def objective(values: np.ndarray) -> tuple[float, np.ndarray]:
        weights = torch.from_numpy(values).requires_grad_()
        loss = ((weights**2).sum() / (2 * config.prior**2) - scaled.log_likelihood(weights).sum()) / nodes
        (slope,) = torch.autograd.grad(loss, weights)
        return loss.item(), slope.numpy()

    def look(intermediate_result: OptimizeResult) -> None:
        nonlocal step
        step += 1
        if watch is not None:
            loss, slope = objective(intermediate_result.x)
            watch(step, loss, float(np.abs(slope).max()), torch.from_numpy(intermediate_result.x) / spread)

    options = {"maxiter": config.max_steps, "gtol": config.tolerance, "ftol": 0.0, "maxcor": 10}
    start = np.zeros(design.features.shape[-1])
    found = minimize(objective, start, jac=True, method="L-BFGS-B", callback=look, options=options)
    return torch.from_numpy(found.x) / spread
