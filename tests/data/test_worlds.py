"""The named worlds of training, and what they add to the simulator: skew, loose things, an annotation as of recordings."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from torchcrf_scan.data import annotate, simulate, world
from torchcrf_scan.data.laser import beam_bearings
from torchcrf_scan.data.simulate import simulate_pairs
from torchcrf_scan.data.worlds import NAMED_WORLDS, TRAINING_WORLDS, WORLDS, SimulatorConfig
from torchcrf_scan.geometry import se2
from torchcrf_scan.scan import ScanPair

STILL = SimulatorConfig(movers_min=0, movers_max=0)
QUIET = replace(STILL, range_noise=0.0, vibration=0.0, dropout=0.0, mixed_pixels=0.0, clutter=0.0)


@pytest.fixture(scope="module", params=TRAINING_WORLDS)
def named(request: pytest.FixtureRequest) -> tuple[SimulatorConfig, list[ScanPair]]:
    config = TRAINING_WORLDS[request.param]
    return config, simulate_pairs(config, 4, 2, 17)


def travel(pair: ScanPair, number: int) -> float:
    """The farthest that a mover's returns travel against the background, metres."""
    assert pair.annotation is not None
    points = pair.source.points[pair.annotation.body == number]
    shift = se2.apply(pair.annotation.motions[number], points) - se2.apply(pair.annotation.motions[0], points)
    return float(np.hypot(*shift.T).max())


def test_the_worlds_of_evaluations_are_kept_apart():
    assert not set(WORLDS) & set(TRAINING_WORLDS)
    assert NAMED_WORLDS == WORLDS | TRAINING_WORLDS


def test_beams_and_field_of_view_are_as_said(named):
    config, pairs = named
    assert 16 <= config.beams <= 1441
    assert 90 <= config.fov <= 360
    sensor = beam_bearings(config)[0]
    for pair in pairs:
        for scan in (pair.source, pair.target):
            assert 0 < len(scan) <= config.beams
            assert np.isin(scan.bearings, sensor).all()
            assert np.ptp(scan.bearings) <= np.radians(config.fov) + 1e-9
    assert np.ptp(np.concatenate([pair.source.bearings for pair in pairs])) > 0.7 * np.radians(config.fov)


def test_the_annotation_is_whole_and_finite(named):
    _, pairs = named
    for pair in pairs:
        truth = pair.annotation
        assert np.isfinite(truth.motions).all()
        assert np.isfinite(pair.source.ranges).all()
        assert np.isfinite(pair.target.ranges).all()
        np.testing.assert_array_equal(truth.cluster == -1, truth.association == -1)
        assert (truth.association < len(pair.target)).all()
        assert (truth.association[truth.ignore] == -1).all()
        has_partner = truth.association >= 0
        assert has_partner.mean() > 0.3
        np.testing.assert_array_equal(truth.cluster[has_partner], truth.body[has_partner])
        assert set(range(1, len(truth.motions))) <= set(truth.body)


def test_annotated_movers_travel_more_than_the_tolerance(named):
    config, pairs = named
    assert config.least_travel >= 1
    movers = 0
    for pair in pairs:
        noise = float(np.hypot(config.range_noise, config.vibration))
        tolerance = annotate.GATE * 2 * noise  # the gate is at least this, on the densest surfaces
        travels = [travel(pair, k) for k in range(1, len(pair.annotation.motions))]
        assert all(far >= tolerance for far in travels)
        movers += len(travels)
    assert movers == 0 if config.movers_max == 0 else movers > 0 or config.beams < 100  # few beams seldom meet one


def test_training_worlds_state_no_limits(named):
    _, pairs = named
    for pair in pairs:
        assert (pair.source.range_min, pair.source.range_max, pair.source.range_noise) == (None, None, None)


def test_scanners_differ_and_a_third_of_the_worlds_stand_still():
    scanners = {(config.beams, config.fov) for config in TRAINING_WORLDS.values()}
    assert len(scanners) >= 10
    assert {beams for beams, _ in scanners} >= {16, 1441}
    assert {fov for _, fov in scanners} >= {90.0, 360.0}
    still = [config.movers_max == 0 for config in TRAINING_WORLDS.values()]
    assert 0.2 < np.mean(still) < 0.4
    assert np.mean([config.dominant_mover > 0 for config in TRAINING_WORLDS.values()]) < 0.1


# --- skew ---------------------------------------------------------------------------------------------------------------------


def residuals(captures: list[annotate.Capture], name: str) -> np.ndarray:
    """Distances of the returns `settled`, or as measured in `scan`, to the nearest of an unskewed and dense scan."""
    skewed, dense = captures
    points = skewed.settled if name == "settled" else skewed.scan.points
    return np.hypot(*(points[:, None] - dense.scan.points).transpose(2, 0, 1)).min(1)


