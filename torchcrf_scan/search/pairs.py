"""InitialiseRT of whole pairs (Algorithm 1, line 1): the start of the rounds, on which the result depends strongly.

    surfaces -> background (refined guess, else a search) -> unexplained points -> hypothesised movers -> the start

Every pair is processed by one thread; for a single pair, the threads share the hypotheses of its background. No gradient
passes through the start.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TypeVar

import numpy as np
import torch

from torchcrf_scan.batch import ScanPairBatch
from torchcrf_scan.inference.start import FARTHEST, Start
from torchcrf_scan.loops.jit import Array
from torchcrf_scan.loops.pair import Pair, PairStart, array_of, padded, pair_of
from torchcrf_scan.loops.shape import resolution
from torchcrf_scan.loops.threads import for_each, in_parts
from torchcrf_scan.search.accept import Score
from torchcrf_scan.search.background import follow
from torchcrf_scan.search.choose import FEWEST_POINTS, choose_movers
from torchcrf_scan.search.expected import Expected
from torchcrf_scan.search.grid import ScanGrid
from torchcrf_scan.search.pool import Share, alone, find_background
from torchcrf_scan.search.survey import Survey, grids_of, survey_at, without_standing
from torchcrf_scan.search.trusted import choose_background
from torchcrf_scan.search.unobserved import less_turned, settle

T = TypeVar("T")


def initialise(batch: ScanPairBatch, score: Score, clusters: int) -> Start:
    """Background and up to `clusters` - 1 movers of every pair; `batch.initial_motion` is one more guess, never taken unchecked."""
    return start_tensors(start_pairs([pair_of(batch, b) for b in range(len(batch))], score, clusters), batch)


def start_pairs(
    pairs: Sequence[Pair],
    score: Score,
    clusters: int,
    expected: Expected | None = None,
    record: list[Survey | None] | None = None,
) -> list[PairStart]:
    """The same for pairs as arrays, each by itself.

    expected: of a single pair, movers known from before. record: gets every pair's survey, in order, as `survey_pair` gives it.
    """
    assert expected is None or len(pairs) == 1
    if record is None:
        return of_pairs(lambda pair, share: start_pair(pair, score, clusters, share, expected), pairs)
    record += of_pairs(lambda pair, share: survey_pair(pair, share, expected), pairs)
    return [start_from(pair, seen, score, clusters) for pair, seen in zip(pairs, record[-len(pairs) :], strict=True)]


def survey(batch: ScanPairBatch) -> list[Survey | None]:
    """`survey_pair` of every pair of a batch: all of the start that does not depend on the score of movers."""
    return of_pairs(survey_pair, [pair_of(batch, b) for b in range(len(batch))])


def choose(batch: ScanPairBatch, surveys: Sequence[Survey | None], score: Score, clusters: int) -> Start:
    """The start from the surveys: the background and up to `clusters` - 1 movers accepted by the score."""
    pairs = [pair_of(batch, b) for b in range(len(batch))]
    starts = [start_from(pair, seen, score, clusters) for pair, seen in zip(pairs, surveys, strict=True)]
    return start_tensors(starts, batch)


def survey_pair(pair: Pair, share: Share = alone, expected: Expected | None = None) -> Survey | None:
    """Surfaces, background and hypotheses of what cannot stand; None if a scan has fewer than three points.

    share: see `background_pool`.
    """
    if pair.fewest_points < FEWEST_POINTS:
        return None
    return without_standing(survey_at(*find_start(pair, share), pair.dt, expected))


def find_start(pair: Pair, share: Share) -> tuple[ScanGrid, ScanGrid, Array]:
    """Both scans and the background's motion (3,): the refined initial motion, or the result of a search, checked."""
    source, target = grids_of(pair)
    is_led, background = follow(pair.initial_motion, source, target) if pair.initial_motion.any() else (False, pair.initial_motion)
    found = background if is_led else find_background(source, target, pair.initial_motion, share)
    found = less_turned(source, target, found, pair.initial_motion)
    backed = choose_background(found, pair.initial_motion, source, target)
    return settle(source, target, backed.motion, backed.explained, pair.initial_motion)


def start_pair(pair: Pair, score: Score, clusters: int, share: Share = alone, expected: Expected | None = None) -> PairStart:
    """InitialiseRT of one pair. clusters: C."""
    return start_from(pair, survey_pair(pair, share, expected), score, clusters)


def start_from(pair: Pair, seen: Survey | None, score: Score, clusters: int) -> PairStart:
    """The start of one pair from its survey. clusters: C."""
    if pair.fewest_points == 0:
        return nothing_found(pair, clusters)
    if seen is None:
        seen = survey_at(*grids_of(pair), pair.initial_motion, pair.dt)
    unit = resolution(pair.source, pair.target, pair.noise)
    return choose_movers(*seen, pair.initial_motion, score, clusters, unit)


def nothing_found(pair: Pair, clusters: int) -> PairStart:
    """The start if a scan is empty: the initial motion, no movers, no associations."""
    N, M = len(pair.source), len(pair.target)
    is_background = np.arange(clusters) == 0
    return PairStart(
        np.tile(pair.initial_motion, (clusters, 1)),
        is_background,
        np.full(N, -1, np.int64),
        np.zeros((M, 2)),
        np.tile(np.where(is_background, 0.0, FARTHEST), (N, 1)),
        np.where(is_background, np.inf, -np.inf),
    )


def start_tensors(starts: Sequence[PairStart], batch: ScanPairBatch) -> Start:
    """The starts of all pairs of a batch, padded as the batch is."""
    N, M, clusters = batch.source.shape[1], batch.target.shape[1], len(starts[0].active)
    like = batch.source
    beyond = np.broadcast_to(np.where(np.arange(clusters) == 0, 0.0, FARTHEST), (N, clusters))  # padding is background
    return Start(
        motions=torch.from_numpy(np.stack([start.motions for start in starts])).to(like),
        active=torch.from_numpy(np.stack([start.active for start in starts])).to(like.device),
        association=padded([start.association for start in starts], (N,), -1).to(like.device),
        target_tangents=padded([start.target_tangents for start in starts], (M, 2), 0.0).to(like),
        reach=padded([start.reach for start in starts], (N, clusters), beyond).to(like),
        log_odds=torch.from_numpy(np.stack([start.log_odds for start in starts])).to(like),
    )


def start_arrays(start: Start, b: int, pair: Pair) -> PairStart:
    """The start of pair b without the padding."""
    n, m, C = len(pair.source), len(pair.target), start.motions.shape[1]
    reach = np.zeros((n, C)) if start.reach is None else array_of(start.reach[b, :n])
    return PairStart(
        array_of(start.motions[b]),
        start.active[b].cpu().numpy().copy(),
        start.association[b, :n].cpu().numpy().copy(),
        array_of(start.target_tangents[b, :m]),
        reach,
        np.empty(0) if start.log_odds is None else array_of(start.log_odds[b]),
    )


def of_pairs(function: Callable[[Pair, Share], T], pairs: Sequence[Pair]) -> list[T]:
    """function(pair, share) of every pair."""
    if len(pairs) == 1:
        return [function(pairs[0], in_parts)]
    return for_each(lambda pair: function(pair, alone), pairs)
