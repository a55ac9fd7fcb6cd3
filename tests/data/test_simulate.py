from __future__ import annotations

from dataclasses import fields, replace
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from torchcrf_scan.data import annotate, laser, simulate, world
from torchcrf_scan.data.laser import cast
from torchcrf_scan.data.simulate import simulate_pairs
from torchcrf_scan.data.world import Mover, Shapes
from torchcrf_scan.data.worlds import NAMED_WORLDS, SimulatorConfig
from torchcrf_scan.geometry import se2
from torchcrf_scan.scan import ScanPair

MODEL_CARS = SimulatorConfig(beams=360, fov=360.0, range_max=8.0, scale=0.1, dt=0.24, movers_max=1, dropout=0.3)
INDOOR = SimulatorConfig(scene="indoor", range_max=30.0, movers_max=3)


@pytest.fixture(scope="module")
def drives() -> list[ScanPair]:
    """Three data sets of the default configuration."""
    return [pair for seed in (0, 1, 2) for pair in simulate_pairs(SimulatorConfig(), 31, 8, seed)]


def arrays(pair: ScanPair) -> list[np.ndarray]:
    a = pair.annotation
    scans = [getattr(scan, name) for scan in (pair.source, pair.target) for name in ("ranges", "bearings", "beam")]
    return [*scans, a.association, a.cluster, a.motions, a.body, a.ignore]


def check_annotation(pair: ScanPair, config: SimulatorConfig) -> None:
    """Everything that must hold of every pair."""
    a, source, target = pair.annotation, pair.source, pair.target
    n = source.n_beams
    assert n == len(source)
    assert [a.association.shape, a.cluster.shape, a.body.shape, a.ignore.shape] == [(n,)] * 4
    assert [a.association.dtype, a.cluster.dtype, a.body.dtype, a.motions.dtype] == [np.int64] * 3 + [np.float64]
    assert not a.ignore.any()
    has_partner = a.association >= 0
    np.testing.assert_array_equal(a.cluster == -1, ~has_partner)
    np.testing.assert_array_equal(a.cluster[has_partner], a.body[has_partner])
    assert (a.association >= -1).all()
    assert (a.association < target.n_beams).all()
    n_movers = len(a.motions) - 1
    assert n_movers <= config.movers_max
    assert np.isfinite(a.motions).all()
    assert (a.body < len(a.motions)).all()
    assert set(range(1, n_movers + 1)) <= set(a.body)  # every mover of the table is seen
    assert np.hypot(*a.motions[0, 1:]) <= config.ego_translation * config.scale + 1e-12
    assert abs(a.motions[0, 0]) <= config.ego_rotation + 1e-12
    for scan in (source, target):
        assert (scan.ranges > config.range_min).all()
        assert (scan.ranges < config.range_max).all()

    motion = a.motions[a.body[has_partner]]
    moved = se2.rotate(motion[:, 0], source.points[has_partner]) + motion[:, 1:]
    gap = np.hypot(*(moved - target.points[a.association[has_partner]]).T)
    _, step = laser.beam_bearings(config)
    if len(target):
        widest = target.ranges * step / laser.LEAST_COSINE
        assert (gap <= annotate.association_gate(widest, config) + 1e-12).all()


def test_same_seed_same_bytes():
    first, again, other = (simulate_pairs(SimulatorConfig(), 5, 2, seed) for seed in (3, 3, 4))
    for a, b in zip(first, again, strict=True):
        assert [x.tobytes() for x in arrays(a)] == [x.tobytes() for x in arrays(b)]
        assert (a.name, a.sequence) == (b.name, b.sequence)
    assert first[0].source.ranges.tobytes() != other[0].source.ranges.tobytes()


@pytest.mark.parametrize(
    ("name", "points", "moving", "metres"),
    [
        ("street", [292, 301, 304, 341, 354, 352], [21, 26, 26, 4, 6, 6], 56963.652007),
        ("model_cars_dominant", [230, 227, 239, 239, 225, 217], [12, 18, 23, 99, 96, 96], 2767.128094),
        ("crowd_768", [752, 749, 751, 748, 755, 746], [64, 57, 68, 3, 3, 35], 22749.813801),
    ],
)
def test_data_sets_stay_what_they_were(name: str, points: list[int], moving: list[int], metres: float) -> None:
    pairs = simulate_pairs(NAMED_WORLDS[name], 6, 2, 5)
    assert [len(pair.source) for pair in pairs] == points
    assert [np.count_nonzero(pair.annotation.cluster > 0) for pair in pairs] == moving
    assert sum(pair.source.ranges.sum() for pair in pairs) == pytest.approx(metres, abs=1e-3)


