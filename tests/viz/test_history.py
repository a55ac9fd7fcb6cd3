"""What pictures remember stays bounded and keeps what matters."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from results import true_results

from torchcrf_scan.viz.camera import Camera, nice_step
from torchcrf_scan.viz.history import Path, StaticMap, Tally, TrackPaths


@given(st.integers(1, 300), st.sampled_from([2, 4, 10, 64]))
def test_a_path_keeps_its_ends_and_even_steps(count: int, limit: int) -> None:
    path = Path(1, limit)
    for k in range(count):
        path.add(float(k))
    kept = path.rows[:, 0]
    assert len(kept) <= limit + 1
    assert kept[0] == 0
    assert kept[-1] == count - 1
    assert len(kept) > min(count, limit) / 2
    assert len(set(np.diff(kept[:-1]).tolist())) <= 1


def test_a_map_holds_the_mean_of_what_was_seen_at_least_twice() -> None:
    places = StaticMap()
    places.add(np.array([[1.0, 1.0], [1.002, 1.0], [5.0, 5.0]]), 5.0)
    assert places._cell == 0.02
    np.testing.assert_allclose(places.points(), [[1.001, 1.0]])
    assert len(places.points(hits=1)) == 2


def test_a_map_that_is_full_becomes_coarser() -> None:
    places, rng = StaticMap(limit=500), np.random.default_rng(0)
    for _ in range(30):
        places.add(rng.uniform(-5, 5, (100, 2)), 5.0)
    assert places._cell > 0.1
    assert 50 < len(places.points(hits=1)) <= 500
    assert np.abs(places.points()).max() <= 5


def test_of_too_many_tracks_the_short_ones_are_forgotten() -> None:
    paths = TrackPaths(limit=4)
    for result in true_results(80):
        paths.add(result.stamp, result.objects)
    assert 2 <= len(paths.paths) <= 5


def test_results_are_counted() -> None:
    tally = Tally()
    for result in true_results(20):
        tally.add(result)
    assert tally.scans == 20
    assert tally.seconds == np.float64(19 * 0.2)
    assert tally.describe().startswith(f"20 scans, 3.8 s, {tally.metres:.1f} m travelled, {len(tally.objects)} moving object")
    assert tally.describe().endswith("ok 100.0 %")


def test_a_camera_follows_and_holds_what_it_follows() -> None:
    camera, points = Camera(4 / 3), np.random.default_rng(0).uniform(-8, 8, (200, 2))
    for k in range(200):
        sensor = np.array([0.2 * k, 0.0])
        camera.follow(points + sensor, sensor)
    low, high = camera.window
    assert ((points + sensor > low) & (points + sensor < high)).all(axis=1).mean() > 0.8
    assert (high - low)[0] / (high - low)[1] == np.float64(4 / 3)


@given(st.floats(1e-3, 1e4))
def test_steps_are_nice(length: float) -> None:
    step = nice_step(length)
    assert length / 2.6 < step <= length * (1 + 1e-6)
    assert f"{step:.0e}"[0] in "125"
