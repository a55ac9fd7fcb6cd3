"""Matching by shape alone: partners wherever a scan went, the best labelling of a chain, and motions that most speak for."""

import itertools
import math

import numpy as np
import oracles
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from support import assert_close, make_points, normal
from surveyed import NOISE, any_scan, array, as_pair, seen
from torch import Tensor

from torchcrf_scan.batch import ScanPairBatch
from torchcrf_scan.data.simulate import simulate_pairs
from torchcrf_scan.data.worlds import WORLDS
from torchcrf_scan.features.potentials import REFERENCE_UNIT
from torchcrf_scan.features.scales import Scales
from torchcrf_scan.geometry import se2
from torchcrf_scan.loops.jit import Array, Integers
from torchcrf_scan.loops.shape import describe, resolution
from torchcrf_scan.search import cold
from torchcrf_scan.search.cold import (
    best_labels,
    ransac_motions,
    sampled_motions,
    shape_association,
    shape_candidates,
    shape_motions,
)
from torchcrf_scan.search.surface import Surface

TRUE = torch.tensor([0.1, -0.5, 0.2], dtype=torch.float64)
WALL = torch.stack([torch.linspace(3.0, 1.0, 35, dtype=torch.float64), torch.full((35,), 2.0, dtype=torch.float64)], dim=1)


def associate(source: Tensor | Array, target: Tensor | Array, noise: float = NOISE, *, closed: bool = False) -> list[int]:
    return shape_association(array(source), array(target), noise, closed, closed).tolist()


# Candidates.


def alike(source: Array, target: Array, closed: bool) -> Array:
    """(N, M) mean of the nine shape channels, by the oracle."""
    channels = oracles.local_association(source, target, Scales().local.tolist(), (0.0, 0.0, 0.0), source, closed, closed)
    return channels[..., :9].mean(-1)


@given(st.integers(1, 7), st.integers(1, 9), st.integers(1, 12), st.booleans(), st.integers(0, 10_000))
@settings(max_examples=25)
def test_candidates_are_the_most_alike(n: int, m: int, count: int, closed: bool, seed: int) -> None:
    source, target = make_points(n, seed, closed=closed).numpy(), make_points(m, seed + 1, closed=closed).numpy()
    rows = (cold._rows_of(describe(points, closed)) for points in (source, target))
    index, score = shape_candidates(*rows, count)
    expected = alike(source, target, closed)
    assert index.shape == (n, min(count, m))
    assert (np.diff(index, axis=1) > 0).all()
    assert_close(score, np.take_along_axis(expected, index, 1))
    assert_close(np.sort(score, 1), np.sort(expected, 1)[:, -index.shape[1] :])


# The chain.


def edges(source: Array, target: Array, index: Integers) -> Array:
    """(N - 1, K + 1, K + 1) log potentials of the chain."""
    N, K = index.shape
    scale, switched = float(Scales().pairwise[0]), float(Scales().pairwise_outlier[0])
    found = np.empty((N - 1, K + 1, K + 1))
    for i, a, b in np.ndindex(*found.shape):
        if K in (a, b):
            found[i, a, b] = 0.5 * switched - (a != b)
            continue
        step = math.dist(source[i], source[i + 1]) - math.dist(target[index[i, a]], target[index[i + 1, b]])
        found[i, a, b] = 2.0 * (index[i + 1, b] == index[i, a] + 1) + 0.5 * oracles.robust(step, scale)
    return found


