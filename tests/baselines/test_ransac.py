"""Trimmed ICP and RANSAC: a moving box is found, nothing else is, and the answer does not change."""

import itertools

import numpy as np
import pytest
from checks import check, same
from rooms import AWKWARD, room_pair

from torchcrf_scan.baselines.ransac import Scene, find_movers, match_ransac, open_parts, search_motion, within_reach
from torchcrf_scan.data.simulate import simulate_pairs
from torchcrf_scan.data.worlds import WORLDS
from torchcrf_scan.evaluation.metrics import score_pair
from torchcrf_scan.geometry import se2
from torchcrf_scan.scan import ScanPair

MOTION = np.array([0.05, 0.2, -0.1])
SHIFT = np.array([0.0, 0.8])


@pytest.fixture(scope="module")
def moving() -> ScanPair:
    return room_pair(MOTION, SHIFT, noise=0.01)


@pytest.fixture(scope="module")
def streets() -> list[ScanPair]:
    return simulate_pairs(WORLDS["street"], 8, 4, 0)


def is_box(pair: ScanPair) -> np.ndarray:
    """(N,) source points on the box: nothing else is so near."""
    return np.abs(pair.source.points - [2.4, -0.1]).max(1) < 0.6


def test_a_moving_box_is_found_with_its_motion(moving: ScanPair) -> None:
    found = match_ransac(moving)
    check(moving, found)
    box = is_box(moving)
    assert box.sum() > 15
    assert np.mean(found.cluster[moving.source.beam][box] == 1) > 0.9
    assert not (found.cluster[moving.source.beam][~box] == 1).any()
    assert se2.distance(found.motions[0], MOTION)[1] < 0.03
    truth = se2.apply(MOTION, moving.source.points[box] + SHIFT)
    assert np.linalg.norm(se2.apply(found.motions[1], moving.source.points[box]) - truth, axis=1).max() < 0.1


@pytest.mark.parametrize("noise", [0.0, 0.01, 0.03])
def test_where_nothing_moves_there_are_no_movers(noise: float) -> None:
    for motion, shift in itertools.product((np.zeros(3), MOTION), (None, np.zeros(2))):
        pair = room_pair(motion, shift, noise)
        assert len(match_ransac(pair).motions) == 1


def test_the_number_of_movers_is_bounded(moving: ScanPair, streets: list[ScanPair]) -> None:
    assert len(match_ransac(moving, movers=0).motions) == 1
    for pair in streets[:2]:
        for most in (1, 3):
            found = match_ransac(pair, movers=most)
            check(pair, found)
            assert len(found.motions) <= 1 + most


def test_it_finds_movers_in_streets(streets: list[ScanPair]) -> None:
    movers = [o for pair in streets for o in score_pair(pair, match_ransac(pair)).objects if o.is_counted]
    assert len(movers) >= 5
    assert np.mean([mover.is_found for mover in movers]) > 0.35


def test_the_same_answer_every_time(moving: ScanPair, streets: list[ScanPair]) -> None:
    for pair in (moving, streets[0]):
        np.random.seed(1)  # the global state plays no part
        first = match_ransac(pair)
        np.random.seed(2)
        assert same(first, match_ransac(pair))


def test_open_parts_are_connected_sets_of_open_points(moving: ScanPair) -> None:
    scene = Scene.of(moving)
    parts = open_parts(scene)
    joined = np.concatenate(parts)
    assert scene.is_open[joined].all()
    assert len(np.unique(joined)) == len(joined)
    assert is_box(moving)[parts[0]].all()
    assert [len(part) for part in parts] == sorted((len(part) for part in parts), reverse=True)


def test_movers_share_no_open_points_and_come_by_gain(streets: list[ScanPair]) -> None:
    for pair in streets[:4]:
        movers = find_movers(Scene.of(pair), 6)
        gains = [mover.gain for mover in movers]
        assert gains == sorted(gains, reverse=True)
        assert all(mover.members.sum() >= 4 for mover in movers)


def test_no_open_target_no_motion(moving: ScanPair) -> None:
    scene = Scene.of(ScanPair(moving.source, moving.source))
    assert open_parts(scene) == []
    part = np.flatnonzero(is_box(moving))
    assert search_motion(scene, part, np.random.default_rng(0)) is None


def test_reach_grows_with_the_object(moving: ScanPair) -> None:
    source = Scene.of(moving).source
    box = np.flatnonzero(is_box(moving))
    few, all_of_it = within_reach(source, box[:2]), within_reach(source, box)
    assert all_of_it[box].all()
    assert few[box[:2]].all()
    assert few.sum() < all_of_it.sum() < len(source)


@pytest.mark.parametrize("names", list(itertools.product(AWKWARD, AWKWARD)))
def test_awkward_scans_get_a_defined_answer(names: tuple[str, str]) -> None:
    pair = ScanPair(*(AWKWARD[name] for name in names))
    check(pair, match_ransac(pair))
