"""Whole pairs, from two scans to the answer: what `JointScanCRF.initialise` and `JointScanCRF.forward` are without gradients.

Every pair of a batch is worked on by one thread; where there is one pair, the threads share the hypotheses of its background.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import TypeVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchcrf_scan.batch import Prediction, ScanPairBatch
from torchcrf_scan.compiled import aligned, decode
from torchcrf_scan.compiled.background import follow
from torchcrf_scan.compiled.decode import Decoded, Learned, Pair, PairStart, Settings
from torchcrf_scan.compiled.field import Field
from torchcrf_scan.compiled.hypotheses import members_of
from torchcrf_scan.compiled.jit import Array
from torchcrf_scan.compiled.movers import Score
from torchcrf_scan.compiled.search import alone, find_background
from torchcrf_scan.compiled.survey import Surveyed, fields_of, start_at, survey_at
from torchcrf_scan.compiled.threads import for_each, in_parts
from torchcrf_scan.features.learned import LearnedInputs
from torchcrf_scan.inference import hypotheses as eager_hypotheses
from torchcrf_scan.inference import initialise as eager
from torchcrf_scan.inference import surface as eager_surface
from torchcrf_scan.inference.initialise import FEWEST_POINTS, Start
from torchcrf_scan.inference.movers import HypothesisScore
from torchcrf_scan.inference.uncertainty import Uncertainty

T = TypeVar("T")


def survey_pair(pair: Pair, dt: float, share: Callable = alone) -> Surveyed | None:
    """Surfaces, background and hypotheses; None where a scan has fewer than three points. share: see `background_pool`."""
    if min(len(pair.source), len(pair.target)) < FEWEST_POINTS:
        return None
    return survey_at(*find_start(pair, share), dt)


def find_start(pair: Pair, share: Callable) -> tuple[Field, Field, Array]:
    """Both scans and the background's motion (3,): where the pair's initial motion leads to, or what a search finds."""
    source, target = fields_of(pair)
    is_led, background = follow(pair.initial_motion, source, target) if pair.initial_motion.any() else (False, pair.initial_motion)
    return source, target, background if is_led else find_background(source, target, pair.initial_motion, share)


def survey(batch: ScanPairBatch) -> list[eager.Survey | None]:
    """`inference.initialise.survey`, for learning, which goes on with tensors."""
    found = _of_pairs(lambda b, share: survey_pair(decode.pair_of(batch, b), float(batch.dt[b]), share), len(batch))
    return [None if seen is None else _as_tensors(seen, batch, b) for b, seen in enumerate(found)]


def initialise(batch: ScanPairBatch, score: Score, clusters: int) -> Start:
    """`inference.initialise.initialise`. clusters: C."""
    starts = _of_pairs(lambda b, share: start_pair(batch, b, score, clusters, share), len(batch))
    B, N, M = len(batch), batch.source.shape[1], batch.target.shape[1]
    reach = np.zeros((B, N, clusters), np.bool_)
    reach[..., 0] = True  # as everything is, in the padding too
    return Start(
        motions=torch.from_numpy(np.stack([start.motions for start in starts])).to(batch.source),
        active=torch.from_numpy(np.stack([start.active for start in starts])),
        association=_padded([start.association for start in starts], (N,), -1),
        target_tangents=_padded([start.target_tangents for start in starts], (M, 2), 0.0).to(batch.source),
        reach=_padded([start.reach for start in starts], (N, clusters), reach),
        log_odds=torch.from_numpy(np.stack([start.log_odds for start in starts])).to(batch.source),
    )


def start_pair(batch: ScanPairBatch, b: int, score: Score, clusters: int, share: Callable = alone) -> PairStart:
    """InitialiseRT of pair b."""
    pair, dt = decode.pair_of(batch, b), float(batch.dt[b])
    if min(len(pair.source), len(pair.target)) < FEWEST_POINTS:
        one = batch.select(torch.tensor([b]))
        start = eager.choose(one, [None], HypothesisScore(), clusters)
        return decode.start_of(start, 0, len(pair.source), len(pair.target))
    source, target, background = find_start(pair, share)
    return start_at(source, target, background, pair.initial_motion, dt, score, clusters)


def predict(
    batch: ScanPairBatch,
    start: Start | None,
    score: Score,
    learned: Learned,
    settings: Settings,
    states: int,
    inputs: LearnedInputs | None = None,
) -> Prediction:
    """`JointScanCRF.forward`: labels, motions and beliefs of every pair.

    Args:
        start: motions to begin with; looked for where absent. states: D. inputs: without embeddings.
    """

    def answer(b: int, share: Callable) -> Decoded:
        pair = decode.pair_of(batch, b, inputs)
        if start is None:
            own = start_pair(batch, b, score, states - 1, share)
        else:
            own = decode.start_of(start, b, len(pair.source), len(pair.target))
        return decode.decode_pair(pair, own, learned, settings)

    return _together(_of_pairs(answer, len(batch)), batch)


def aligned_inputs(batch: ScanPairBatch, start: Start, *, both: bool = True) -> tuple[Tensor, ...]:
    """`encoder.aligned.aligned_inputs`."""

    def look(b: int, _: Callable) -> list[Array]:
        pair = decode.pair_of(batch, b)
        own = decode.start_of(start, b, len(pair.source), len(pair.target))
        log_odds = own.log_odds if len(own.log_odds) else np.where(own.active, np.inf, -np.inf)
        sides = (False, True) if both else (False,)
        return [aligned.channels_of_side(pair, own.motions, log_odds, own.reach, is_target) for is_target in sides]

    found = _of_pairs(look, len(batch))
    lengths = batch.source.shape[1], batch.target.shape[1]
    return tuple(_padded([of[k] for of in found], (lengths[k], aligned.WIDTH), 0.0).to(batch.source) for k in range(1 + both))


def _of_pairs(function: Callable[[int, Callable], T], count: int) -> list[T]:
    """function(b, share) of every pair b."""
    if count == 1:
        return [function(0, in_parts)]
    return for_each(lambda b: function(b, alone), range(count))


def _as_tensors(seen: Surveyed, batch: ScanPairBatch, b: int) -> eager.Survey:
    n, m = int(batch.source_mask[b].sum()), int(batch.target_mask[b].sum())
    source = eager_surface.Surface.of(batch.source[b, :n], batch.range_noise[b], bool(batch.source_closed[b]))
    target = eager_surface.Surface.of(
        batch.target[b, :m], batch.range_noise[b], bool(batch.target_closed[b]), batch.target_origin[b]
    )
    motions, members = seen.hypotheses.motions, members_of(seen.hypotheses, np.arange(len(seen.hypotheses.motions)), n)
    found = eager_hypotheses.Hypotheses(torch.from_numpy(motions).to(batch.source), torch.from_numpy(members))
    background, features = (torch.from_numpy(values).to(batch.source) for values in (seen.leftover.background, seen.features))
    return eager.Survey(source, target, background, found, features)


def _together(answers: Sequence[Decoded], batch: ScanPairBatch) -> Prediction:
    """The answers of all pairs as padded tensors; padding is outliers, of which nothing is known."""
    N, like = batch.source.shape[1], batch.source
    K = max(answer.candidates.shape[1] for answer in answers)
    D = answers[0].log_cluster.shape[1]

    def stack(name: str) -> Tensor:
        return torch.from_numpy(np.stack([getattr(answer, name) for answer in answers]))

    def pad(name: str, value: float, *shape: int) -> Tensor:
        return _padded([getattr(answer, name) for answer in answers], (N, *shape), value)

    return Prediction(
        association=pad("association", -1),
        cluster=pad("cluster", -1),
        motions=stack("motions").to(like),
        active=stack("active"),
        candidates=pad("candidates", 0, K),
        log_association=_padded(
            [_with_states(answer.log_association, K + 1) for answer in answers], (N, K + 1), -math.log(K + 1)
        ).to(like),
        log_cluster=pad("log_cluster", -math.log(D), D).to(like),
        converged=stack("converged"),
        iterations=stack("iterations"),
        association_confidence=pad("association_confidence", 0.0).to(like),
        cluster_confidence=pad("cluster_confidence", 0.0).to(like),
        uncertainty=Uncertainty(*(stack(name).to(like) for name in ("covariance", "information", "directions"))),
    )


def _with_states(log_beliefs: Array, states: int) -> Array:
    """(N, S) beliefs with more states, all impossible, before the last one."""
    some = log_beliefs.shape[1] - 1
    if some == states - 1:
        return log_beliefs
    impossible = np.full((len(log_beliefs), states - 1 - some), -np.inf)
    return np.concatenate([log_beliefs[:, :some], impossible, log_beliefs[:, some:]], axis=1)


def _padded(parts: Sequence[NDArray], shape: tuple[int, ...], value: float | NDArray) -> Tensor:
    """(B, *shape): every part in a corner of its own, a value elsewhere."""
    together = np.empty((len(parts), *shape), parts[0].dtype)
    together[:] = value
    for row, part in zip(together, parts, strict=True):
        row[tuple(slice(length) for length in part.shape)] = part
    return torch.from_numpy(together)
