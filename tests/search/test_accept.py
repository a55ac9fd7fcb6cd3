"""Which hypotheses are accepted as movers: those that move, each once, whatever the frame; and as the oracle accepts them."""

import numpy as np
import oracles_movers as oracles
import pytest
import torch
from support import assert_close
from surveyed import SCENES, as_pair, survey
from two_movers import BOXES, EGO, NOISE, STEPS, grid, hypotheses_of, in_box, movers_of, scene, survey_of

from torchcrf_scan.data.simulate import simulate_pairs
from torchcrf_scan.data.worlds import SimulatorConfig
from torchcrf_scan.geometry import se2
from torchcrf_scan.learning.hypothesis_fit import label_hypotheses
from torchcrf_scan.loops.jit import Array
from torchcrf_scan.search.accept import probabilities_of, score_of, select
from torchcrf_scan.search.grid import ScanGrid
from torchcrf_scan.search.hypotheses import hypothesise, members_of
from torchcrf_scan.search.hypothesis_features import hypothesis_features
from torchcrf_scan.search.leftover import leftover_of
from torchcrf_scan.search.score import FEATURES, HypothesisScore
from torchcrf_scan.search.survey import grids_of, survey_at

DT = 0.2


def assert_found(motions: Array, source: ScanGrid, expected: dict[str, Array], tolerance: float) -> None:
    for name, motion in expected.items():
        points = source.scan.points[in_box(source.scan.points, name)]
        error = np.linalg.norm(se2.apply(motions, points) - se2.apply(motion, points), axis=-1).mean(-1)
        assert error.min() < tolerance, name


def test_the_pool_holds_both_movers() -> None:
    source, target = scene()
    pool = hypothesise(leftover_of(source, target, EGO), DT)
    assert_found(pool.motions, source, {name: se2.compose(EGO, step) for name, step in STEPS.items()}, 0.08)
    assert (np.diff(pool.groups.start) >= 3).all()


def test_two_objects_are_found_and_nothing_else() -> None:
    source, target = scene()
    motions, _, probabilities = movers_of(source, target)
    assert len(motions) == 2
    assert_found(motions, source, {name: se2.compose(EGO, step) for name, step in STEPS.items()}, 0.1)
    assert (np.diff(probabilities) <= 0).all()


def test_two_objects_of_one_motion_far_apart_are_two() -> None:
    alike = dict.fromkeys(BOXES, np.array([0.0, 1.1, 0.1]))
    source, target = scene(steps=alike)
    motions, members, _ = movers_of(source, target)
    assert_found(motions, source, {name: se2.compose(EGO, step) for name, step in alike.items()}, 0.1)
    for name in BOXES:
        assert (members & in_box(source.scan.points, name)).any(-1).sum() == 1, name


def test_one_motion_of_two_parts_of_an_object_is_accepted_once() -> None:
    source, target = scene()
    motion = se2.compose(EGO, STEPS["ahead"])
    car = np.flatnonzero(in_box(source.scan.points, "ahead"))
    members = np.zeros((2, len(source.features)), np.bool_)
    members[0, car[::2]] = members[1, car[1::2]] = True
    hypotheses = hypotheses_of(np.stack([motion, motion]), members)
    found = select(leftover_of(source, target, EGO), hypotheses, np.array([0.8, 0.9]), 0.5, 6)
    assert found.tolist() == [1]
    assert members_of(hypotheses, found, members.shape[1]).tolist() == members[1:].tolist()


def test_what_stands_still_is_no_mover() -> None:
    assert len(movers_of(*scene(moving=()))[0]) == 0


def test_most_scenes_without_movers_give_none() -> None:
    pairs = simulate_pairs(SimulatorConfig(movers_min=0, movers_max=0, beams=181), 8, 8, 5)
    found = [len(movers_of(*grids_of(as_pair(p)), p.annotation.motions[0], p.dt)[0]) for p in pairs if p.annotation is not None]
    assert sum(count == 0 for count in found) >= 6


def test_simulated_movers_are_found() -> None:
    right = accepted = 0
    for pair in simulate_pairs(SimulatorConfig(movers_min=2, movers_max=3), 8, 8, 11):
        assert pair.annotation is not None
        source, target = grids_of(as_pair(pair))
        background = pair.annotation.motions[0]
        motions, members, _ = movers_of(source, target, background, pair.dt)
        if len(motions):
            known = survey_of(source, target, background, motions, members)
            known = known._replace(leftover=known.leftover._replace(unit=0.1))
            label = label_hypotheses(known, members, pair.annotation.body, pair.annotation.motions)
            right, accepted = right + int((label == 1).sum()), accepted + len(label)
    assert accepted >= 8
    assert right / accepted > 0.6