def test_names_and_sensor_limits():
    config = SimulatorConfig()
    pairs = simulate_pairs(config, 7, 3, 5)
    assert [pair.sequence for pair in pairs] == ["sim5_0"] * 3 + ["sim5_1"] * 2 + ["sim5_2"] * 2
    assert [pair.name for pair in pairs][:4] == ["sim_s0_000", "sim_s0_001", "sim_s0_002", "sim_s1_000"]
    for pair in pairs:
        assert (pair.dt, pair.origin) == (0.2, "torchcrf_scan simulator")
        assert (pair.source.range_min, pair.source.range_max, pair.source.range_noise) == (0.1, 80.0, 0.015)


def test_pairs_of_a_drive_follow_each_other(drives):
    shared = [(a, b) for a, b in pairwise(drives) if a.sequence == b.sequence]
    assert len(shared) == 3 * (31 - 8)
    assert all(a.target is b.source for a, b in shared)


def test_statistics_of_a_street(drives):
    cluster = [pair.annotation.cluster for pair in drives]
    n_static, n_moving = (sum(int(np.count_nonzero(is_in(c))) for c in cluster) for is_in in (lambda c: c == 0, lambda c: c > 0))
    assert 270 < np.mean([len(c) for c in cluster]) < 335
    assert 0.06 < n_moving / n_static < 0.25
    assert 0.07 < np.mean([np.mean(c < 0) for c in cluster]) < 0.18
    n_movers = [len(pair.annotation.motions) - 1 for pair in drives]
    assert 1.5 < np.mean(n_movers) < 3.5
    travel = [np.hypot(*pair.annotation.motions[0, 1:]) for pair in drives]
    assert max(travel) > 1.0
    assert max(abs(pair.annotation.motions[0, 0]) for pair in drives) > 0.05


def test_annotation_of_a_street(drives):
    for pair in drives:
        check_annotation(pair, SimulatorConfig())


def test_movers_move_relative_to_the_world(drives):
    for pair in drives:
        background, *movers = pair.annotation.motions
        for k, motion in enumerate(movers, 1):
            points = pair.source.points[pair.annotation.body == k]
            shift = np.hypot(*(se2.apply(motion, points) - se2.apply(background, points)).T)
            assert shift.max() > 0.5 * annotate.LEAST_MOTION
            assert shift.max() < 16.5 * 0.2 + 0.5  # no car is faster than 15 m/s; far points also turn


def test_without_noise_static_partners_lie_on_the_same_surface():
    config = SimulatorConfig(range_noise=0.0, vibration=0.0, dropout=0.0, mixed_pixels=0.0, clutter=0.0, movers_min=0, movers_max=0)
    for pair in simulate_pairs(config, 6, 6, 0):
        check_annotation(pair, config)
        assert (pair.annotation.body == 0).all()
        assert np.mean(pair.annotation.association >= 0) > 0.6


@pytest.mark.parametrize("config", [MODEL_CARS, INDOOR, replace(INDOOR, fov=360.0, beams=180), replace(MODEL_CARS, fov=270.0)])
def test_other_worlds_and_sensors(config):
    pairs = simulate_pairs(config, 8, 4, 0)
    for pair in pairs:
        check_annotation(pair, config)
        assert np.abs(pair.source.bearings).max() <= np.radians(config.fov) / 2 + 1e-12
    assert any(pair.source.is_closed for pair in pairs) == (config.fov == 360)  # a drive with nothing behind it is not
    assert np.mean([len(pair.source) for pair in pairs]) > 0.4 * config.beams
    assert np.mean([len(pair.annotation.motions) for pair in pairs]) > 1.5


def test_robots_are_slow():
    travel = [np.hypot(*pair.annotation.motions[0, 1:]) for pair in simulate_pairs(INDOOR, 8, 8, 1)]
    assert 0 < max(travel) <= 1.5 * INDOOR.dt


@pytest.mark.parametrize("config", [SimulatorConfig(), INDOOR])
def test_the_sensor_stays_on_its_way(config):
    for seed in range(20):
        rng = np.random.default_rng(seed)
        built = (world.street if config.scene == "street" else world.indoor)(rng, -20.0, 60.0, 1.0)
        path = simulate._ego_path(config, built, 20, False, rng)
        assert np.abs(path[:, 2]).max() < built.half_width


