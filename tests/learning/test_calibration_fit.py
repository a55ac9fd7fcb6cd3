"""Slopes, offsets and factors that are known come back; a model's own answers are judged as the metrics judge them."""

import copy
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.special import expit

from torchcrf_scan.batch import ScanPairBatch
from torchcrf_scan.evaluation.calibration import consistency, expected_calibration_error
from torchcrf_scan.evaluation.metrics import score_pair
from torchcrf_scan.experiment.models import JOINT, Models
from torchcrf_scan.experiment.study import Study
from torchcrf_scan.inference.uncertainty import Calibration
from torchcrf_scan.learning import calibration_fit
from torchcrf_scan.learning.calibration_fit import (
    Judged,
    calibrate,
    fit_calibration,
    fit_confidence,
    fit_covariance_factor,
    judge,
    moving_share,
)
from torchcrf_scan.learning.settings import Config
from torchcrf_scan.model import MatchingCRF
from torchcrf_scan.prediction import Prediction
from torchcrf_scan.scan import ScanPair


def test_fit_confidence_finds_slope_and_offset() -> None:
    rng = np.random.default_rng(0)
    log_odds = rng.normal(3, 4, 40_000)
    is_right = rng.random(len(log_odds)) < expit(0.4 * log_odds - 0.7)
    slope, offset = fit_confidence(log_odds, is_right)
    assert slope == pytest.approx(0.4, abs=0.02)
    assert offset == pytest.approx(-0.7, abs=0.05)
    assert expected_calibration_error(expit(slope * log_odds + offset), is_right) < 0.01


def test_fit_confidence_never_turns_round() -> None:
    """Even where the surer answers are the worse ones, a larger belief is no smaller a confidence."""
    log_odds = np.linspace(-3, 3, 200)
    slope, offset = fit_confidence(log_odds, log_odds < 0)
    assert slope == pytest.approx(0, abs=1e-6)
    assert expit(offset) == pytest.approx(0.5, abs=0.01)


@pytest.mark.parametrize("is_right", [True, False])
def test_fit_confidence_of_answers_that_are_all_alike(is_right: bool) -> None:
    slope, offset = fit_confidence(np.linspace(0, 5, 20), np.full(20, is_right))
    assert np.isfinite([slope, offset]).all()
    assert (expit(2.5 * slope + offset) > 0.5) == is_right


def test_fit_confidence_of_nothing() -> None:
    with pytest.raises(ValueError, match=r"^log_odds: expected"):
        fit_confidence([], [])


@pytest.mark.parametrize("quantile", [0.5, 0.9])
def test_fit_covariance_factor(quantile: float) -> None:
    """Found again although one pair in twenty is wrong altogether."""
    rng = np.random.default_rng(1)
    nees = 2.5 * rng.chisquare(3, 3000)
    assert fit_covariance_factor(nees, quantile) == pytest.approx(2.5, rel=0.08)
    nees[:30] = 1e6
    factor = fit_covariance_factor(nees, quantile)
    assert factor == pytest.approx(2.5, rel=0.12)
    assert consistency(nees[30:] / factor).within == pytest.approx(0.95, abs=0.02)
    with pytest.raises(ValueError, match=r"^nees: expected"):
        fit_covariance_factor([])


@pytest.fixture(scope="module")
def judged(models: Models, small_pairs: list[ScanPair]) -> tuple[list[ScanPair], Prediction, Judged]:
    """What a model says of three pairs."""
    pairs = small_pairs[:3]
    with torch.no_grad():
        prediction = models.joint[JOINT](ScanPairBatch.collate(pairs).without_truth())
    return pairs, prediction, judge(pairs, prediction)


def test_answers_are_judged_as_the_metrics_judge_them(judged: tuple[list[ScanPair], Prediction, Judged]) -> None:
    pairs, prediction, found = judged
    scores = [score_pair(pair, prediction.pair(b, pair)) for b, pair in enumerate(pairs)]
    assert found.association_right.sum() == sum(score.within_2 for score in scores)
    assert found.cluster_right.sum() == sum(score.cluster.right for score in scores)
    assert found.nees.tolist() == [score.sureness.nees for score in scores]


def test_judge_and_fit(judged: tuple[list[ScanPair], Prediction, Judged]) -> None:
    _, prediction, found = judged
    calibration = fit_calibration(Judged.joined([found] * 4))
    assert calibration.covariance_factor == pytest.approx(fit_covariance_factor(np.tile(found.nees, 4)))
    for confidence in calibration(prediction):
        assert confidence.shape == prediction.association.shape
        assert ((confidence >= 0) & (confidence <= 1)).all()


