"""Every wrong point has one cause: each made by hand, and any answer adds up."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from made_causes import BIKE, CAR, GONE, MOTIONS, WALL, Street, labelled
from made_pairs import PREDICTORS, make_pair, motion_rows_missing

from torchcrf_scan import JointScanCRF, PairPrediction, ScanPair
from torchcrf_scan.data.dataset import PairFiles
from torchcrf_scan.evaluation.calibration import rightness
from torchcrf_scan.evaluation.causes.blame import CAUSES, KEPT, LABEL, LED_ASTRAY, PLACE, REJECTED, Blame, blame, wrong_points
from torchcrf_scan.evaluation.causes.movers import (
    A_LITTLE_OFF,
    ASTRAY,
    BACKGROUND_OFF,
    DROPPED,
    EDGE,
    FOUND,
    MISLABELLED,
    NO_HYPOTHESIS,
    OTHER,
    RIVALLED,
    SLIDING,
    UNLIKELY,
)
from torchcrf_scan.evaluation.causes.trace import SearchTrace
from torchcrf_scan.evaluation.metrics import score_pair


def blamed(street: Street, answer: PairPrediction | None = None, trace: SearchTrace | None = None) -> Blame:
    answer = street.answer if answer is None else answer
    return blame(street.pair, answer, street.trace if trace is None else trace, score_pair(street.pair, answer))


def counted(found: Blame) -> dict[str, int]:
    return {name: int(count) for name, count in zip(CAUSES, found.counts, strict=True) if count}


def fates(found: Blame) -> dict[int, str]:
    return {mover.cluster: mover.fate for mover in found.fates}


def empty(trace: SearchTrace) -> SearchTrace:
    nothing = np.zeros(0, bool)
    return replace(
        trace, motions=trace.motions[:0], members=trace.members[:0], likely=nothing, considered=np.zeros(0, np.int64), kept=nothing
    )


def test_nothing_is_wrong_with_the_truth(street: Street) -> None:
    found = blamed(street)
    assert counted(found) == {}
    assert (found.points, found.wrong) == (60, 0)
    assert fates(found) == {1: FOUND, 2: FOUND}


def test_a_background_that_slid(street: Street) -> None:
    answer = labelled(street.answer, np.arange(5, 36), association=4)
    slid = replace(answer, motions=MOTIONS + np.eye(3, 1) @ [[0.0, 0.0, 2.0]])
    assert counted(blamed(street, slid)) == {BACKGROUND_OFF: 31}
    assert counted(blamed(street, answer)) == {PLACE: 31}


@pytest.mark.parametrize(
    ("name", "change"),
    [
        (NO_HYPOTHESIS, None),
        (UNLIKELY, {"likely": np.array([False, True, True]), "considered": np.array([1]), "kept": np.ones(1, bool)}),
        (RIVALLED, {"considered": np.array([1]), "kept": np.ones(1, bool)}),
        (DROPPED, {"kept": np.array([False, True])}),
        (ASTRAY, {}),
    ],
)
def test_a_mover_lost_at_every_step_of_the_search(street: Street, name: str, change: dict | None) -> None:
    lost = labelled(street.answer, CAR, cluster=0)
    lost = replace(lost, motions=np.array([MOTIONS[0], [0.0, 9.0, 9.0], MOTIONS[2]]))
    trace = empty(street.trace) if change is None else replace(street.trace, **change)
    found = blamed(street, lost, trace)
    assert counted(found) == {f"mover: {name}": 8}
    assert fates(found) == {1: name, 2: FOUND}


def test_a_mover_lost_to_a_background_that_follows_it(street: Street) -> None:
    lost = labelled(street.answer, CAR, cluster=0)
    follows = replace(lost, motions=MOTIONS[[1, 1, 2]])
    found = blamed(street, follows, empty(street.trace))
    assert counted(found) == {BACKGROUND_OFF: 8}
    assert fates(found)[1] == BACKGROUND_OFF


def test_the_outliers_of_a_lost_mover_are_lost_with_it(street: Street) -> None:
    truth = street.pair.annotation
    assert truth is not None
    hidden = replace(
        truth,
        cluster=np.where(np.arange(60) == 41, -1, truth.cluster),
        association=np.where(np.arange(60) == 41, -1, truth.association),
    )
    pair = replace(street.pair, annotation=hidden)
    lost = labelled(street.answer, CAR, cluster=0)
    found = blamed(replace(street, pair=pair), lost, empty(street.trace))
    assert counted(found) == {f"mover: {NO_HYPOTHESIS}": 8}
    assert [mover.points for mover in found.fates if mover.cluster == 1] == [7]


@pytest.mark.parametrize(
    ("kind", "beams", "motion"),
    [
        (SLIDING, slice(10, 20), [0.0, 0.1, 1.0]),
        (EDGE, slice(36, 41), [0.0, 1.5, 0.0]),  # the car is next to the wall's end, and nearer
        (A_LITTLE_OFF, slice(10, 20), [0.0, 0.25, 0.0]),
        (OTHER, slice(10, 20), [0.0, 1.5, 0.0]),
    ],
)
def test_false_movers_of_every_kind(street: Street, kind: str, beams: slice, motion: list[float]) -> None:
    false = labelled(street.answer, beams, cluster=3)
    false = replace(false, motions=np.concatenate([MOTIONS, [motion]]))
    found = blamed(street, false)
    count = beams.stop - beams.start
    assert counted(found) == {f"false mover: {kind}": count}
    assert {name: number for name, number in found.false_movers.items() if number} == {kind: 1}


def test_a_static_point_in_a_true_mover_is_a_wrong_label(street: Street) -> None:
    assert counted(blamed(street, labelled(street.answer, slice(39, 41), cluster=1))) == {LABEL: 2}


def test_labels_wrong_although_the_motion_is_right(street: Street) -> None:
    found = blamed(street, labelled(street.answer, slice(42, 49), cluster=0))
    assert counted(found) == {LABEL: 7}
    assert fates(found) == {1: MISLABELLED, 2: FOUND}


def test_outlier_decisions_of_either_chain(street: Street) -> None:
    rejected = labelled(street.answer, slice(0, 3), cluster=-1)
    rejected.association[1:5] = -1
    assert counted(blamed(street, rejected)) == {REJECTED: 5}
    kept = labelled(street.answer, slice(56, 58), cluster=0)
    kept.association[57:60] = 7
    assert counted(blamed(street, kept)) == {KEPT: 4}


def test_two_beams_off_is_right_and_three_is_the_wrong_place(street: Street) -> None:
    assert counted(blamed(street, labelled(street.answer, slice(10, 20), association=2))) == {}
    assert counted(blamed(street, labelled(street.answer, slice(10, 20), association=3))) == {PLACE: 10}


def test_a_motion_a_little_off_leads_astray(street: Street) -> None:
    """The car's points are a quarter of a metre apart; 0.75 m is little if a unit is half a metre."""
    coarse = replace(street.trace, units=np.full(60, 0.5))
    answer = labelled(street.answer, slice(41, 46), association=3)
    off = replace(answer, motions=MOTIONS + np.eye(3, 1, -1) @ [[0.0, 0.0, 0.75]])
    assert counted(blamed(street, off, coarse)) == {LED_ASTRAY: 5}
    assert counted(blamed(street, answer, coarse)) == {PLACE: 5}