@given(st.integers(1, 5), st.integers(1, 7), st.integers(1, 4), st.booleans(), st.integers(0, 10_000))
@settings(max_examples=40)
def test_the_labelling_is_the_best_of_all(n: int, m: int, K: int, on_a_line: bool, seed: int) -> None:
    source, target, K = make_points(n, seed).numpy(), make_points(m, seed + 1).numpy(), min(K, m)
    if on_a_line:
        source, target = np.c_[0.5 * np.arange(n), np.ones(n)], np.c_[0.5 * np.arange(m), np.ones(m)]
    random = np.random.default_rng(seed)
    index = np.sort(random.permuted(np.tile(np.arange(m), (n, 1)), axis=1)[:, :K], axis=1)
    score = random.uniform(-4, 0, (n, K))
    labels = best_labels(source, target, index, score)
    nodes, steps = np.c_[score, np.full(n, -3.0)], edges(source, target, index)
    states = [K if label < 0 else index[i].tolist().index(label) for i, label in enumerate(labels)]
    best = oracles.score(nodes, steps, oracles.best_labelling(nodes, steps))
    assert_close(oracles.score(nodes, steps, states), best)
    others = sorted(oracles.score(nodes, steps, labelling) for labelling in itertools.product(range(K + 1), repeat=n))
    if len(others) < 2 or others[-1] - others[-2] > 1e-9:
        assert tuple(states) == oracles.best_labelling(nodes, steps)


@pytest.mark.parametrize("first", [-1.0, -30.0])
@pytest.mark.parametrize("step", [0.0, 0.4, 30.0])
@pytest.mark.parametrize("index", [[[0], [1]], [[0], [2]]])
def test_a_label_changes_where_the_potentials_say(first: float, step: float, index: list[list[int]]) -> None:
    """The second of two points stays associated as long as that is worth more than being an outlier, to a hundredth."""
    source, target = np.array([[0.0, 1.0], [0.5, 1.0]]), np.array([[0.0, 1.0], [0.5 + step, 1.0], [0.5 + step, 1.0]])
    index_ = np.array(index)
    ((to_candidate, to_outlier), (from_outlier, stay)) = edges(source, target, index_)[0]
    is_inlier = first > -3.0  # the first point, whatever becomes of the second
    worth = (to_outlier - to_candidate if is_inlier else stay - from_outlier) - 3.0
    for more, label in ((0.01, index[1][0]), (-0.01, -1)):
        labels = best_labels(source, target, index_, np.array([[first], [worth + more]]))
        assert labels.tolist() == [index[0][0] if is_inlier else -1, label]


@pytest.mark.parametrize("closed", [False, True])
@pytest.mark.parametrize(("n", "m"), [(1, 1), (2, 3), (3, 5), (5, 3), (4, 4)])
def test_an_association_is_that_chain_in_units_of_spacing(n: int, m: int, closed: bool) -> None:
    source = make_points(n, 1, closed=closed).numpy()
    moved = se2.apply(np.array([0.4, 1.0, -2.0]), source) + 0.002 * normal(n, 2, seed=3).numpy()
    for target in (make_points(m, 2, closed=closed).numpy(), moved):
        factor = REFERENCE_UNIT / resolution(source, target, NOISE)
        here, there = source * factor, target * factor
        every = np.tile(np.arange(len(target)), (n, 1))
        nodes = np.c_[alike(here, there, closed), np.full(n, -3.0)]
        best = oracles.best_labelling(nodes, edges(here, there, every))
        expected = [state if state < len(target) else -1 for state in best]
        assert associate(source, target, closed=closed) == expected


def test_shapes_alone_find_the_partners_wherever_the_scan_went() -> None:
    source = make_points(40, 3)
    target = se2.apply(torch.tensor([1.0, 20.0, -7.0]).double(), source)[5:]
    assert associate(source, target)[8:32] == [i - 5 for i in range(8, 32)]


@pytest.mark.parametrize("world", ["street", "model_cars"])
def test_simulated_pairs_are_mostly_associated_with_what_they_became(world: str) -> None:
    """A point's partner is near to where its motion takes it."""
    for pair in simulate_pairs(WORLDS[world], 3, 3, seed=0):
        known = as_pair(pair)
        found = np.array(associate(known.source, known.target, known.noise, closed=known.source_closed))
        assert pair.annotation is not None
        moved = se2.apply(pair.annotation.motions[0], known.source)
        apart = np.linalg.norm(moved - known.target[found], axis=1)[found >= 0]
        assert (found >= 0).sum() > 20
        assert np.median(apart) < 10 * resolution(known.source, known.target, known.noise)


def test_shapes_of_an_empty_scan_match_nothing() -> None:
    assert associate(WALL[:0], WALL) == []
    assert associate(WALL, WALL[:0]) == [-1] * len(WALL)


