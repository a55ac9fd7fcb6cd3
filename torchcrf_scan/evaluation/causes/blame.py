"""One cause for every wrong point of a pair, and one fate for every mover.

A point is wrong if its association is more than two target beams off, or its cluster is wrong (`calibration.rightness`). The
first of these questions that is answered with yes gives the cause; true labels decide what a point is.

1. A static point: is the background's answered motion off there?
2. A mover's point, inlier or not: is the mover's motion not in the answer? Then the step that lost it (`movers.STATES`).
3. Is the point of an answered mover that is none? Then its kind (`movers.FALSE_KINDS`).
4. An inlier in another inlier cluster: the label is wrong although the motions are right.
5. An inlier called outlier by either chain, or an outlier kept by either.
6. What is left are associations to the wrong place of the right body: the nearest target point is right under the true motion and
   wrong under the answered one, or it is something else.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from torchcrf_scan.evaluation.calibration import Rightness, rightness
from torchcrf_scan.evaluation.causes.movers import (
    BACKGROUND_OFF,
    FALSE_KINDS,
    FOUND,
    MISLABELLED,
    RIGHT,
    STATES,
    TOLERANCE,
    TrueMover,
    gap,
    kind_of_false_mover,
    state_of,
)
from torchcrf_scan.evaluation.causes.outliers import nearest_targets
from torchcrf_scan.evaluation.causes.trace import SearchTrace
from torchcrf_scan.evaluation.counterparts import annotation_of, beams_apart
from torchcrf_scan.evaluation.metrics import PairScore
from torchcrf_scan.scan import BACKGROUND, OUTLIER, Annotation, Bools, Ints, PairPrediction, ScanPair

LABEL, REJECTED, KEPT = "label wrong, motions right", "inlier called outlier", "outlier kept"
LED_ASTRAY, PLACE = "wrong place of the right body: motion a little off", "wrong place of the right body: other"
NEAR = 2  # target beams up to which an association is right
CAUSES = (
    BACKGROUND_OFF,
    *(f"mover: {state}" for state in STATES if state not in (RIGHT, BACKGROUND_OFF)),
    *(f"false mover: {kind}" for kind in FALSE_KINDS),
    LABEL,
    REJECTED,
    KEPT,
    LED_ASTRAY,
    PLACE,
)


@dataclass(frozen=True, slots=True)
class MoverFate:
    """A true mover large enough to be asked for (`metrics.MOVER_MIN_POINTS`), and one of `movers.FATES`."""

    cluster: int
    points: int
    fate: str


@dataclass(frozen=True, slots=True)
class Blame:
    """The causes of one pair.

    Attributes:
        points: annotated source points.
        cause: (N,) index into `CAUSES` of every source point, -1 for those that are right or not annotated.
        fates: of the movers. false_movers: number of answered movers that are none, by kind.
        name, sequence: of the pair.
    """

    points: int
    cause: Ints
    fates: tuple[MoverFate, ...]
    false_movers: dict[str, int]
    name: str = ""
    sequence: str = ""

    @property
    def counts(self) -> Ints:
        """(len(CAUSES),) wrong points of every cause."""
        return np.bincount(self.cause[self.cause >= 0], minlength=len(CAUSES))

    @property
    def wrong(self) -> int:
        """Wrong points."""
        return int((self.cause >= 0).sum())


def wrong_points(right: Rightness) -> Bools:
    """(N,) the annotated points whose association or cluster is wrong."""
    return right.known & ~(right.within & right.cluster)


def blame(pair: ScanPair, prediction: PairPrediction, trace: SearchTrace, score: PairScore) -> Blame:
    """The causes of a pair's wrong points and the fates of its movers.

    Args:
        prediction: the answer of the search that `trace` tells of. score: of this answer (`metrics.score_pair`).

    Raises:
        TorchCRFScanError: a pair without annotation.
    """
    right, truth, beam = rightness(pair, prediction, NEAR), annotation_of(pair), pair.source.beam
    cluster = prediction.cluster[beam]
    body, movers = _movers_of(pair, truth, trace)
    states = {number: state_of(mover, truth, cluster, prediction.motions, trace) for number, mover in movers.items()}
    kinds = _false_movers(pair, prediction, body, right.known, trace)
    cause, left = np.full(len(pair.source), -1), wrong_points(right)

    def put(name: str, where: Bools) -> None:
        taken = left & where
        cause[taken] = CAUSES.index(name)
        left[taken] = False

    is_off = gap(pair.source.points, prediction.motions[BACKGROUND], truth.motions[BACKGROUND]) > TOLERANCE * trace.units
    put(BACKGROUND_OFF, is_off & (body <= BACKGROUND))
    for number, state in states.items():
        if state != RIGHT:
            put(state if state == BACKGROUND_OFF else f"mover: {state}", body == number)
    for number, kind in kinds.items():
        put(f"false mover: {kind}", (cluster == number) & (body <= BACKGROUND))
    is_outlier, is_called = truth.cluster[beam] == OUTLIER, (cluster == OUTLIER) | (prediction.association[beam] < 0)
    put(LABEL, ~is_outlier & (cluster != OUTLIER) & ~right.cluster)
    put(REJECTED, ~is_outlier & is_called)
    put(KEPT, is_outlier)
    put(LED_ASTRAY, _is_led_astray(pair, prediction, body))
    put(PLACE, left.copy())
    number_of_kind = {kind: list(kinds.values()).count(kind) for kind in FALSE_KINDS}
    return Blame(int(right.known.sum()), cause, _fates(states, score), number_of_kind, pair.name, pair.sequence)


def _is_led_astray(pair: ScanPair, prediction: PairPrediction, body: Ints) -> Bools:
    """(N,) whether a point's nearest target is right, within `NEAR` beams, under its body's true motion, not under the answered."""
    truth, beam = annotation_of(pair), pair.source.beam
    _, by_truth = nearest_targets(pair, truth.motions, body)
    _, by_answer = nearest_targets(pair, prediction.motions, prediction.cluster[beam])
    off, found_off = (beams_apart(pair.target, truth.association[beam], nearest) for nearest in (by_truth, by_answer))
    return (off <= NEAR) & (found_off > NEAR)


def _movers_of(pair: ScanPair, truth: Annotation, trace: SearchTrace) -> tuple[Ints, dict[int, TrueMover]]:
    """(N,) body of every source point, -1 unknown or not annotated; and the movers among them by number."""
    beam = pair.source.beam
    body = np.where(truth.cluster[beam] != OUTLIER, truth.cluster[beam], truth.body[beam])
    body = np.where(truth.ignore[beam], OUTLIER, body)
    numbers = [k for k in np.unique(body).tolist() if BACKGROUND < k < len(truth.motions)]
    return body, {number: TrueMover.of(number, pair, truth, trace.units) for number in numbers}


def _false_movers(pair: ScanPair, prediction: PairPrediction, body: Ints, known: Bools, trace: SearchTrace) -> dict[int, str]:
    """Kinds of the answered movers most of whose annotated points are no mover's, by number."""
    cluster = prediction.cluster[pair.source.beam]
    found = {}
    for number in np.unique(cluster[cluster > BACKGROUND]).tolist():
        own = cluster == number
        annotated = own & known
        if annotated.any() and 2 * (body[annotated] > BACKGROUND).sum() < annotated.sum():
            found[number] = kind_of_false_mover(pair, prediction, own, number, trace.units)
    return found


def _fates(states: dict[int, str], score: PairScore) -> tuple[MoverFate, ...]:
    """Found (an IoU of 0.5), or the state of its motion, or labels alone."""
    fates = []
    for thing in score.objects:
        if thing.is_counted:
            state = states.get(thing.cluster, RIGHT)
            fate = FOUND if thing.is_found else MISLABELLED if state == RIGHT else state
            fates.append(MoverFate(thing.cluster, thing.points, fate))
    return tuple(fates)
