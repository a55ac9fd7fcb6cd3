"""Pairs that are varied stay pairs: their annotation follows, and the same generator varies them alike."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from support import generator

from torchcrf_scan.batch import ScanPairBatch
from torchcrf_scan.data.simulate import simulate_pairs
from torchcrf_scan.data.worlds import SimulatorConfig
from torchcrf_scan.geometry import se2
from torchcrf_scan.learning.augment import add_noise, augment, drop_returns, frame_offset, mirror
from torchcrf_scan.learning.settings import AugmentConfig
from torchcrf_scan.scan import Annotation, Scan, ScanPair

SEEDS = st.integers(0, 2**31)
NOTHING = AugmentConfig.nothing()


def simulated(fov: float = 180.0) -> ScanPair:
    return simulate_pairs(SimulatorConfig(beams=61, fov=fov), 1, 1, 5)[0]


def with_gaps(seed: int, n: int = 14, m: int = 11) -> ScanPair:
    """A made-up pair some of whose beams returned nothing, with an annotation of any kind."""
    rng = np.random.default_rng(seed)
    scans = []
    for beams in (n, m):
        ranges = rng.uniform(1, 9, beams)
        ranges[rng.random(beams) < 0.2] = np.nan
        scans.append(Scan.from_ranges(ranges, np.sort(rng.uniform(-2, 2, beams)), range_max=10.0, range_noise=0.02))
    source, target = scans
    is_return = source.to_beams(np.ones(len(source), dtype=bool), False)
    association = np.full(n, -1)
    if len(target):
        association = np.where(is_return & (rng.random(n) < 0.7), target.beam[rng.integers(len(target), size=n)], -1)
    cluster = np.where(association < 0, -1, rng.integers(0, 3, n))
    motions = rng.normal(0, 0.3, (3, 3))
    annotation = Annotation(association, cluster, motions, np.maximum(cluster, 0), ~is_return)
    return ScanPair(source, target, 0.2, annotation, "made up", "one", initial_motion=rng.normal(0, 0.1, 3))


def assert_same(a: ScanPair, b: ScanPair) -> None:
    assert a.annotation is not None
    assert b.annotation is not None
    for one, other in ((a.source, b.source), (a.target, b.target)):
        np.testing.assert_array_equal(one.ranges, other.ranges)
        np.testing.assert_array_equal(one.bearings, other.bearings)
        np.testing.assert_array_equal(one.beam, other.beam)
        assert (one.n_beams, one.range_noise) == (other.n_beams, other.range_noise)
    for name in ("association", "cluster", "motions", "body", "ignore"):
        np.testing.assert_array_equal(getattr(a.annotation, name), getattr(b.annotation, name))


def assert_consistent(pair: ScanPair) -> None:
    """The rules of `Scan` and `Annotation`."""
    truth = pair.annotation
    assert truth is not None
    for scan in (pair.source, pair.target):
        assert (np.diff(scan.bearings) >= 0).all()
        assert (np.diff(scan.beam) > 0).all()
        assert (scan.ranges > 0).all()
        assert not len(scan) or 0 <= scan.beam[0] <= scan.beam[-1] < scan.n_beams
    assert all(len(getattr(truth, name)) == pair.source.n_beams for name in ("association", "cluster", "body", "ignore"))
    np.testing.assert_array_equal(truth.association < 0, truth.cluster < 0)
    associated = truth.association[~truth.ignore & (truth.association >= 0)]
    assert np.isin(associated, pair.target.beam).all()


# --- mirror -------------------------------------------------------------------------------------------------------------------


@given(seed=SEEDS)
def test_a_mirrored_pair_is_a_pair_and_twice_mirrored_the_pair_again(seed: int) -> None:
    pair = with_gaps(seed)
    once = mirror(pair)
    assert_consistent(once)
    assert_same(mirror(once), pair)
    assert once.initial_motion is not None
    np.testing.assert_array_equal(once.initial_motion, np.asarray(pair.initial_motion) * [-1, 1, -1])


@pytest.mark.parametrize("fov", [180.0, 360.0])
def test_true_counterparts_lie_as_near_in_the_mirror(fov: float) -> None:
    pair = simulated(fov)
    mirrored = mirror(pair)
    assert mirrored.source.is_closed == pair.source.is_closed
    np.testing.assert_allclose(residuals(mirrored)[::-1], residuals(pair), atol=1e-9)
    np.testing.assert_allclose(mirrored.source.points[::-1], pair.source.points * [1, -1], atol=1e-12)


def residuals(pair: ScanPair) -> np.ndarray:
    """(P,) metres between associated returns under the true motions, in the order of the source's beams."""
    truth = pair.annotation
    assert truth is not None
    sources = pair.source.to_beams(pair.source.points, np.nan)
    targets = pair.target.to_beams(pair.target.points, np.nan)
    inlier = truth.association >= 0
    motions = truth.motions[truth.cluster[inlier]]
    moved = se2.rotate(motions[:, 0], sources[inlier]) + motions[:, 1:]
    return np.linalg.norm(moved - targets[truth.association[inlier]], axis=-1)


