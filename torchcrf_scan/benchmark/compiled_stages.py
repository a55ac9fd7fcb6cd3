"""The stages in machine code, on the state of every pair after one round from the true motions. Imports numba.

Candidates and boosted scores are timed as in a first round; later ones look at what has changed alone.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import torch

from torchcrf_scan.batch import ScanPairBatch
from torchcrf_scan.compiled import decode
from torchcrf_scan.compiled.association import log_pairwise_of, log_unary_of, registered_points, update_static, workspace
from torchcrf_scan.compiled.clustering import node_potentials, transition_potentials
from torchcrf_scan.compiled.kept_candidates import Kept, kept_of, update
from torchcrf_scan.compiled.messages import max_marginals
from torchcrf_scan.compiled.selection import discard_vacuous
from torchcrf_scan.compiled.surface import surface_of
from torchcrf_scan.inference.initialise import Start, nearest_association
from torchcrf_scan.inference.pseudo_likelihood import true_plugins
from torchcrf_scan.learning.plugins import reach_of_truth
from torchcrf_scan.model import JointScanCRF
from torchcrf_scan.scan import ScanPair

LOG_ODDS = 2.0  # of every mover that is there

Stages = dict[str, Callable[[], object]]


@torch.no_grad()
def true_start(batch: ScanPairBatch, clusters: int) -> Start:
    """The annotated motions: looking for them would take far longer than all that is timed."""
    truth = true_plugins(batch, clusters)
    reach = reach_of_truth(truth, batch)
    nearest = nearest_association(batch, truth.motions, truth.active, reach)
    tangents = torch.zeros_like(batch.target)
    for b, target in enumerate(batch.target):
        points = decode.array_of(target[batch.target_mask[b]])
        scan = surface_of(
            points, float(batch.range_noise[b]), bool(batch.target_closed[b]), decode.array_of(batch.target_origin[b])
        )
        tangents[b, : len(points)] = torch.from_numpy(scan.tangent)
    return Start(truth.motions, truth.active, nearest, tangents, reach)


def stages_of_pair(model: JointScanCRF, pair: ScanPair) -> Stages:
    """Every stage as a call without arguments. pair: annotated; model: one that says `compiled`, or `auto`."""
    batch = ScanPairBatch.collate([pair])
    clusters = model.config.inference.clusters - 1
    start = decode.start_of(true_start(batch, clusters), 0, len(pair.source), len(pair.target))
    learned, settings, scans = decode.learned_of(model.fitted), decode.settings_of(model.config), decode.pair_of(batch, 0)
    scene = decode.scene_of(scans, start, settings)
    source, log_odds = scene.source, np.full(clusters, LOG_ODDS)

    first = decode.first_state(scene, start, True, settings)
    tables = decode.tables_of(scene, first, learned.clustering)
    first.cluster[:] = decode.nearest_clusters(tables, scene.reach, first.association)
    kept = kept_of(len(source), len(pair.target), clusters, settings.candidates)
    state = decode.step(scene, first, tables, kept, workspace(*kept.index.shape), learned, settings)
    tables, states = decode.tables_of(scene, state, learned.clustering), np.flatnonzero(state.active)

    def candidates() -> Kept:
        found = kept_of(len(source), len(pair.target), clusters, settings.candidates)
        update(found, scene.boxes, source, tables.moved, state.motions, state.active)
        return found

    index = candidates().index
    mask = np.ones(index.shape, np.bool_)

    def boosted_scores() -> Any:
        moved = registered_points(source, state.motions, state.active, state.log_cluster)
        sight = decode.look_at_all(scene.target_sweep, moved)
        work = workspace(*index.shape)
        update_static(learned.association, scene.descriptors, work, index, mask)
        return log_unary_of(learned.association, scene.descriptors, work, moved, *sight)

    nodes = boosted_scores(), node_potentials(tables, states, learned.clustering)

    def pairwise_tables() -> Any:
        between_clusters = transition_potentials(tables, states, nodes[1], learned.clustering)
        return log_pairwise_of(learned.association, scene.descriptors, index), between_clusters

    edges = pairwise_tables()
    return {
        "initialisation": lambda: model.initialise(batch),
        "scan_descriptors": lambda: decode.scene_of(scans, start, settings),
        "candidates": candidates,
        "mover_selection": lambda: discard_vacuous(tables, state.active.copy(), log_odds, learned.clustering, learned.worth),
        "cluster_scores": lambda: decode.tables_of(scene, state, learned.clustering),
        "boosted_scores": boosted_scores,
        "pairwise_tables": pairwise_tables,
        "messages": lambda: [max_marginals(*of_chain) for of_chain in zip(nodes, edges, strict=True)],
        "motion_updates": lambda: decode.refit(scene, state, state.cluster, state.motions, learned, settings),
        "read_out": lambda: decode.read_out(scene, state, True, 1, learned, settings),
    }


def compiled_stages(model: JointScanCRF, pairs: Sequence[ScanPair]) -> Stages:
    """The stages on a batch, one pair after the other."""
    each = [stages_of_pair(model, pair) for pair in pairs]
    return {name: lambda name=name: [stages[name]() for stages in each] for name in each[0]}  # type: ignore[misc]
