"""The rounds as one differentiable operation on a batch: forward by the loops, one pair per thread, and back the same way.

Gradients reach the weights and the extra log potentials. Those of points, motions of the start, embeddings or boosters need the
rounds in tensors (`torchcrf_scan.inference`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from torchcrf_scan.adjoint.rounds import Inputs, Slopes, no_inputs, no_slopes, pull_round
from torchcrf_scan.batch import ScanPairBatch
from torchcrf_scan.config import ModelConfig
from torchcrf_scan.fast.arrays import Fitted, Scene, Settings, State, fitted_of, settings_of
from torchcrf_scan.fast.decode import certain, first_state, merge_alike, scene_of
from torchcrf_scan.fast.pairs import Extra, extras_of, with_states
from torchcrf_scan.fast.rounds import Done, caches_of, do_round
from torchcrf_scan.features.learned import LearnedInputs
from torchcrf_scan.inference import joint, state
from torchcrf_scan.inference.motion import Motions
from torchcrf_scan.inference.start import Start
from torchcrf_scan.inference.state import Parameters, Round
from torchcrf_scan.loops.jit import Array, Integers
from torchcrf_scan.loops.pair import Pair, PairStart, array_of, padded, pair_of
from torchcrf_scan.loops.threads import for_each
from torchcrf_scan.prediction import Prediction
from torchcrf_scan.search.pairs import start_arrays


class Answer(NamedTuple):
    """A state after a round with clusters of equal motion merged.

    Attributes:
        state: the result. unmerged: (N, D) its beliefs over clusters before. joined: (J, 2) of `merge_alike`.
    """

    state: State
    unmerged: Array
    joined: Integers


@dataclass(frozen=True, slots=True)
class PairRounds:
    """All rounds of one pair.

    Attributes:
        scene: the pair; None: a scan is empty, and there are no rounds. factor: units in a metre.
        rounds: in order. answers: of the last ones.
    """

    scene: Scene | None
    factor: float
    rounds: list[Done]
    answers: list[Answer]
    converged: bool


@dataclass(frozen=True, slots=True)
class Unrolled:
    """The last rounds of a batch.

    Attributes:
        batch: in the unit of the features, as are the states. factor: (B,) units in a metre.
        rounds: the last ones, with clusters of equal motion merged.
    """

    batch: ScanPairBatch
    factor: Tensor
    rounds: list[Round]


def do_rounds(pair: Pair, start: PairStart, extra: Extra, fitted: Fitted, settings: Settings, last: int) -> PairRounds:
    """All rounds of one pair from its start. last: number of rounds whose states are wanted."""
    if pair.fewest_points == 0:
        return nothing_done(pair, start, last)
    is_chosen = not settings.is_joint or len(start.log_odds) == 0
    scene = scene_of(pair, start, *extra, settings)
    now = first_state(scene, start, is_chosen)
    caches = caches_of(scene, len(now.motions), settings.candidates)
    older, rounds, converged = now, list[Done](), False
    for done in range(settings.iterations):
        found = do_round(scene, now, older, done, is_chosen, start.log_odds, caches, fitted, settings)
        rounds.append(found)
        older, now, converged = now, found.after, converged or bool(found.is_settled)
        if settings.stop_early and converged:
            break
    answers = [merged(scene, found.after, fitted) for found in rounds[-last:]]
    return PairRounds(scene, scene.factor, rounds, answers, converged)


def nothing_done(pair: Pair, start: PairStart, last: int) -> PairRounds:
    """The result if a scan is empty: outliers, and the motions of the start."""
    N, C = len(pair.source), len(start.motions)
    outliers = np.full(N, -1)
    beliefs = certain(np.full(N, 1), 2), certain(np.full(N, C), C + 1)
    only = np.arange(C) == 0
    found = State(start.motions, only, np.zeros(C, np.int64), outliers, outliers, np.zeros((N, 1), np.int64), *beliefs)
    answer = Answer(found, beliefs[1], np.empty((0, 2), np.int64))
    return PairRounds(None, 1.0, [], [answer] * last, converged=True)


def merged(scene: Scene, after: State, fitted: Fitted) -> Answer:
    """A state with clusters of equal motion merged; the state given is not changed."""
    copied = after._replace(active=after.active.copy(), cluster=after.cluster.copy(), log_cluster=after.log_cluster.copy())
    joined = merge_alike(scene.source, copied, fitted.clustering.cluster_distance)
    return Answer(copied, after.log_cluster, joined)


def pull_joined(answer: Answer, slopes: Array) -> Array:
    """(N, D) slopes of the beliefs before clusters were merged from those after."""
    befores = [answer.unmerged]
    for low, high in answer.joined:
        after = befores[-1].copy()
        after[:, low], after[:, high] = np.logaddexp(after[:, low], after[:, high]), -np.inf
        befores.append(after)
    pulled = slopes.copy()
    for (low, high), before, after in zip(answer.joined[::-1], befores[-2::-1], befores[:0:-1], strict=True):
        of_both, total = pulled[:, low].copy(), np.where(np.isneginf(after[:, low]), 0.0, after[:, low])
        for c in (low, high):
            pulled[:, c] = of_both * np.exp(before[:, c] - total)
    return pulled


def pull_pair(done: PairRounds, slopes: list[Slopes], fitted: Fitted, settings: Settings) -> Inputs:
    """Slopes of the inputs of one pair. slopes: of the beliefs and motions of the answers, in order."""
    assert done.scene is not None
    inputs = no_inputs(len(done.scene.source))
    last = done.rounds[-1].after
    work, back = caches_of(done.scene, len(last.motions), settings.candidates).work, no_slopes(last)
    given = dict(zip(range(len(done.rounds) - 1, -1, -1), zip(slopes[::-1], done.answers[::-1], strict=True), strict=False))
    for number in range(len(done.rounds) - 1, -1, -1):
        if number in given:
            of, answer = given[number]
            back = Slopes(
                back.motions + of.motions,
                back.log_association + of.log_association,
                back.log_cluster + pull_joined(answer, of.log_cluster),
            )
        elif not settings.is_soft:
            break  # labels have no slope
        back = pull_round(done.scene, done.rounds[number], back, inputs, work, fitted, settings)
    return inputs


class _Rounds(torch.autograd.Function):
    """The beliefs and motions of the last rounds as functions of the weights and of the learned log potentials."""

    @staticmethod
    def forward(
        ctx: Any,
        association: Tensor,
        clustering: Tensor,
        outlier: Tensor | None,
        moving: Tensor | None,
        done: list[PairRounds],
        fitted: Fitted,
        settings: Settings,
        like: Tensor,
    ) -> tuple[Tensor, ...]:
        ctx.done, ctx.fitted, ctx.settings = done, fitted, settings
        ctx.inputs = [None if of is None else of.detach() for of in (association, clustering, outlier, moving)]
        found: list[Tensor] = []
        for states in zip(*([answer.state for answer in pair.answers] for pair in done), strict=True):
            K, D, N = max(of.candidates.shape[1] for of in states), states[0].log_cluster.shape[1], like.shape[1]
            found.append(torch.from_numpy(np.stack([of.motions for of in states])).to(like))
            wide = [with_states(of.log_association, K + 1) for of in states]
            found.append(padded(wide, (N, K + 1), -math.log(K + 1)).to(like))
            found.append(padded([of.log_cluster for of in states], (N, D), -math.log(D)).to(like))
        if not settings.is_soft:
            ctx.mark_non_differentiable(*found[::3])  # motions of labels
        return tuple(found)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *slopes: Tensor) -> tuple[Tensor | None, ...]:
        given = [array_of(of) for of in slopes]

        def pull(b: int) -> Inputs | None:
            done: PairRounds = ctx.done[b]
            if done.scene is None:
                return None
            n, k = done.rounds[-1].after.candidates.shape
            some = [*range(k), -1]
            of_pair = [
                Slopes(motions[b], np.ascontiguousarray(one[b, :n][:, some]), np.ascontiguousarray(other[b, :n]))
                for motions, one, other in zip(given[::3], given[1::3], given[2::3], strict=True)
            ]
            return pull_pair(done, of_pair, ctx.fitted, ctx.settings)

        found = for_each(pull, range(len(ctx.done)))
        association, clustering, outlier, moving = ctx.inputs
        some = [of for of in found if of is not None]
        sums = [
            sum((getattr(of, name) for of in some), np.zeros(len(like)))
            for name, like in (("association", association), ("clustering", clustering))
        ]

        def by_point(name: str, like: Tensor | None) -> Tensor | None:
            if like is None:
                return None
            parts = [np.zeros(0) if of is None else getattr(of, name) for of in found]
            return padded(parts, (like.shape[1],), 0.0).to(like)

        weights = (torch.from_numpy(total).to(like) for total, like in zip(sums, (association, clustering), strict=True))
        return (*weights, by_point("outlier", outlier), by_point("moving", moving), None, None, None, None)


def unroll(
    batch: ScanPairBatch,
    start: Start,
    parameters: Parameters,
    model: ModelConfig,
    learned: LearnedInputs | None = None,
    last: int = 1,
) -> Unrolled:
    """The last rounds of a batch, differentiable in the weights and in the learned log potentials.

    Args:
        start: metres. learned: without embeddings. last: number of rounds wanted, at most `iterations`.
    """
    fitted, settings = fitted_of(parameters), settings_of(model)
    pairs = [pair_of(batch, b) for b in range(len(batch))]
    starts = [start_arrays(start, b, pair) for b, pair in enumerate(pairs)]
    extras = extras_of([len(pair.source) for pair in pairs], learned)
    done = for_each(lambda b: do_rounds(pairs[b], starts[b], extras[b], fitted, settings, last), range(len(pairs)))
    outlier, moving = (None, None) if learned is None else (learned.outlier, learned.moving)
    weights = parameters.association, parameters.clustering
    beliefs = _Rounds.apply(*weights, outlier, moving, done, fitted, settings, batch.source)
    factor = torch.tensor([of.factor for of in done], dtype=torch.float64).to(batch.source)
    rounds = [round_of(done, age, beliefs[3 * age : 3 * age + 3]) for age in range(last)]
    return Unrolled(batch.scaled(factor), factor, rounds)


def round_of(done: list[PairRounds], age: int, beliefs: tuple[Tensor, ...]) -> Round:
    """The states of a batch after one of the last rounds. beliefs: its motions and log-beliefs of both chains."""
    states = [pair.answers[age].state for pair in done]
    motions, log_association, log_cluster = beliefs
    N, K = log_association.shape[1], log_association.shape[2] - 1

    def labels(name: str, *more: int, value: float = -1) -> Tensor:
        return padded([getattr(of, name) for of in states], (N, *more), value)

    real = [np.full(of.candidates.shape, pair.scene is not None) for of, pair in zip(states, done, strict=True)]
    active, empty_for = (torch.from_numpy(np.stack([getattr(of, name) for of in states])) for name in ("active", "empty_for"))
    return Round(
        state.State(
            motions=Motions(motions, active, empty_for),
            association=labels("association"),
            cluster=labels("cluster"),
            candidates=labels("candidates", K, value=0),
            candidate_mask=padded(real, (N, K), False),
            log_association=log_association,
            log_cluster=log_cluster,
        ),
        converged=torch.tensor([pair.converged for pair in done]),
        iterations=torch.tensor([len(pair.rounds) for pair in done]),
    )


def predict(
    batch: ScanPairBatch, start: Start, parameters: Parameters, model: ModelConfig, learned: LearnedInputs | None
) -> Prediction:
    """`JointScanCRF.forward` from a start, differentiable as `unroll` is."""
    found = unroll(batch, start, parameters, model, learned)
    last = found.rounds[0]
    answer = joint.read_out(found.batch, start, last.state, parameters, model.inference, last.converged, last.iterations)
    return answer.scaled(1 / found.factor)
