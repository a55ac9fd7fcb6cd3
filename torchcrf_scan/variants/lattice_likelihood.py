"""Likelihood of the annotation under the lattice: pseudo-likelihood by super-nodes, and exact (spec 6.2, 6.5, 7.7)."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields, replace
from typing import ClassVar

import torch
from torch import Tensor

from torchcrf_scan.config import InferenceConfig, ModelConfig
from torchcrf_scan.features.learned import add_log
from torchcrf_scan.features.potentials import Boosters, PairView, find_candidates, possible_clusters
from torchcrf_scan.features.scales import Scales
from torchcrf_scan.inference.pseudo_likelihood import Design, PlugIns, at_true_neighbours, beside_true_neighbours, states_with_truth
from torchcrf_scan.inference.state import Parameters
from torchcrf_scan.names import ASSOCIATION_WEIGHTS, CLUSTERING_WEIGHTS
from torchcrf_scan.variants.lattice import lattice_log_partition, lattice_score
from torchcrf_scan.variants.lattice_features import (
    ASSOCIATION_PAIRWISE,
    CLUSTER_PAIRWISE,
    ELASTIC_KINDS,
    ELASTIC_WEIGHTS,
    MOVING_WEIGHTS,
    STATIC_WEIGHTS,
    LatticeFeatures,
    lattice_extra,
    lattice_features,
    transition_kinds,
)

WEIGHTS = len(ASSOCIATION_WEIGHTS) + len(CLUSTERING_WEIGHTS)


@dataclass(frozen=True, slots=True)
class LatticeChain(LatticeFeatures):
    """The lattice's features and the true labels; the counterpart of `pseudo_likelihood.Chain`.

    Attributes:
        association, cluster: (B, N) true states, the outliers last.
        known: (B, N) nodes both of whose labels are annotated; the others cut the chain.
        extra: learned log potentials that broadcast to (B, N, A, D); None: none.
        axes, labels: as in `pseudo_likelihood.Chain`; a association states, d clusters.
    """

    axes: ClassVar[dict[str, str]] = {
        **{"static": "na", "moving": "nad", "mask": "nad"},
        **{"pairwise_association": "eaa", "elastic": "eaa", "pairwise_cluster": "edd"},
        **{"association": "n", "cluster": "n", "known": "n"},
    }
    labels: ClassVar[dict[str, str]] = {"association": "a", "cluster": "d"}

    association: Tensor
    cluster: Tensor
    known: Tensor
    extra: Tensor | None = None

    def design(self) -> Design:
        """The 44 features of every super-node at its true neighbours; the index of state (j, k) is j D + k."""
        D = self.mask.shape[3]
        features = self.moving.new_zeros(*self.mask.shape, WEIGHTS)
        features[..., list(STATIC_WEIGHTS)] = self.static[:, :, :, None]
        features[..., list(MOVING_WEIGHTS)] = self.moving
        of_association = at_true_neighbours(self.pairwise_association, self.association, self.known)
        features[..., ASSOCIATION_PAIRWISE] = of_association[:, :, :, None]
        of_cluster = at_true_neighbours(self.pairwise_cluster, self.cluster, self.known)
        features[..., CLUSTER_PAIRWISE] = of_cluster[:, :, None]
        features[..., ELASTIC_WEIGHTS] = self._elastic_at_true_neighbours()
        extra = None if self.extra is None else self.extra.expand(self.mask.shape).flatten(2)
        return Design(features.flatten(2, 3), self.mask.flatten(2), self.association * D + self.cluster, self.known, extra)

    def _elastic_at_true_neighbours(self) -> Tensor:
        """(B, N, A, D, 3): the only features of both labels of a node and of its neighbour."""
        D = self.mask.shape[3]
        by_kind = self.elastic.new_tensor(ELASTIC_KINDS).T[transition_kinds(D, self.mask.device)]  # (D, D, 3)
        by_kind = by_kind.expand(*self.elastic.shape[:2], D, D, 3)
        of_association = beside_true_neighbours(self.elastic, self.association, self.known)
        of_cluster = beside_true_neighbours(by_kind, self.cluster, self.known)
        return sum(a[:, :, :, None] * c[:, :, None] for a, c in zip(of_association, of_cluster, strict=True))  # type: ignore[return-value]

    def log_likelihood(self, weights: Tensor) -> Tensor:
        """(B,) exact log p(both true labellings | observation); 0 for unannotated nodes. weights: (44,)."""
        potentials = self.potentials(weights)
        potentials = replace(potentials, log_unary=add_log(potentials.log_unary, self.extra)).cut(self.known)
        states = self.mask.shape[2] * self.mask.shape[3]
        free = (~self.known).sum(-1).to(potentials.log_unary) * math.log(states)  # an unknown node adds log A D to log Z
        return lattice_score(potentials, self.association, self.cluster) + free - lattice_log_partition(potentials)


def lattice_chain(view: PairView, plugins: PlugIns, scales: Scales, boosters: Boosters, config: InferenceConfig) -> LatticeChain:
    """The lattice at the plug-ins' motions; of the other plug-ins only the true clusters are used.

    States are the candidates of inference and the true target point, times the clusters.
    """
    batch = view.batch
    found = find_candidates(view, plugins.motions, plugins.active, config)
    as_found, states, association = states_with_truth(view, found, scales, boosters)
    possible = possible_clusters(plugins.active, view.within(plugins.reach), batch.source.shape[1])
    features = lattice_features(view, states, plugins.motions, found.nearest, possible, scales, boosters, plugins.reach, as_found)
    return LatticeChain(
        **{f.name: getattr(features, f.name) for f in fields(LatticeFeatures)},
        association=association,
        cluster=torch.where(plugins.label >= 0, plugins.label, plugins.motions.shape[1]),
        known=plugins.known & batch.source_mask,
        extra=lattice_extra(view.learned, states.candidates, possible.shape[-1]),
    )


def pseudo_log_likelihood(view: PairView, plugins: PlugIns, parameters: Parameters, config: ModelConfig) -> Tensor:
    """(B,) sum over super-nodes."""
    design = lattice_chain(view, plugins, parameters.scales, parameters.boosters, config.inference).design()
    return design.log_likelihood(torch.cat([parameters.association, parameters.clustering])).sum(-1)