def test_scale_shrinks_world_and_motions_alike():
    quiet = SimulatorConfig(range_noise=0.0, vibration=0.0, range_min=0.0, movers_min=0, movers_max=0)
    small = replace(quiet, scale=0.1, range_max=8.0)
    for a, b in zip(simulate_pairs(quiet, 4, 2, 0), simulate_pairs(small, 4, 2, 0), strict=True):
        np.testing.assert_allclose(b.annotation.motions[0], a.annotation.motions[0] * [1, 0.1, 0.1], atol=1e-12)
        _, mine, theirs = np.intersect1d(a.source.bearings, b.source.bearings, return_indices=True)
        assert len(mine) > 0.98 * len(a.source)
        np.testing.assert_allclose(b.source.ranges[theirs], 0.1 * a.source.ranges[mine])


def test_dominant_mover_fills_nearly_half_of_the_scan():
    pairs = simulate_pairs(SimulatorConfig(dominant_mover=1.0), 8, 8, 0)
    share = [max(np.mean(pair.annotation.body == k) for k in range(1, len(pair.annotation.motions))) for pair in pairs]
    assert 0.4 <= np.median(share) <= 0.5
    assert np.quantile(share, 0.2) > 0.3
    assert max(share) < 0.6


def test_aperture_shows_one_side_that_slides_along_itself():
    n_sliding = 0
    for pair in simulate_pairs(SimulatorConfig(aperture=1.0), 8, 8, 0):
        a = pair.annotation
        points = [pair.source.points[a.body == k] for k in range(1, len(a.motions))]
        side = max(points, key=len)
        _, thickness, axes = np.linalg.svd(side - side.mean(0), full_matrices=False)
        motion = a.motions[1 + [p is side for p in points].index(True)]
        slide = se2.apply(se2.compose(se2.inverse(a.motions[0]), motion), side) - side  # as seen by someone standing still
        n_sliding += len(side) > 30 and thickness[1] / np.sqrt(len(side)) < 0.04 and np.abs(slide @ axes[1]).max() < 0.15
    assert n_sliding >= 6


def test_somebody_passes_near_a_standing_sensor():
    pairs = simulate_pairs(NAMED_WORLDS["passed_512"], 12, 12, 0)
    assert all((pair.annotation.motions[0] == 0).all() for pair in pairs)
    near = [np.hypot(*pair.source.points[pair.annotation.body > 0].T).min(initial=np.inf) for pair in pairs]
    assert np.median(near) < 1.2
    assert min(near) > 0.3


def test_what_stands_still_is_static():
    config = SimulatorConfig(dt=0.001, movers_min=4)  # 15 m/s is 1.5 cm in a millisecond
    for pair in simulate_pairs(config, 4, 4, 0):
        assert pair.annotation.motions.shape == (1, 3)
        assert set(pair.annotation.body) <= {-1, 0}


def test_swinging_legs_leave_the_rigid_motion():
    pairs = simulate_pairs(replace(INDOOR, movers_min=3, fov=360.0), 12, 6, 2)
    of_movers = np.concatenate([pair.annotation.cluster[pair.annotation.body > 0] for pair in pairs])
    assert 0.005 < np.mean(of_movers == -1) < 0.7  # the gate covers most of a swing, not all of it


def test_counts_of_movers():
    none = simulate_pairs(SimulatorConfig(movers_min=0, movers_max=0, dominant_mover=1.0), 4, 2, 0)
    assert all(len(pair.annotation.motions) == 1 for pair in none)
    crowd = SimulatorConfig(movers_min=30, movers_max=30)
    pairs = simulate_pairs(crowd, 2, 1, 0)
    for pair in pairs:
        check_annotation(pair, crowd)
    assert max(len(pair.annotation.motions) for pair in pairs) > 8


def test_one_beam_and_a_blind_sensor():
    one = SimulatorConfig(beams=1)
    for pair in simulate_pairs(one, 3, 1, 0):
        check_annotation(pair, one)
        assert set(pair.source.bearings) <= {0.0}
    blind = SimulatorConfig(dropout=1.0)
    for pair in simulate_pairs(blind, 2, 1, 0):
        check_annotation(pair, blind)
        assert len(pair.source) == len(pair.target) == 0


