"""Scales and constants of the features from annotated pairs (spec 1.3, 3, 4.1, 4.2)."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from torchcrf_scan.errors import TorchCRFScanError
from torchcrf_scan.features import association
from torchcrf_scan.features.candidates import squared_distances
from torchcrf_scan.features.potentials import AssociationStates, Boosters, PairView, association_unary
from torchcrf_scan.features.scales import Scales
from torchcrf_scan.features.shape import gather_points
from torchcrf_scan.geometry import se2
from torchcrf_scan.inference.pseudo_likelihood import PlugIns
from torchcrf_scan.loops.shape import ORDERS
from torchcrf_scan.names import LOCAL_CHANNELS, SCALED_EDGES

FLOOR = 0.02  # metres and radians
CLUSTER_FLOOR = 0.05  # metres
WORST_SHARE = 0.1


def robust_scale(errors: Tensor, floor: float) -> Tensor:
    """1.4826 median |error|, at least `floor`; `floor` for empty input. errors: (P,)."""
    if len(errors) == 0:
        return errors.new_tensor(floor)
    return (1.4826 * errors.abs().median()).clamp(min=floor)


def fit_scales(views: Sequence[PairView], plugins: Sequence[PlugIns]) -> Scales:
    """Robust scales of every error over the true pairs, then the features' values at the outlier state (their worst tenth).

    Works in float64; raises TorchCRFScanError if no pair has an association.
    """
    parts = [true_errors(view, plug) for view, plug in zip(views, plugins, strict=True)]
    errors = {name: torch.cat([part[name] for part in parts]) for name in parts[0]}
    if len(errors["cluster"]) == 0:
        raise TorchCRFScanError("pairs: expected at least one true association to fit the scales on, got none")
    scales = Scales()
    for f, name in enumerate(LOCAL_CHANNELS):
        scales.local[f] = robust_scale(errors[name], FLOOR)
    for p, name in enumerate(SCALED_EDGES):
        scales.pairwise[p] = robust_scale(errors[name], FLOOR)
    scales.cluster_distance.copy_(robust_scale(errors["cluster"], CLUSTER_FLOOR))
    scales.outlier_threshold.copy_((3 * scales.cluster_distance).clamp(min=0.3))
    scales.gate.copy_(fit_gate(errors["cluster"], errors["unmatched"]))
    scales.neighbour_weight.copy_(2 * errors["step"].median() if len(errors["step"]) else scales.neighbour_weight)
    scales.neighbour_distance.copy_(robust_scale(errors["elongation"], CLUSTER_FLOOR))
    fit_outlier_constants(views, plugins, scales)
    return scales


def fit_gate(matched: Tensor, unmatched: Tensor) -> Tensor:
    """() the distance that separates true pairs (P,) from the nearest points of outliers (Q,) with the fewest errors."""
    gates = torch.cat([matched, unmatched, matched.new_zeros(1)]).clamp(min=CLUSTER_FLOOR).unique()  # ascending
    right, wrong = (torch.searchsorted(of.sort().values, gates, right=True) for of in (matched, unmatched))  # number accepted
    return gates[(right - wrong).argmax()]


def true_errors(view: PairView, plugins: PlugIns) -> dict[str, Tensor]:
    """Every error of the features at the true labels, flattened to (P,), float64."""
    batch = view.batch
    assert batch.truth is not None
    partner_index = batch.truth.association.clamp(min=0)[..., None]  # (B, N, 1)
    inlier = batch.truth.known & (batch.truth.association >= 0) & (plugins.label >= 0) & plugins.known
    partner = gather_points(batch.target, partner_index)[:, :, 0]
    moved_by_own = own_motion(plugins, batch.source)
    out: dict[str, Tensor] = {}

    def of_partner(values: Tensor) -> Tensor:
        return values.gather(
            1, partner_index.squeeze(-1).view(*partner_index.shape[:2], *[1] * (values.dim() - 2)).expand(-1, -1, *values.shape[2:])
        )

    source, target = view.source_shape, view.target_shape
    for name, mine, theirs in (("dist", source.distance, target.distance), ("geo", source.geodesic, target.geodesic)):
        difference = mine - of_partner(theirs)  # (B, N, 3, 2)
        for order, k in enumerate(ORDERS):
            out[f"{name}{k}"] = difference[:, :, order][inlier].flatten().double()
    turned = se2.wrap(source.angle - of_partner(target.angle))
    for order, k in enumerate(ORDERS):
        out[f"angle{k}"] = turned[:, :, order][inlier].double()
    out["radius"] = (source.radius - torch.linalg.vector_norm(partner, dim=-1))[inlier].double()
    initial = se2.apply(batch.initial_motion, batch.source)
    out["translation"] = torch.linalg.vector_norm(initial - partner, dim=-1)[inlier].double()
    residual = torch.linalg.vector_norm(moved_by_own - partner, dim=-1)[inlier].double()
    unmatched = batch.truth.known & batch.source_mask & (batch.truth.association < 0)
    nearest = squared_distances(moved_by_own, batch.target, batch.target_mask).amin(-1).sqrt()
    out["unmatched"] = nearest[unmatched].double()
    out["registered_translation"] = out["cluster"] = residual
    return out | edge_errors(batch.source, partner, inlier, plugins.label)


def own_motion(plugins: PlugIns, source: Tensor) -> Tensor:
    """(B, N, 2) points moved with their true cluster, outliers with the background."""
    motion = plugins.motions.gather(1, plugins.label.clamp(min=0)[..., None].expand(-1, -1, 3))
    return se2.apply(motion, source[:, :, None])[:, :, 0]


def edge_errors(source: Tensor, partner: Tensor, inlier: Tensor, label: Tensor) -> dict[str, Tensor]:
    """Errors on the edges between true inliers; elongation only within one cluster."""
    both = inlier[:, 1:] & inlier[:, :-1]
    v1, v2 = source.diff(dim=1), partner.diff(dim=1)
    d1, d2 = torch.linalg.vector_norm(v1, dim=-1), torch.linalg.vector_norm(v2, dim=-1)
    same = both & (label[:, 1:] == label[:, :-1])
    return {
        "pairwise_distance": (d1 - d2)[both].double(),
        "pairwise_translation": torch.linalg.vector_norm(v1 - v2, dim=-1)[both].double(),
        "elongation": (d2 - d1)[same].double(),
        "step": d1[both].double(),
    }


def fit_outlier_constants(views: Sequence[PairView], plugins: Sequence[PlugIns], scales: Scales) -> None:
    """c_f and c_pd, c_pt: the tenth percentile of each feature over true pairs and true inlier edges (spec 3, 5.1)."""
    local, edges = [], []
    boosters = Boosters(1)
    for view, plug in zip(views, plugins, strict=True):
        batch = view.batch
        assert batch.truth is not None
        inlier = batch.truth.known & plug.known & (batch.truth.association >= 0) & (plug.label >= 0)
        index = batch.truth.association.clamp(min=0)[..., None]
        states = AssociationStates.of(view, index, torch.ones_like(index, dtype=torch.bool), scales, boosters)
        unary = association_unary(view, states, own_motion(plug, batch.source), scales, boosters)
        local.append(unary[:, :, 0, : len(LOCAL_CHANNELS)][inlier])
        pairwise = association.pairwise_features(batch.source, batch.target, index, scales)[:, :, 0, 0, -len(SCALED_EDGES) :]
        edges.append(pairwise[inlier[:, 1:] & inlier[:, :-1]])
    scales.local_outlier.copy_(torch.cat(local).quantile(WORST_SHARE, dim=0))
    on_edges = torch.cat(edges)
    if len(on_edges):
        scales.pairwise_outlier.copy_(on_edges.quantile(WORST_SHARE, dim=0))
