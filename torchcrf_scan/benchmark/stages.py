"""The stages of decoding, each as a call on one realistic state: a table {stage: call} a backend."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import torch

from torchcrf_scan.batch import ScanPairBatch
from torchcrf_scan.features import clustering
from torchcrf_scan.features.association import pairwise_features
from torchcrf_scan.features.potentials import (
    AssociationStates,
    association_potentials,
    association_unary,
    clustering_potentials,
    clustering_unary,
    find_candidates,
    possible_clusters,
    registered_points,
)
from torchcrf_scan.inference import joint
from torchcrf_scan.inference.messages import chain_beliefs
from torchcrf_scan.inference.selection import discard_vacuous
from torchcrf_scan.model import JointScanCRF
from torchcrf_scan.scan import ScanPair

Stages = dict[str, Callable[[], object]]

WHOLE = "whole"
STAGES = (
    *("initialisation", "scan_descriptors", "candidates", "mover_selection", "cluster_scores", "boosted_scores"),
    *("pairwise_tables", "messages", "motion_updates", "read_out"),
)


def calls_per_pair(rounds: float) -> dict[str, float]:
    """How often decoding calls a stage, given its rounds; what a stage calls in its turn is not counted again."""
    once = dict.fromkeys(("initialisation", "scan_descriptors", "read_out"), 1.0)
    each_round = dict.fromkeys(("cluster_scores", "boosted_scores", "pairwise_tables", "messages"), rounds)
    selections = min(rounds, float(joint.SELECTION_ROUNDS))
    return {**once, **each_round, "candidates": rounds + 1, "motion_updates": 2 * rounds, "mover_selection": selections}


def eager_stages(model: JointScanCRF, pairs: Sequence[ScanPair]) -> Stages:
    """The stages of the reference on a batch of pairs, in the state after one round."""
    with torch.no_grad():
        batch = ScanPairBatch.collate(pairs, model.association_weights["sequence"].dtype).without_truth()
        parameters, config, model_config = model.fitted, model.config.inference, model.config
        scales, boosters, mask = parameters.scales, parameters.boosters, batch.source_mask
        view = model.view(batch)
        start = model.initialise(batch).scaled(view.factor)
        considered = start if start.log_odds is None else start.considered()
        first = joint.first_state(view, considered, parameters, config)
        state = joint.step(view, considered, first, parameters, config, model_config.chains, model_config.coupling)
        scans, motions = (view.batch.source, view.batch.target), state.motions
        found = find_candidates(view, motions.value, motions.active, config)
        states = AssociationStates.of(view, found.index, found.mask, scales, boosters)
        moved = registered_points(scans[0], motions.value, motions.active, state.log_cluster)
        at = clustering.correspond(*scans, motions.value, found.nearest, state.association)
        possible = possible_clusters(motions.active, start.reach, scans[0].shape[1])
        unary = association_unary(view, states, moved, scales, boosters)
        local = clustering_unary(view, at, motions.value, motions.active, scales)

    def boosted_scores() -> object:
        again = AssociationStates.of(view, found.index, found.mask, scales, boosters)
        return association_unary(view, again, moved, scales, boosters)

    def cluster_scores() -> object:
        again = clustering.correspond(*scans, motions.value, found.nearest, state.association)
        return clustering_unary(view, again, motions.value, motions.active, scales)

    def pairwise_tables() -> Any:
        edges = pairwise_features(*scans, found.index, scales), clustering.pairwise_features(scans[0], at, scales)
        return (
            association_potentials(unary, edges[0], found.mask, parameters.association),
            clustering_potentials(local, edges[1], possible, parameters.clustering),
        )

    with torch.no_grad():
        potentials = pairwise_tables()
    done, rounds = torch.ones(len(batch), dtype=torch.bool), torch.ones(len(batch), dtype=torch.int64)
    stages: Stages = {
        "initialisation": lambda: model.initialise(batch),
        "scan_descriptors": lambda: model.view(batch),
        "candidates": lambda: find_candidates(view, motions.value, motions.active, config),
        "cluster_scores": cluster_scores,
        "boosted_scores": boosted_scores,
        "pairwise_tables": pairwise_tables,
        "messages": lambda: [chain_beliefs(nodes, edges, mask, config.temperature) for nodes, edges in potentials],
        "motion_updates": lambda: joint.update_motions(view, start, state, parameters, config),
        "read_out": lambda: joint.read_out(view, start, state, parameters, config, done, rounds),
    }
    if start.log_odds is not None:
        stages["mover_selection"] = lambda: discard_vacuous(view, considered, first, parameters, config)
    return {name: torch.no_grad()(call) for name, call in stages.items()}


def compiled_stages(model: JointScanCRF, pairs: Sequence[ScanPair]) -> Stages:
    """The same in machine code; needs numba, and pairs that are annotated."""
    from torchcrf_scan.benchmark import compiled_stages as compiled

    return compiled.compiled_stages(model, pairs)


TABLES: Mapping[str, Callable[[JointScanCRF, Sequence[ScanPair]], Stages]] = {
    "eager": eager_stages,
    "compiled": compiled_stages,
}
