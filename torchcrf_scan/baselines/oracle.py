"""Answers of the model with a part of the truth in hand: what each part of it could gain at most.

They read the annotation and are no methods: their scores tell where errors come from (`evaluation.causes`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch

from torchcrf_scan.batch import ScanPairBatch
from torchcrf_scan.evaluation.causes.movers import TrueMover
from torchcrf_scan.evaluation.causes.trace import SearchTrace
from torchcrf_scan.evaluation.counterparts import annotation_of
from torchcrf_scan.inference.start import Start, beyond_reach, nearest_association
from torchcrf_scan.loops.pair import pair_of
from torchcrf_scan.loops.shape import resolution
from torchcrf_scan.model import JointScanCRF, with_config
from torchcrf_scan.scan import BACKGROUND, OUTLIER, Bools, Floats, PairPrediction, ScanPair
from torchcrf_scan.search.accept import score_of
from torchcrf_scan.search.pairs import start_from, start_tensors
from torchcrf_scan.search.survey import grids_of, survey_at


@torch.no_grad()
def with_true_background(model: JointScanCRF, pair: ScanPair) -> PairPrediction:
    """The answer if the search begins at the true motion of the background, where that is known."""
    truth = annotation_of(pair)
    batch = _batch(model, pair)
    arrays = pair_of(batch, 0)
    if arrays.fewest_points == 0 or not np.isfinite(truth.motions[BACKGROUND]).all():
        return model(batch).pair(0, pair)
    seen = survey_at(*grids_of(arrays), truth.motions[BACKGROUND], arrays.dt)
    start = start_from(arrays, seen, score_of(model.hypothesis_score), model.config.motions)
    return model(batch, start_tensors([start], batch)).pair(0, pair)


@torch.no_grad()
def with_right_hypotheses(model: JointScanCRF, pair: ScanPair, trace: SearchTrace) -> PairPrediction:
    """The answer if of the pool the best right hypothesis of every true mover is accepted, and no other one."""
    chosen = [of.right_hypotheses(trace)[:1] for of in _movers(pair, trace).values()]
    which = np.concatenate([np.zeros(0, np.int64), *chosen])
    motions = np.concatenate([trace.background[None], trace.motions[which]])
    return _from(model, pair, motions, trace.members[which])


@torch.no_grad()
def with_true_motions(model: JointScanCRF, pair: ScanPair, trace: SearchTrace) -> PairPrediction:
    """The answer at the true motions of background and movers, which stay as they are: the labels are the model's."""
    truth, movers = annotation_of(pair), _movers(pair, trace)
    background = truth.motions[BACKGROUND]
    rows = [background if np.isfinite(background).all() else trace.background, *(of.motion for of in movers.values())]
    members = np.array([of.is_member for of in movers.values()], dtype=bool).reshape(len(movers), len(pair.source))
    return _from(_at_given_motions(model), pair, np.stack(rows), members)


def _movers(pair: ScanPair, trace: SearchTrace) -> dict[int, TrueMover]:
    """The true movers of known motion that have points, by number, the largest first."""
    truth, beam = annotation_of(pair), pair.source.beam
    cluster = np.where(truth.ignore[beam], OUTLIER, truth.cluster[beam])
    numbers, sizes = np.unique(cluster[cluster > BACKGROUND], return_counts=True)
    largest = numbers[np.argsort(-sizes, kind="stable")].tolist()
    return {k: TrueMover.of(k, pair, truth, trace.units) for k in largest if np.isfinite(truth.motions[k]).all()}


def _from(model: JointScanCRF, pair: ScanPair, motions: Floats, members: Bools) -> PairPrediction:
    """The answer from a start with these clusters and no others: motions (1+G, 3) and the movers' points (G, N)."""
    batch, C = _batch(model, pair), model.config.motions
    arrays = pair_of(batch, 0)
    if arrays.fewest_points == 0:
        return model(batch).pair(0, pair)
    motions, members = motions[:C], members[: C - 1]
    rows = np.concatenate([motions, np.repeat(motions[:1], C - len(motions), axis=0)])  # empty slots, as in the search
    every = np.zeros((C, len(pair.source)), np.bool_)
    every[1 : 1 + len(members)] = members
    like = batch.source
    active = torch.arange(C, device=like.device)[None] <= len(members)
    at = torch.from_numpy(rows)[None].to(like)
    unit = torch.tensor([resolution(arrays.source, arrays.target, arrays.noise)]).to(like)
    reach = beyond_reach(batch.source, torch.from_numpy(every)[None].to(like.device), unit)
    start = Start(at, active, nearest_association(batch, at, active, reach), model.initialise(batch).target_tangents, reach)
    return model(batch, start).pair(0, pair)


def _batch(model: JointScanCRF, pair: ScanPair) -> ScanPairBatch:
    reference = next(model.parameters())
    return ScanPairBatch.collate([pair], reference.dtype).without_truth().to(reference.device)


def _at_given_motions(model: JointScanCRF) -> JointScanCRF:
    """The same model, with the same weights, that leaves the motions of its start as they are."""
    return with_config(model, replace(model.config, inference=replace(model.config.inference, motion_metric="given")))


ORACLES = {  # what is known: the answer of (model, pair, trace)
    "accepting the right hypotheses of the pool": with_right_hypotheses,
    "true motions": with_true_motions,
    "true background": lambda model, pair, trace: with_true_background(model, pair),
}


def match_all(model: JointScanCRF, pairs: Sequence[ScanPair], traces: Sequence[SearchTrace]) -> dict[str, list[PairPrediction]]:
    """The answers of every oracle of `ORACLES`."""
    both = list(zip(pairs, traces, strict=True))
    return {name: [answer(model, pair, trace) for pair, trace in both] for name, answer in ORACLES.items()}
