"""Fits the potential of a mover's cluster (`inference.selection`) by logistic regression on annotated pairs."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from torchcrf_scan.features.potentials import PairView, find_candidates
from torchcrf_scan.inference import joint
from torchcrf_scan.inference.selection import evidence
from torchcrf_scan.inference.start import Start
from torchcrf_scan.inference.state import ClusterPotential
from torchcrf_scan.learning.material import Material
from torchcrf_scan.model import JointScanCRF

PURE = 0.5  # least share of one true mover's points in a right cluster
REGULARISATION = 1.0  # inverse strength


@torch.no_grad()
def fit_potential(model: JointScanCRF, material: Sequence[Material]) -> ClusterPotential:
    """The potential that best separates true from false movers among those considered in the material.

    Returns:
        The fitted potential; the default one unless the material holds both true and false movers, scored by the search.
    """
    from sklearn.linear_model import LogisticRegression

    potential = ClusterPotential()
    parts = [judge_clusters(model, part) for part in material if part.start.log_odds is not None]
    terms, label = (torch.cat([part[k] for part in parts]) if parts else torch.zeros(0, 2)[:, 0] for k in range(2))
    if not (bool((label == 1).any()) and bool((label == 0).any())):
        return potential
    regression = LogisticRegression(C=REGULARISATION).fit(terms.double().numpy(), label.numpy())
    for buffer, value in zip((potential.explains, potential.score), regression.coef_[0], strict=True):
        buffer.fill_(float(value))
    potential.bias.fill_(float(regression.intercept_[0]))
    return potential


def judge_clusters(model: JointScanCRF, part: Material) -> tuple[Tensor, Tensor]:
    """The potential's terms (P, 2) of the movers considered in a batch, and (P,) 1 if the cluster is a true mover's, else 0.

    A cluster with points of which none is annotated is left out: nobody knows what it is.
    """
    view = model.view(part.batch, model.learned_inputs(part.batch, part.start))
    start = view.in_unit(part.start).considered()
    parameters, config = model.fitted, model.config.inference
    state = joint.first_state(view, start, config)
    assert start.log_odds is not None
    terms = ClusterPotential.terms(evidence(view, start, state, parameters, config), start.log_odds)
    found = find_candidates(view, state.motions.value, state.motions.active, config)
    cluster = joint.update_clusters(view, start, state, found, parameters, config).cluster
    label = is_true_mover(view, start, cluster)
    considered = start.active & ~is_unknown(view, start, cluster)
    considered[:, 0] = False
    return terms[considered], label[considered].long()


def is_true_mover(view: PairView, start: Start, cluster: Tensor) -> Tensor:
    """(B, C) whether most of a cluster's points belong to one true mover of which no other cluster has more. cluster: (B, N)."""
    truth = view.batch.truth
    assert truth is not None
    own = torch.nn.functional.one_hot(cluster.clamp(min=0), start.motions.shape[1]) * (cluster >= 0)[..., None]  # (B, N, C)
    true = torch.nn.functional.one_hot(truth.cluster.clamp(min=0), truth.motions.shape[1]) * (truth.cluster > 0)[..., None]
    shared = (own * truth.known[..., None]).float().mT @ true.float()  # (B, C, G)
    most, which = shared.max(-1)
    is_pure = most > PURE * (own * truth.known[..., None]).sum(1)
    is_first = most >= shared.amax(1).gather(1, which)
    return is_pure & is_first & (most > 0)


def is_unknown(view: PairView, start: Start, cluster: Tensor) -> Tensor:
    """(B, C) whether a cluster has points, but none that are annotated. cluster: (B, N)."""
    truth = view.batch.truth
    assert truth is not None
    own = torch.nn.functional.one_hot(cluster.clamp(min=0), start.motions.shape[1]) * (cluster >= 0)[..., None]  # (B, N, C)
    has_known: Tensor = (own * truth.known[..., None]).any(1)
    return own.any(1) & ~has_known
