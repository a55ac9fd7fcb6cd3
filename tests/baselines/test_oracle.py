"""Oracles: with a part of the truth in hand the answer keeps that part."""

from dataclasses import replace

import numpy as np
import pytest

from torchcrf_scan import JointScanCRF, ScanPair
from torchcrf_scan.baselines.oracle import ORACLES, match_all, with_right_hypotheses, with_true_background, with_true_motions
from torchcrf_scan.data.simulate import simulate_pairs
from torchcrf_scan.data.worlds import SimulatorConfig
from torchcrf_scan.evaluation.causes.trace import SearchTrace
from torchcrf_scan.evaluation.counterparts import annotation_of
from torchcrf_scan.scan import Annotation, Scan

Traced = list[tuple[ScanPair, SearchTrace]]


@pytest.fixture(scope="module")
def model() -> JointScanCRF:
    return JointScanCRF.from_pretrained()


@pytest.fixture(scope="module")
def traced(model: JointScanCRF) -> Traced:
    pairs = simulate_pairs(SimulatorConfig(beams=181, movers_min=2), 4, 4, 8)
    return [(pair, trace) for pair, (_, trace) in zip(pairs, model.trace_pairs(pairs), strict=True)]


def test_true_motions_stay_as_they_are(model: JointScanCRF, traced: Traced) -> None:
    metric = model.config.inference.motion_metric
    for pair, trace in traced:
        answer, truth = with_true_motions(model, pair, trace), annotation_of(pair)
        assert answer.motions[0] == pytest.approx(truth.motions[0], abs=1e-6)
        for motion in answer.motions[1:]:
            assert np.abs(truth.motions - motion).max(1).min() < 1e-5
    assert model.config.inference.motion_metric == metric != "given"


def test_right_hypotheses_alone_become_movers(model: JointScanCRF, traced: Traced) -> None:
    none = [with_right_hypotheses(model, pair, replace(trace, motions=trace.motions + 50.0)) for pair, trace in traced]
    assert all(len(answer.motions) == 1 for answer in none)  # no hypothesis is right: the background alone
    assert sum(len(with_right_hypotheses(model, *of).motions) - 1 for of in traced) >= 2


def test_a_search_that_begins_at_its_own_background_gives_its_own_answer(model: JointScanCRF, traced: Traced) -> None:
    for pair, trace in traced:
        truth = annotation_of(pair)
        found = replace(truth, motions=np.concatenate([trace.background[None], truth.motions[1:]]))
        answer = with_true_background(model, replace(pair, annotation=found))
        assert (answer.cluster == model.match_pairs([pair])[0].cluster).all()


def test_an_unknown_background_is_searched_for(model: JointScanCRF, traced: Traced) -> None:
    pair = traced[0][0]
    motions = np.concatenate([np.full((1, 3), np.nan), annotation_of(pair).motions[1:]])
    unknown = replace(pair, annotation=replace(annotation_of(pair), motions=motions))
    assert (with_true_background(model, unknown).cluster == model.match_pairs([pair])[0].cluster).all()
    assert np.isfinite(with_true_motions(model, unknown, traced[0][1]).motions).all()


def test_empty_scans(model: JointScanCRF) -> None:
    empty, few = Scan.from_ranges([], []), Scan.from_ranges([2.0, 2.1], [0.0, 0.1])
    for source, target in ((empty, few), (few, empty), (few, few)):
        n = len(source)
        nothing = np.full(n, -1)
        truth = Annotation(nothing, nothing, np.zeros((1, 3)), nothing, np.zeros(n, bool))
        pair = ScanPair(source, target, annotation=truth)
        found = match_all(model, [pair], [model.trace_pairs([pair])[0][1]])
        assert found.keys() == ORACLES.keys()
        assert all(len(answers[0].cluster) == n for answers in found.values())


def test_pairs_without_annotation_are_refused(model: JointScanCRF, traced: Traced) -> None:
    pair, trace = replace(traced[0][0], annotation=None), traced[0][1]
    for oracle in ORACLES.values():
        with pytest.raises(ValueError, match="expected an annotation"):
            oracle(model, pair, trace)