def test_many_causes_at_once_each_by_its_own_points(street: Street) -> None:
    answer = labelled(street.answer, BIKE, cluster=0)
    answer.cluster[GONE] = 0
    answer.association[0] = -1
    answer.association[10:14] += 5
    found = blamed(street, answer, replace(street.trace, kept=np.array([True, False])))
    assert counted(found) == {f"mover: {DROPPED}": 6, KEPT: 5, REJECTED: 1, PLACE: 4}
    assert found.wrong == 16


def test_unannotated_points_have_no_cause(street: Street) -> None:
    truth = street.pair.annotation
    assert truth is not None
    ignore = np.zeros(60, bool)
    ignore[WALL] = True
    pair = replace(street.pair, annotation=replace(truth, ignore=ignore))
    found = blamed(replace(street, pair=pair), labelled(street.answer, WALL, cluster=-1))
    assert (found.points, found.wrong) == (19, 0)


def any_trace(pair: ScanPair, rng: np.random.Generator, hypotheses: int) -> SearchTrace:
    considered = rng.permutation(hypotheses)[: rng.integers(0, hypotheses + 1)]
    return SearchTrace(
        rng.normal(0, 0.2, 3),
        rng.normal(0, 0.3, (hypotheses, 3)),
        rng.random((hypotheses, len(pair.source))) < 0.3,
        rng.random(hypotheses) < 0.5,
        considered,
        rng.random(len(considered)) < 0.5,
        rng.uniform(0.01, 0.3, len(pair.source)),
    )


@given(st.integers(0, 10**6), st.integers(3, 40), st.integers(0, 3), st.sampled_from(PREDICTORS), st.sampled_from([0.0, 0.3]))
def test_causes_add_up_whatever_the_answer(seed: int, n: int, movers: int, predictor, drop: float) -> None:
    rng = np.random.default_rng(seed)
    pair = make_pair(n, n + 3, movers, rng, drop)
    answer, trace = predictor(pair, rng), any_trace(pair, rng, int(rng.integers(0, 5)))
    found = blame(pair, answer, trace, score_pair(pair, answer))
    wrong = wrong_points(rightness(pair, answer))
    assert found.counts.sum() == found.wrong == wrong.sum()
    assert ((found.cause >= 0) == wrong).all()
    assert len({mover.cluster for mover in found.fates}) == len(found.fates)


@given(st.integers(0, 10**6))
def test_the_numbers_of_the_answered_movers_do_not_matter(seed: int) -> None:
    rng = np.random.default_rng(seed)
    pair = make_pair(40, 40, 3, rng)
    answer, trace = PREDICTORS[0](pair, rng), any_trace(pair, rng, 4)
    order = np.append(0, 1 + rng.permutation(len(answer.motions) - 1))
    other = replace(
        answer, cluster=np.where(answer.cluster < 0, -1, np.argsort(order)[answer.cluster]), motions=answer.motions[order]
    )
    first, second = (blame(pair, of, trace, score_pair(pair, of)) for of in (answer, other))
    assert (first.cause == second.cause).all()
    assert (first.fates, first.false_movers) == (second.fates, second.false_movers)


def test_motions_may_be_missing_from_the_answer() -> None:
    rng = np.random.default_rng(3)
    pair = make_pair(60, 60, 3, rng)
    answer = motion_rows_missing(pair, rng)
    found = blame(pair, answer, any_trace(pair, rng, 3), score_pair(pair, answer))
    assert found.counts.sum() == wrong_points(rightness(pair, answer)).sum() > 0


def test_real_pairs_add_up_and_count_the_movers_found(real_pairs_dir: Path) -> None:
    pairs = [PairFiles(real_pairs_dir)[k] for k in range(0, 99, 20)]
    for pair, (answer, trace) in zip(pairs, JointScanCRF.from_pretrained().trace_pairs(pairs), strict=True):
        score = score_pair(pair, answer)
        found = blame(pair, answer, trace, score)
        assert found.wrong == found.counts.sum() == wrong_points(rightness(pair, answer)).sum()
        assert [mover.fate == FOUND for mover in found.fates] == [thing.is_found for thing in score.objects if thing.is_counted]
