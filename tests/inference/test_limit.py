"""The distance of outliers in metres: where it decides, its gradients, and what it refuses."""

from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest
import torch
from support import normal

from torchcrf_scan import JointScanCRF, ScanPairBatch
from torchcrf_scan.config import InferenceConfig, ModelConfig
from torchcrf_scan.data.simulate import simulate_pairs
from torchcrf_scan.data.worlds import SimulatorConfig
from torchcrf_scan.features.limit import STRENGTH, Limit
from torchcrf_scan.geometry import se2
from torchcrf_scan.inference.start import Start
from torchcrf_scan.scan import PairPrediction, ScanPair

DISTANCES = (0.02, 0.05, 0.1, 0.2, 0.5, 2.0)


@cache
def scene(seed: int) -> ScanPair:
    return simulate_pairs(SimulatorConfig(beams=121, movers_min=1), 1, 1, seed)[0]


@cache
def layer(name: str = "simulated", **settings: Any) -> JointScanCRF:
    return JointScanCRF.from_pretrained(name, **settings)


def nearest_of(pair: ScanPair, answer: PairPrediction) -> tuple[np.ndarray, np.ndarray]:
    """Beams of the source's points that are in a cluster, and the distance to their nearest target point under its motion."""
    beam = pair.source.beam[answer.cluster[pair.source.beam] >= 0]
    points = pair.source.to_beams(pair.source.points, np.nan)[beam]
    motions = answer.motions[answer.cluster[beam]]
    moved = np.stack([se2.apply(motion, point[None])[0] for motion, point in zip(motions, points, strict=True)])
    return beam, np.linalg.norm(moved[:, None] - pair.target.points, axis=-1).min(-1)


@pytest.mark.parametrize("name", ["simulated", "encoder"])
@pytest.mark.parametrize("metres", [0.05, 0.15, 0.5])
def test_the_decision_lies_at_the_distance_under_the_answered_motions(name: str, metres: float) -> None:
    for seed in range(3):
        pair = scene(seed)
        answer = layer(name).match(pair.source, pair.target, pair.dt, outlier_distance=metres)
        beam, distance = nearest_of(pair, answer)
        is_clear = np.abs(distance - metres) > 0.1 * metres + 0.01
        assert ((answer.association[beam] < 0) == (distance > metres))[is_clear].mean() > 0.99
        agree = (answer.association[pair.source.beam] < 0) == (answer.cluster[pair.source.beam] < 0)
        assert agree.mean() > 0.97


def test_a_larger_distance_gives_no_more_outliers_at_given_motions() -> None:
    batch = ScanPairBatch.collate([scene(4)]).without_truth()
    model = layer(motion_metric="given", movers="threshold")
    start = model.initialise(batch)
    with torch.no_grad():
        counts = [int((model(batch, start, outlier_distance=metres).association < 0).sum()) for metres in DISTANCES]
    assert counts == sorted(counts, reverse=True)
    assert counts[0] > counts[-1]


def test_extremes() -> None:
    pair = scene(1)
    tiny = layer().match(pair.source, pair.target, pair.dt, outlier_distance=1e-9)
    huge = layer().match(pair.source, pair.target, pair.dt, outlier_distance=1e9)
    assert (tiny.association < 0).all()
    assert (tiny.cluster < 0).all()
    assert (huge.association[pair.source.beam] >= 0).all()
    assert np.isfinite(np.concatenate([tiny.motions, huge.motions])).all()


@pytest.mark.parametrize("wrong", [0.0, -1.0, float("nan"), float("inf"), True, "far"])
def test_what_is_no_distance_is_refused(wrong: Any) -> None:
    pair = scene(0)
    with pytest.raises(ValueError, match="outlier_distance: expected nothing or a finite number above 0"):
        layer().match(pair.source, pair.target, pair.dt, outlier_distance=wrong)


def test_variants_without_it_refuse_it() -> None:
    for config in (ModelConfig(inference=InferenceConfig(schedule="flooding")), ModelConfig(coupling="lattice")):
        with pytest.raises(ValueError, match="with outlier_distance"):
            config.with_limit(0.3)


def test_none_is_the_model_s_own(tmp_path: Any) -> None:
    pair = scene(2)
    own = JointScanCRF.from_pretrained("simulated", outlier_distance=0.1)
    own.save_pretrained(tmp_path)
    loaded = JointScanCRF.from_pretrained(tmp_path)
    assert loaded.config.inference.outlier_distance == 0.1
    given = layer().match(pair.source, pair.target, pair.dt, outlier_distance=0.1)
    np.testing.assert_array_equal(loaded.match(pair.source, pair.target, pair.dt).association, given.association)
    learned = JointScanCRF.from_pretrained(tmp_path, outlier_distance=None).match(pair.source, pair.target, pair.dt)
    np.testing.assert_array_equal(learned.association, layer().match(pair.source, pair.target, pair.dt).association)


def test_the_potential_is_a_smooth_step() -> None:
    limit = Limit(torch.tensor([0.2, 0.4]).double(), torch.tensor([0.01, 0.01]).double())
    distance = torch.tensor([[0.0, 0.2, 9.0], [0.2, 0.4, 0.5]]).double()
    expected = STRENGTH * torch.tanh((limit.distance[:, None] - distance) / 0.02)
    torch.testing.assert_close(limit.log_within(distance), expected)


@pytest.mark.parametrize("unit", ["spacing", "metre"])
def test_gradients_of_points_and_distance(unit: str) -> None:
    pair = simulate_pairs(SimulatorConfig(beams=25), 1, 1, 3)[0]
    batch = ScanPairBatch.collate([pair], torch.float64).without_truth()
    model = JointScanCRF.from_pretrained("simulated", motion_weights="soft", iterations=2, stop_early=False).double()
    model.config = replace(model.config, features=replace(model.config.features, length_unit=unit))
    model.requires_grad_(False)
    start: Start = model.initialise(batch)

    def answer(source: torch.Tensor, metres: torch.Tensor) -> torch.Tensor:
        found = model(replace(batch, source=source), start, outlier_distance=metres)
        parts = (found.motions, found.log_association, found.log_cluster)
        return torch.stack([(torch.where(of.isfinite(), of, 0.0) * normal(*of.shape, seed=2)).sum() for of in parts])

    metres = torch.tensor(0.31, dtype=torch.float64, requires_grad=True)
    source = batch.source.clone().requires_grad_()
    slope = torch.autograd.grad(answer(source, metres)[1:].sum(), [source, metres])
    assert float(slope[1].abs()) > 0
    assert torch.autograd.gradcheck(lambda far: answer(batch.source, far), [metres], eps=1e-7, rtol=1e-4, atol=1e-5)