@pytest.mark.parametrize("scale", [1.0, 0.1])
def test_settled_returns_lie_where_an_instant_sensor_sees_them(scale):
    config = replace(QUIET, sweep=0.2, range_max=12.0 * scale, range_min=0.0, scale=scale)
    worse = []
    for seed in range(4):
        built = world.street(np.random.default_rng(seed), -20.0, 40.0, 0.0)
        path = np.array([[0.0, 0.0, built.lane], [0.15, 2.0, built.lane + 0.1], [0.3, 4.0, built.lane + 0.3]])
        drives = [
            simulate._Drive(each, np.random.default_rng(seed), built, path, 0.2 * np.arange(3.0), [])
            for each in (config, replace(config, sweep=0.0, beams=20_000))
        ]
        captures = [drive.capture(1) for drive in drives]
        settled, measured = (np.median(residuals(captures, name)) for name in ("settled", "scan"))
        assert settled < 0.01 * scale
        worse.append(measured > 3 * settled)
    assert np.mean(worse) > 0.7


def test_a_sensor_and_a_world_that_stand_still_are_not_skewed():
    for pair in simulate_pairs(replace(QUIET, sweep=0.2, ego_translation=0.0, ego_rotation=0.0), 3, 3, 4):
        _, ours, theirs = np.intersect1d(pair.source.bearings, pair.target.bearings, return_indices=True)
        assert len(ours) > 0.9 * len(pair.source)
        np.testing.assert_allclose(pair.source.ranges[ours], pair.target.ranges[theirs])


def test_skewed_movers_keep_their_partners():
    config = SimulatorConfig(sweep=0.1, movers_min=3)
    without = replace(config, sweep=0.0)
    kept = [
        [np.mean(p.annotation.association[p.annotation.body > 0] >= 0) for p in simulate_pairs(c, 12, 6, 3)]
        for c in (config, without)
    ]
    skewed, instant = (np.nanmean(of) for of in kept)
    assert skewed > instant - 0.15


# --- annotation ---------------------------------------------------------------------------------------------------------------


def test_slow_movers_are_left_out_of_the_annotation():
    config = SimulatorConfig(scene="indoor", range_max=10.0, dt=0.1, movers_min=3, movers_max=5)
    left_out = 0
    for every, some in zip(*(simulate_pairs(replace(config, least_travel=least), 12, 6, 5) for least in (0.0, 1.0)), strict=True):
        np.testing.assert_array_equal(every.source.ranges, some.source.ranges)
        ignored = some.annotation.ignore
        assert not every.annotation.ignore.any()
        assert (every.annotation.body[ignored] > 0).all()
        assert (some.annotation.body[ignored] == -1).all()
        assert len(every.annotation.motions) - len(some.annotation.motions) == len(set(every.annotation.body[ignored]))
        np.testing.assert_array_equal(every.annotation.association[~ignored], some.annotation.association[~ignored])
        left_out += int(ignored.sum())
    assert left_out > 20


def test_a_mixed_return_in_line_with_the_background_has_a_partner():
    config = replace(STILL, mixed_pixels=0.8)
    n_matched = 0
    for strict, lenient in zip(*(simulate_pairs(replace(config, matches_mixed=on), 4, 2, 6) for on in (False, True)), strict=True):
        np.testing.assert_array_equal(strict.source.ranges, lenient.source.ranges)
        mixed = strict.annotation.body == -1
        assert (strict.annotation.association[mixed] == -1).all()
        matched = mixed & (lenient.annotation.association >= 0)
        assert (lenient.annotation.cluster[matched] == 0).all()
        assert (lenient.annotation.body[mixed & ~matched] == -1).all()
        n_matched += int(matched.sum())
    assert n_matched > 5


# --- loose things -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("build", [world.street, world.indoor])
def test_litter_lies_beside_the_way(build):
    rng = np.random.default_rng(1)
    bare = build(rng, 0.0, 40.0, 1.0)
    full = world.littered(rng, bare, 0.0, 40.0, 3.0)
    n_segments, n_circles = len(bare.shapes.segments), len(bare.shapes.circles)
    np.testing.assert_array_equal(full.shapes.segments[:n_segments], bare.shapes.segments)
    circles = full.shapes.circles[n_circles:]
    assert len(circles) > 6
    near = bare.half_width if bare.is_street else 0.4 * bare.half_width  # a chair's legs reach a metre
    assert (np.abs(circles[:, 1]) > near - 1.1).all()
    assert circles[:, 2].min() >= 0.025


def test_legs_of_bystanders_are_a_pair_of_circles():
    legs = world._bystander(np.random.default_rng(2), 1.0, 2.0).circles
    np.testing.assert_allclose(legs[:, :2].mean(0), [1.0, 2.0])
    assert 0.1 < np.hypot(*(legs[0] - legs[1])[:2]) < 0.4