@settings(max_examples=20, deadline=None, derandomize=True)
@given(
    config=st.builds(
        SimulatorConfig,
        scene=st.sampled_from(["street", "indoor"]),
        beams=st.integers(1, 90),
        fov=st.floats(1.0, 360.0) | st.just(360.0),
        range_max=st.floats(0.2, 100.0),
        range_noise=st.floats(0.0, 0.1),
        dropout=st.floats(0.0, 1.0),
        mixed_pixels=st.floats(0.0, 1.0),
        vibration=st.floats(0.0, 0.05),
        dt=st.floats(0.01, 1.0),
        ego_translation=st.floats(0.0, 4.0),
        ego_rotation=st.floats(0.0, 0.5),
        movers_min=st.integers(0, 2),
        movers_max=st.integers(2, 4),
        clutter=st.floats(0.0, 3.0),
        dominant_mover=st.sampled_from([0.0, 1.0]),
        aperture=st.sampled_from([0.0, 1.0]),
        scale=st.floats(0.05, 2.0),
    ),
    seed=st.integers(0, 1000),
)
def test_every_configuration_gives_valid_pairs(config, seed):
    for pair in simulate_pairs(config, 2, 1, seed):
        check_annotation(pair, config)


def test_rays_meet_walls_posts_and_leaves():
    bearings = np.radians([-60.0, -30.0, 0.0, 30.0, 60.0, 180.0])
    wall = np.array([[5.0, -5.0, 5.0, 5.0]])
    post = np.array([[3.0, 0.0, 0.5, 0.0], [2.0 * np.cos(np.pi / 3), 2.0 * np.sin(np.pi / 3), 0.25, 0.3]])
    rng = np.random.default_rng(0)
    hits = cast(Shapes(wall, post), bearings, 7, rng)
    np.testing.assert_allclose(hits.ranges[[1, 2, 3]], [5 / np.cos(np.pi / 6), 2.5, 5 / np.cos(np.pi / 6)])
    np.testing.assert_allclose(hits.cosine[[1, 2, 3]], [np.cos(np.pi / 6), 1.0, np.cos(np.pi / 6)])
    assert np.isinf(hits.ranges[[0, 5]]).all()
    assert (hits.body == 7).all()
    in_leaves = np.array([cast(Shapes.of((), [post[1:]]), bearings[4:5], 0, rng).ranges[0] for _ in range(200)])
    stopped = np.isfinite(in_leaves)
    assert 0.6 < stopped.mean() < 0.95  # 1 - exp(-0.5 / 0.3) = 0.81
    assert in_leaves[stopped].min() >= 1.75
    assert in_leaves[stopped].max() <= 2.25
    assert np.isinf(cast(Shapes.of(), bearings, 0, rng).ranges).all()


def test_a_mover_drives_an_arc():
    circle = 2 * np.pi * 10.0  # metres around, at 10 m/s and 1 rad/s
    mover = Mover(1, 1.0, np.array([0.0, 0.0, 0.0]), Shapes.of([world.box(4.0, 2.0)]), 10.0, 1.0)
    np.testing.assert_allclose(mover.pose(1.0 + np.pi / 2), [np.pi / 2, 10.0, 10.0], atol=1e-12)
    np.testing.assert_allclose(mover.pose(1.0 + circle / 10.0), [0.0, 0.0, 0.0], atol=1e-9)
    np.testing.assert_allclose(mover.half_size, [2.0, 1.0])


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("scene", "forest"),
        ("beams", 0),
        ("fov", 0.0),
        ("fov", 361.0),
        ("range_min", -1.0),
        ("range_max", 0.05),
        ("range_max", float("inf")),
        ("range_noise", float("nan")),
        ("dropout", 1.5),
        ("mixed_pixels", -0.1),
        ("dt", 0.0),
        ("ego_translation", -1.0),
        ("ego_rotation", 4.0),
        ("movers_min", -1),
        ("movers_max", 0),
        ("vibration", -0.1),
        ("clutter", float("inf")),
        ("dominant_mover", 2.0),
        ("aperture", -1.0),
        ("scale", 0.0),
    ],
)
def test_values_that_make_no_sense_are_refused(name, value):
    assert name in {f.name for f in fields(SimulatorConfig)}
    with pytest.raises(ValueError, match=rf"^{name}: expected .*, got "):
        SimulatorConfig(**{name: value})


@pytest.mark.parametrize(
    ("name", "arguments"), [("pairs", (0, 1, 0)), ("sequences", (3, 4, 0)), ("sequences", (3, 0, 0)), ("seed", (3, 1, -1))]
)
def test_arguments_that_make_no_sense_are_refused(name, arguments):
    with pytest.raises(ValueError, match=rf"^{name}: expected .*, got "):
        simulate_pairs(SimulatorConfig(), *arguments)
