"""Trimmed ICP: large motions, outliers in the scene, any unit of length."""

import itertools
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from checks import check, same
from rooms import AWKWARD, room_pair

from torchcrf_scan.baselines.cloud import Cloud
from torchcrf_scan.baselines.trimmed_icp import line_step, match_under, register_trimmed, trimmed_step
from torchcrf_scan.data.dataset import PairFiles
from torchcrf_scan.data.simulate import simulate_pairs
from torchcrf_scan.data.worlds import WORLDS
from torchcrf_scan.evaluation.metrics import score_pair
from torchcrf_scan.geometry import se2
from torchcrf_scan.scan import PairPrediction, Scan, ScanPair

MOTIONS = [[0.0, 0.0, 0.0], [0.03, 0.1, -0.08], [0.3, 0.8, 0.4], [-0.35, -0.9, -0.3]]


def register(pair: ScanPair) -> np.ndarray:
    return register_trimmed(Cloud.of(pair.source), Cloud.of(pair.target))


def match(pair: ScanPair) -> PairPrediction:
    return match_under(pair, register(pair))


def rescaled(scan: Scan, factor: float) -> Scan:
    return replace(scan, ranges=scan.ranges * factor)


@pytest.mark.parametrize("motion", MOTIONS)
def test_known_motions_are_recovered_beside_a_moving_box(motion: list[float]) -> None:
    pair = room_pair(np.array(motion), np.array([0.0, 0.8]), noise=0.01)
    turn, shift = se2.distance(register(pair), np.array(motion))
    assert turn < 0.01
    assert shift < 0.03


def test_nothing_is_measured_in_metres() -> None:
    pair = room_pair(np.array(MOTIONS[1]), np.array([0.0, 0.8]), noise=0.01)
    small = replace(pair, source=rescaled(pair.source, 0.1), target=rescaled(pair.target, 0.1))
    assert np.allclose(register(small) * [1.0, 10.0, 10.0], register(pair), atol=1e-3)
    assert np.mean(match(small).association == match(pair).association) > 0.98


def test_steps_of_many_motions_are_those_of_each() -> None:
    pair = room_pair(np.array(MOTIONS[1]))
    source, target = Cloud.of(pair.source), Cloud.of(pair.target)
    motions = np.array(MOTIONS)
    for step in (trimmed_step, line_step):
        together = step(motions, source.points, target, 0.5)
        alone = np.concatenate([step(motions[k : k + 1], source.points, target, 0.5) for k in range(len(motions))])
        assert np.allclose(together, alone)


def test_the_true_motion_is_a_fixed_point_of_identical_scans() -> None:
    cloud = Cloud.of(room_pair(np.zeros(3)).source)
    for step in (trimmed_step, line_step):
        assert np.allclose(step(np.zeros((1, 3)), cloud.points, cloud, 0.5), 0.0, atol=1e-9)


def test_simulated_streets_are_registered() -> None:
    scores = [score_pair(pair, match(pair)) for pair in simulate_pairs(WORLDS["street"], 6, 2, 0)]
    assert sum(score.has_ego_within(0.05, 0.01745) for score in scores) >= 5


def test_full_circles_and_model_cars_are_registered() -> None:
    for pair in simulate_pairs(WORLDS["model_cars"], 3, 1, 0):
        found = match(pair)
        check(pair, found)
        assert score_pair(pair, found).has_ego_within(0.05, 0.01745)


@pytest.mark.parametrize("names", list(itertools.product([name for name, scan in AWKWARD.items() if len(scan)], repeat=2)))
def test_awkward_scans_get_a_defined_answer(names: tuple[str, str]) -> None:
    pair = ScanPair(*(AWKWARD[name] for name in names))
    found = match(pair)
    check(pair, found)
    assert same(found, match(pair))


def test_real_scans_are_registered(real_pairs_dir: Path) -> None:
    scores = [score_pair(pair, match(pair)) for pair in PairFiles(real_pairs_dir / "*.npz")[::12]]
    assert np.mean([score.has_ego_within(0.15, 0.01745) for score in scores]) > 0.7