def test_turning_the_target_frame_turns_the_motions() -> None:
    """Within the view of a target sensor that looks elsewhere from the same place."""
    source, target = scene()
    turn = np.array([0.4, 0.0, 0.0])
    here, _, _ = movers_of(source, target)
    there, _, _ = movers_of(source, grid(se2.apply(turn, target.scan.points)), se2.compose(turn, EGO))
    assert len(here) == len(there)
    np.testing.assert_allclose(there, se2.compose(np.tile(turn, (len(here), 1)), here), atol=5e-3, rtol=0)


def test_scaling_the_world_scales_the_features() -> None:
    """All features are in local units: a world ten times smaller, seen by a sensor ten times as exact, looks the same."""
    source, target = scene()
    small_source, small_target = (grid(s.scan.points / 10, NOISE / 10) for s in (source, target))
    shrink = np.array([1.0, 0.1, 0.1])
    leftover = leftover_of(source, target, EGO)
    pool = hypothesise(leftover, DT)
    here = hypothesis_features(leftover, pool)
    there = hypothesis_features(leftover_of(small_source, small_target, EGO * shrink), pool._replace(motions=pool.motions * shrink))
    assert here.shape == (len(pool.motions), len(FEATURES))
    np.testing.assert_allclose(there, here, atol=0.1, rtol=0)
    np.testing.assert_allclose(np.median(there, 0), np.median(here, 0), atol=0.02, rtol=0)


def test_the_order_of_the_hypotheses_does_not_matter() -> None:
    source, target = scene()
    leftover = leftover_of(source, target, EGO)
    pool = hypothesise(leftover, DT)
    features = hypothesis_features(leftover, pool)
    order = np.random.default_rng(0).permutation(len(pool.motions))
    shuffled = pool._replace(motions=pool.motions[order], group=pool.group[order])
    mixed = hypothesis_features(leftover, shuffled)
    np.testing.assert_allclose(mixed, features[order], atol=1e-4, rtol=1e-4)
    score = score_of(HypothesisScore())
    one, other = (
        p.motions[select(leftover, p, probabilities_of(score, f), 0.3, 6)] for p, f in ((pool, features), (shuffled, mixed))
    )
    assert len(one) > 1
    np.testing.assert_allclose(other, one, atol=1e-3, rtol=0)


def test_at_most_so_many_are_accepted() -> None:
    source, target = scene()
    leftover = leftover_of(source, target, EGO)
    pool = hypothesise(leftover, DT)
    certain = np.ones(len(pool.motions))
    for most in (0, 1, 3):
        assert len(select(leftover, pool, certain, 0.5, most)) <= most
    assert len(select(leftover, pool, 0 * certain, 0.5, 6)) == 0


@pytest.mark.parametrize("count", [1, 2])
@pytest.mark.parametrize("is_source", [True, False])
def test_hardly_any_points_give_no_movers(count: int, is_source: bool) -> None:
    source, target = scene()
    few = grid((source if is_source else target).scan.points[:count])
    pair = (few, target) if is_source else (source, few)
    motions, members, probabilities = movers_of(*pair)
    assert motions.shape == (0, 3)
    assert probabilities.shape == (0,)
    assert members.shape == (0, len(pair[0].features))


def test_a_perfect_background_leaves_no_hypotheses() -> None:
    source, _ = scene()
    survey = survey_at(source, source, np.zeros(3), DT)
    assert survey.hypotheses.motions.shape == (0, 3)
    assert survey.features.shape == (0, len(FEATURES))
    assert len(movers_of(source, source, np.zeros(3))[0]) == 0


# --- against loops that know nothing of the package ---------------------------------------------------------------------------


def test_probabilities_are_those_of_the_module() -> None:
    score = HypothesisScore().double()
    features = 8 * torch.randn(20, len(FEATURES), dtype=torch.float64)  # some beyond `LARGEST`
    features[:10] = score.mean + score.scale * torch.randn(10, len(FEATURES), dtype=torch.float64)
    assert_close(probabilities_of(score_of(score), features.numpy()), score(features))


@pytest.mark.parametrize("name", SCENES)
@pytest.mark.parametrize(("threshold", "most"), [(0.02, 50), (0.1, 5), (0.1, 0), (2.0, 5)])
def test_the_same_are_accepted_in_the_same_order(name: str, threshold: float, most: int) -> None:
    at = survey(name)
    probabilities = probabilities_of(score_of(HypothesisScore()), at.features)
    found = select(at.leftover, at.found, probabilities, threshold, most)
    assert found.tolist() == oracles.accept(at.scene, at.found.motions, at.members, probabilities.tolist(), threshold, most)


def test_all_that_do_not_compete_are_accepted() -> None:
    at = survey("street")
    probabilities = np.random.default_rng(0).random(len(at.found.motions))
    found = select(at.leftover, at.found, probabilities, 0.0, 100)
    assert len(found) > 3
    assert found.tolist() == oracles.accept(at.scene, at.found.motions, at.members, probabilities.tolist(), 0.0, 100)