def test_what_there_are_too_few_answers_for_keeps_its_default(judged: tuple[list[ScanPair], Prediction, Judged]) -> None:
    found = judged[-1]
    few = fit_calibration(found)
    assert few.covariance_factor == 1
    assert not torch.equal(few.association, Calibration().association)
    none = Judged.nothing()
    assert all(torch.equal(value, Calibration().state_dict()[name]) for name, value in fit_calibration(none).state_dict().items())


def test_a_model_is_calibrated_on_the_pairs_it_was_fitted_on(
    study: Study, models: Models, small_config: Config, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Whatever the calibration was before, and on the scans as they were before they were disturbed."""
    model = copy.deepcopy(models.joint[JOINT])
    material = 2 * study.collection.material(range(6), model.hypothesis_score, 4, small_config.learning)
    monkeypatch.setattr(calibration_fit, "DOMINATED", 1.0)
    model.calibration.covariance_factor.fill_(7.0)
    model.calibration.association.fill_(-3.0)
    calibrate(model, material)
    plain = copy.deepcopy(models.joint[JOINT])
    plain.calibration = Calibration()
    found = {"disturbed": [], "undisturbed": []}
    for part in material:
        for kind, batch in (("disturbed", part.batch), ("undisturbed", ScanPairBatch.collate(part.pairs))):
            with torch.no_grad():
                found[kind].append(judge(part.pairs, plain(batch.without_truth(), part.start)))
    disturbed, undisturbed = (fit_calibration(Judged.joined(of_kind)) for of_kind in found.values())
    for name, value in model.calibration.state_dict().items():
        assert torch.equal(value, undisturbed.state_dict()[name]), name
    assert len({1.0, float(disturbed.covariance_factor), float(undisturbed.covariance_factor)}) == 3
    assert not torch.equal(disturbed.association, undisturbed.association)


def test_calibration_changes_no_answer(study: Study, models: Models, small_pairs: list[ScanPair]) -> None:
    model = copy.deepcopy(models.joint[JOINT])
    found = model.match_pairs(small_pairs[4:])
    model.calibration = Calibration()
    for one, other in zip(found, model.match_pairs(small_pairs[4:]), strict=True):
        assert np.array_equal(one.association, other.association)
        assert np.array_equal(one.cluster, other.cluster)
        assert np.array_equal(one.motions, other.motions)
        assert not np.array_equal(one.association_confidence, other.association_confidence)


def test_a_model_of_one_chain_keeps_the_default(study: Study, models: Models, small_config: Config) -> None:
    model = MatchingCRF(small_config.model)
    model.calibration.covariance_factor.fill_(7.0)
    calibrate(model, study.collection.material(range(2), models.joint[JOINT].hypothesis_score, 4, small_config.learning))
    assert all(torch.equal(value, Calibration().state_dict()[name]) for name, value in model.calibration.state_dict().items())


def test_nothing_to_join() -> None:
    with pytest.raises(ValueError, match=r"^parts: expected"):
        Judged.joined([])


def test_scans_that_movers_dominate_do_not_count(
    study: Study, models: Models, small_config: Config, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(calibration_fit, "DOMINATED", 0.45)
    model = copy.deepcopy(models.joint[JOINT])
    material = study.collection.material(range(4), model.hypothesis_score, 4, small_config.learning)
    first = material[0].pairs[0]
    assert first.annotation is not None
    half = np.arange(len(first.annotation.body)) % 2
    crowded = replace(first, annotation=replace(first.annotation, body=half))
    assert moving_share(crowded) == pytest.approx(0.5, abs=0.1)
    with_crowd = [replace(part, pairs=tuple(crowded if pair is first else pair for pair in part.pairs)) for part in material]
    calibrate(model, with_crowd)
    parts = []
    plain = copy.deepcopy(models.joint[JOINT])
    plain.calibration = Calibration()
    for part in with_crowd:
        with torch.no_grad():
            prediction = plain(ScanPairBatch.collate(part.pairs).without_truth(), part.start)
        parts.append(judge(part.pairs, prediction, [moving_share(pair) <= 0.45 for pair in part.pairs]))
    expected = fit_calibration(Judged.joined(parts))
    assert torch.equal(model.calibration.association, expected.association)
    assert torch.equal(model.calibration.cluster, expected.cluster)