@given(any_scan(), any_scan())
@settings(max_examples=25)
def test_any_scans_are_associated_with_points_that_there_are(source: Surface, target: Surface) -> None:
    noise = max(source.noise, 0.001)
    found = shape_association(source.points, target.points, noise, source.is_closed, target.is_closed)
    assert len(found) == len(source.points)
    assert -1 <= min(found) <= max(found) < len(target.points)


# RANSAC.


def test_ransac_recovers_the_motion_of_the_majority() -> None:
    source = make_points(60, 1)
    target = se2.apply(TRUE, source)
    target[::3] = make_points(20, 2)  # a third is wrong
    motions = ransac_motions(source.numpy(), target.numpy(), 0.05, 4)
    assert motions.shape == (4, 3)
    assert_close(motions[0], TRUE)


@pytest.mark.parametrize(("points", "motions"), [(0, 0), (1, 0), (2, 4)])
def test_ransac_of_few_points(points: int, motions: int) -> None:
    source = make_points(2, 1)[:points]
    found = ransac_motions(source.numpy(), se2.apply(TRUE, source).numpy(), 0.05, 4)
    assert found.shape == (motions, 3)
    assert np.isfinite(found).all()
    if motions:
        assert_close(found[0], TRUE)


def test_ransac_draws_the_same_samples_every_time() -> None:
    source, target = make_points(30, 1).numpy(), make_points(30, 2).numpy()
    first = ransac_motions(source, target, 0.5, 8)
    torch.manual_seed(123)
    assert ransac_motions(source, target, 0.5, 8).tolist() == first.tolist()


def test_ransac_of_one_spot() -> None:
    spot = np.ones((5, 2))
    np.testing.assert_allclose(ransac_motions(spot, spot + 2.0, 0.1, 4), [[0.0, 2.0, 2.0]] * 4, atol=1e-12)


@given(st.integers(2, 12), st.booleans(), st.integers(0, 10_000))
def test_two_points_decide_a_motion_and_all_are_counted(count: int, on_a_spot: bool, seed: int) -> None:
    source, target = make_points(count, seed).numpy(), make_points(count, seed + 1).numpy()
    if on_a_spot:
        source[1:] = source[0]
    picks = np.random.default_rng(seed).integers(0, count, (6, 2))
    motions, agreeing = sampled_motions(source, target, 1.0, picks)
    for motion, agree, (a, b) in zip(motions.tolist(), agreeing.tolist(), picks.tolist(), strict=True):
        middle = oracles.move(motion, (source[a] + source[b]) / 2)
        assert_close(np.array(middle), (target[a] + target[b]) / 2)
        if math.dist(source[a], source[b]) > 1e-6:  # the arm is turned to its partner
            arm, partner = np.subtract(oracles.move(motion, source[b]), oracles.move(motion, source[a])), target[b] - target[a]
            assert abs(oracles.wrap(math.atan2(*arm[::-1]) - math.atan2(*partner[::-1]))) < 1e-6
        else:
            assert motion[0] == 0
        apart = [math.dist(oracles.move(motion, p), q) for p, q in zip(source, target, strict=True)]
        assert agree == sum(distance < 1.0 for distance in apart)


def test_motions_that_shapes_speak_for() -> None:
    source = make_points(60, 3)
    target = se2.apply(torch.tensor([1.0, 20.0, -7.0]).double(), source)
    found = shape_motions(seen(source), seen(target, origin=(20.0, -7.0)), 0.1, 4)
    assert_close(found[0], [1.0, 20.0, -7.0], tolerance=1e-6)
    assert shape_motions(seen(source[:1]), seen(target[:1]), 0.1, 4).shape == (0, 3)


def test_a_batch_in_single_precision_is_associated_as_in_double() -> None:
    pair = simulate_pairs(WORLDS["street"], 1, 1, seed=1)[0]
    single = ScanPairBatch.collate([pair])
    found = associate(single.source[0], single.target[0], float(single.range_noise[0]))
    double = as_pair(pair)
    assert np.mean(np.array(found) == associate(double.source, double.target, double.noise)) > 0.95
