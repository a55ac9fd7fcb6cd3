"""Learned inputs from a neural network: embeddings whose similarity scores associations, and extra log potentials.

A similarity enters twice, each time with a named weight of the association chain:

    log unary of a candidate    += embedding * similarity
    data score of a candidate   += embedding_data * similarity, before the data booster's weight a13

so that its whole weight is `embedding + data_boosting * embedding_data`, and through the data score it also reaches the outlier
booster (best score and its lead). The log potentials of `ExtraLogUnary` are added without a weight, in nats.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from torchcrf_scan.features.shape import gather_points
from torchcrf_scan.tree import tensor_tree

EMBEDDING_WEIGHTS = ("embedding", "embedding_data")  # of the association chain, if `FeatureConfig.embedding` is on
SHORTEST = 1e-3  # added in quadrature to an embedding's length, so that the direction of very short ones hardly counts


@tensor_tree
@dataclass(frozen=True, slots=True)
class ExtraLogUnary:
    """Learned log potentials of source points, in nats; None: none. Padding is ignored.

    Attributes:
        outlier: (B, N) of the outlier state of both chains.
        moving: (B, N) of every mover's state of the clustering chain.
    """

    outlier: Tensor | None = None
    moving: Tensor | None = None

    def plus(self, other: ExtraLogUnary) -> ExtraLogUnary:
        """The sum of both."""
        return ExtraLogUnary(_sum(self.outlier, other.outlier), _sum(self.moving, other.moving))


@dataclass(frozen=True, slots=True)
class Embeddings:
    """Embeddings of the points, prepared so that their similarity is a dot product.

    Attributes:
        source: (B, N, C), target: (B, M, C), 0 in the padding.
        weight, data_weight: () of the similarity in the unary and in the data score.
    """

    source: Tensor
    target: Tensor
    weight: Tensor
    data_weight: Tensor

    @classmethod
    def of(
        cls, source: Tensor, target: Tensor, masks: tuple[Tensor, Tensor], kind: str, weights: tuple[Tensor, Tensor]
    ) -> Embeddings:
        """source: (B, N, C), target: (B, M, C); masks: (B, N), (B, M) real points; kind: `dot` or `cosine`; weights: () each."""
        both = [torch.where(mask[..., None], of, 0.0) for of, mask in zip((source, target), masks, strict=True)]
        if kind == "cosine":
            both = [of * torch.rsqrt((of**2).sum(-1, keepdim=True) + SHORTEST**2) for of in both]
        else:
            both[0] = both[0] * max(1, source.shape[-1]) ** -0.5
        return cls(both[0], both[1], weights[0], weights[1])

    def similarity(self, candidates: Tensor) -> Tensor:
        """(B, N, K) cosine, or dot product over sqrt(C), with the candidates (B, N, K). Costs N K C."""
        return (self.source[:, :, None] * gather_points(self.target, candidates)).sum(-1)

    def data_score(self, candidates: Tensor) -> Tensor:
        """(B, N, K) the similarity's contribution to the data score."""
        return self.data_weight * self.similarity(candidates)


@dataclass(frozen=True, slots=True)
class LearnedInputs:
    """Embeddings and extra log potentials of a batch, checked.

    Attributes:
        embeddings: of the points; None: none.
        outlier, moving: (B, N) as in `ExtraLogUnary`, 0 in the padding.
    """

    embeddings: Embeddings | None
    outlier: Tensor | None
    moving: Tensor | None

    def association(self, candidates: Tensor) -> Tensor | None:
        """(B, N, K+1) log potentials of the association chain, the outlier last. candidates: (B, N, K)."""
        if self.embeddings is None and self.outlier is None:
            return None
        none = torch.zeros_like(candidates, dtype=self._reference.dtype)
        inliers = none if self.embeddings is None else self.embeddings.weight * self.embeddings.similarity(candidates)
        outlier = torch.zeros_like(candidates[..., 0], dtype=none.dtype) if self.outlier is None else self.outlier
        return torch.cat([inliers, outlier[..., None]], dim=-1)

    def clustering(self, states: int) -> Tensor | None:
        """(B, N, D) log potentials of the clustering chain, background first, outlier last. states: D."""
        if self.outlier is None and self.moving is None:
            return None
        none = torch.zeros_like(self._reference)
        outlier, moving = (none if of is None else of for of in (self.outlier, self.moving))
        return torch.stack([none, *[moving] * (states - 2), outlier], dim=-1)

    @property
    def _reference(self) -> Tensor:
        """A tensor with the dtype and device of the inputs, (B, N) if there are extra log potentials."""
        given = (self.outlier, self.moving, None if self.embeddings is None else self.embeddings.source)
        return next(value for value in given if value is not None)


def _sum(one: Tensor | None, other: Tensor | None) -> Tensor | None:
    return one if other is None else other if one is None else one + other


def add_log(log_unary: Tensor, extra: Tensor | None) -> Tensor:
    """The sum, or `log_unary` if there are no extra potentials."""
    return log_unary if extra is None else log_unary + extra


def association_extra(learned: LearnedInputs | None, candidates: Tensor) -> Tensor | None:
    """`LearnedInputs.association`; None without learned inputs."""
    return None if learned is None else learned.association(candidates)


def clustering_extra(learned: LearnedInputs | None, states: int) -> Tensor | None:
    """`LearnedInputs.clustering`; None without learned inputs."""
    return None if learned is None else learned.clustering(states)
