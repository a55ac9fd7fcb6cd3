"""Calibration on one's own laser: what is fitted, what is kept, and that few pairs do no harm."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import torch

from torchcrf_scan import JointScanCRF
from torchcrf_scan.data.simulate import simulate_pairs
from torchcrf_scan.data.worlds import SimulatorConfig
from torchcrf_scan.learning import own_laser
from torchcrf_scan.learning.own_laser import Given, calibrate_on, errors, folds_of, gains, moved_towards, named, surprise
from torchcrf_scan.learning.settings import LearningConfig
from torchcrf_scan.scan import OUTLIER, ScanPair

GATE = 0.1  # metres: the convention of the annotation made up here


@cache
def shipped() -> JointScanCRF:
    return JointScanCRF.from_pretrained("simulated")


@cache
def annotated(count: int = 6) -> list[ScanPair]:
    """Simulated pairs whose annotation calls a point an outlier that is farther than `GATE` from all targets of its body."""
    made = simulate_pairs(SimulatorConfig(beams=91, movers_min=1), count, 1, 11)
    return [with_gate(pair) for pair in made]


def with_gate(pair: ScanPair) -> ScanPair:
    truth = pair.annotation
    assert truth is not None
    association, cluster = np.full(pair.source.n_beams, OUTLIER), np.full(pair.source.n_beams, OUTLIER)
    for beam, point in zip(pair.source.beam, pair.source.points, strict=True):
        body = int(truth.body[beam])
        theta, x, y = truth.motions[max(body, 0)]
        turn = np.array([[np.cos(theta), -np.sin(theta)], [np.sin(theta), np.cos(theta)]])
        distance = np.linalg.norm(pair.target.points - (turn @ point + np.array([x, y])), axis=1)
        if body >= 0 and distance.min() < GATE:
            association[beam], cluster[beam] = pair.target.beam[distance.argmin()], body
    return replace(pair, annotation=replace(truth, association=association, cluster=cluster))


def test_the_annotation_s_convention_is_found_and_kept() -> None:
    fitted, parts = calibrate_on(shipped(), annotated())
    by_name = {part.name: part for part in parts}
    assert list(by_name) == ["outlier distance", "scales", "movers' worth", "confidences"]
    assert by_name["outlier distance"].is_kept
    assert fitted.config.inference.outlier_distance == pytest.approx(GATE, rel=0.3)
    assert errors(fitted, annotated())[:, 0].sum() < errors(shipped(), annotated())[:, 0].sum()


def test_what_is_kept_gains_and_the_model_given_is_unchanged() -> None:
    model = JointScanCRF.from_pretrained("simulated")
    before = {name: value.clone() for name, value in model.state_dict().items()}
    fitted, parts = calibrate_on(model, annotated(3))
    assert all(part.after < part.before for part in parts if part.is_kept)
    assert model.config == shipped().config
    for name, value in model.state_dict().items():
        assert torch.equal(value, before[name]), name
    if not any(part.is_kept for part in parts[1:3]):
        assert torch.equal(fitted.scales.local, model.scales.local)


def test_a_saved_calibration_is_used_by_default(tmp_path: object) -> None:
    fitted, _ = calibrate_on(shipped(), annotated())
    fitted.save_pretrained(str(tmp_path))
    loaded = JointScanCRF.from_pretrained(str(tmp_path))
    assert loaded.config.inference.outlier_distance == fitted.config.inference.outlier_distance
    np.testing.assert_array_equal(errors(loaded, annotated()), errors(fitted, annotated()))


def test_folds_leave_every_pair_out_once() -> None:
    pairs = annotated()
    for some in (pairs, pairs[:2], [replace(pair, sequence=str(k)) for k, pair in enumerate(pairs)]):
        assert sorted(k for fold in folds_of(some) for k in fold) == [*range(len(some))]
        assert all(len(fold) < len(some) for fold in folds_of(some))


def test_a_gain_must_exceed_its_standard_error() -> None:
    assert gains(np.array([9.0, 8.0, 9.0]), np.array([5.0, 5.0, 5.0]))
    assert not gains(np.array([30.0, 5.0, 5.0]), np.array([5.0, 9.0, 9.0]))
    assert not gains(np.array([5.0, 5.0]), np.array([5.0, 5.0]))


def test_shares_lead_from_the_model_s_values_to_the_fitted_ones() -> None:
    fitted = JointScanCRF().scales
    for share in (0.0, 1.0):
        moved = moved_towards(shipped(), named("scales", fitted), share).scales.state_dict()
        expected = (fitted if share else shipped().scales).state_dict()
        for name, value in moved.items():
            torch.testing.assert_close(value, expected[name].to(value))


def test_a_mover_s_worth_is_fitted_or_left(monkeypatch: pytest.MonkeyPatch) -> None:
    given = Given(annotated(3), folds_of(annotated(3)))
    model, part = own_laser.fit_worth(shipped(), given)
    assert (part.value, part.is_kept, model) == ("too few examples", False, shipped())
    assert part.before == part.after
    monkeypatch.setattr(own_laser, "FEWEST_MOVERS", 0)
    monkeypatch.setattr(own_laser, "judge_clusters", lambda *_: (torch.zeros(0), torch.zeros(0)))
    monkeypatch.setattr(own_laser, "fit_potential", lambda *_: JointScanCRF().cluster_potential)
    assert own_laser.fit_worth(shipped(), given)[1].value.endswith("% of the way")


def test_surprise_is_the_negative_log_likelihood() -> None:
    judged = own_laser.Judged(np.array([2.0]), np.array([True]), np.array([-1.0]), np.array([False]), np.zeros(0))
    expected = np.log1p(np.exp(-2.0)) + np.log1p(np.exp(-1.0))
    assert surprise(judged, np.array([[1.0, 0.0], [1.0, 0.0]])) == pytest.approx(expected)


def test_what_cannot_be_calibrated_is_refused() -> None:
    with pytest.raises(ValueError, match="two or more annotated pairs"):
        calibrate_on(shipped(), annotated()[:1])
    with pytest.raises(ValueError, match="two or more annotated pairs"):
        calibrate_on(shipped(), [replace(pair, annotation=None) for pair in annotated()])


def test_weights_go_from_the_model_s_own_as_far_as_pairs_left_out_gain() -> None:
    """A model whose weights were disturbed finds back; the encoder's potentials count, and nothing but the weights moves."""
    model, learning = JointScanCRF.from_pretrained(), LearningConfig(objective="likelihood", predicted_share=0.5, prior=0.3)
    with torch.no_grad():
        model.association_weights["registered_translation"].mul_(0.1)
    given = Given(annotated(), folds_of(annotated()))
    fitted, part = own_laser.fit_own_weights(model, given, learning)
    assert part.is_kept
    assert part.after < part.before
    changed = {name for name, value in fitted.state_dict().items() if not torch.equal(value, model.state_dict()[name])}
    assert "association_weights.registered_translation" in changed
    assert all(name.startswith(("association_weights.", "clustering_weights.")) for name in changed)
    kept, _ = own_laser.fit_own_weights(model, given, replace(learning, prior=1e-6))
    for name, value in kept.state_dict().items():
        torch.testing.assert_close(value, model.state_dict()[name], rtol=1e-3, atol=1e-4)


def test_calibration_begins_with_the_weights_if_asked() -> None:
    _, parts = calibrate_on(shipped(), annotated(3), LearningConfig(prior=0.01, max_steps=2))
    assert [part.name for part in parts][:2] == ["weights", "outlier distance"]