# --- dropouts and noise -------------------------------------------------------------------------------------------------------


@given(seed=SEEDS, share=st.floats(0.0, 0.95))
def test_lost_returns_leave_a_consistent_pair(seed: int, share: float) -> None:
    pair = with_gaps(seed)
    fewer = drop_returns(pair, share, generator(seed))
    assert_consistent(fewer)
    before, after = pair.annotation, fewer.annotation
    assert before is not None
    assert after is not None
    kept = np.isin(np.arange(pair.source.n_beams), fewer.source.beam)
    has_partner = np.isin(before.association, fewer.target.beam) | (before.association < 0)
    untouched = kept & has_partner
    np.testing.assert_array_equal(after.association[untouched], before.association[untouched])
    np.testing.assert_array_equal(after.ignore, before.ignore | ~untouched)
    np.testing.assert_array_equal(after.body, before.body)
    np.testing.assert_array_equal(after.motions, before.motions)


def test_about_the_asked_share_is_lost() -> None:
    pair = simulate_pairs(SimulatorConfig(), 1, 1, 0)[0]
    fewer = drop_returns(pair, 0.3, generator(0))
    assert len(fewer.source) / len(pair.source) == pytest.approx(0.7, abs=0.1)
    assert fewer.source.n_beams == pair.source.n_beams


@given(seed=SEEDS, amount=st.floats(0.0, 50.0))
def test_noise_loses_no_return_and_states_itself(seed: int, amount: float) -> None:
    pair = with_gaps(seed)
    noisy = add_noise(pair, amount, generator(seed))
    assert_consistent(noisy)
    for before, after in ((pair.source, noisy.source), (pair.target, noisy.target)):
        assert len(after) == len(before)
        again = Scan.from_ranges(after.ranges, after.bearings, range_max=after.range_max)
        assert len(again) == len(after)  # every return still is one
        assert after.range_noise == pytest.approx(0.02 * np.hypot(1, amount))


def test_noise_has_the_asked_spread() -> None:
    pair = simulate_pairs(SimulatorConfig(), 1, 1, 0)[0]
    error = add_noise(pair, 3.0, generator(1)).source.ranges - pair.source.ranges
    assert error.std() == pytest.approx(3 * 0.015, rel=0.15)
    unsure = replace(pair, source=replace(pair.source, range_noise=None))
    assert add_noise(unsure, 3.0, generator(1)).source.range_noise is None


# --- all of it ----------------------------------------------------------------------------------------------------------------


@given(seed=SEEDS)
def test_the_same_generator_varies_alike_and_all_is_consistent(seed: int) -> None:
    pair = with_gaps(seed)
    varied = augment(pair, AugmentConfig(), generator(seed))
    assert_consistent(varied)
    assert_same(varied, augment(pair, AugmentConfig(), generator(seed)))


@given(seed=SEEDS)
def test_nothing_asked_for_is_nothing_done(seed: int) -> None:
    pair = with_gaps(seed)
    assert_same(augment(pair, NOTHING, generator(seed)), pair)
    assert not frame_offset(pair, NOTHING, generator(seed)).any()


@given(seed=SEEDS)
def test_an_offset_frame_keeps_the_scene(seed: int) -> None:
    pair = with_gaps(seed)
    config = AugmentConfig(frame_rotation=0.4, frame_translation=0.1)
    offset = frame_offset(pair, config, generator(seed))
    most = 0.1 * np.median(pair.target.ranges) if len(pair.target) else 0.0
    assert (np.abs(offset) <= [0.4, most, most]).all()
    batch = ScanPairBatch.collate([pair], torch.float64)
    moved = batch.displaced(torch.from_numpy(offset)[None])
    assert batch.truth is not None
    assert moved.truth is not None
    before = se2.apply(batch.truth.motions, batch.source[:, None])
    expected = se2.apply(torch.from_numpy(offset)[None, None], before)
    torch.testing.assert_close(se2.apply(moved.truth.motions, moved.source[:, None]), expected)
