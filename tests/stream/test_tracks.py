"""Objects keep their numbers through crossings and occlusions, and what is said of them is as certain as it states."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from moving_boxes import Body, nothing, sight, turned
from scipy.stats import chi2

from torchcrf_scan.stream.filter import chi_square
from torchcrf_scan.stream.track import Sighting, TrackerConfig
from torchcrf_scan.stream.tracks import Tracker

DT = 0.1


def drive(bodies: list[Body], scans: int, rng: np.random.Generator, hidden: range = range(0), **options) -> tuple[list, list]:
    """Numbers by scan and body (0: not seen), and objects by scan."""
    tracker, numbers, objects = Tracker(), [], []
    for i in range(scans):
        scan = nothing() if i in hidden else sight(bodies, DT * i, rng, **options)
        found, known = tracker.update(DT * i, **scan)
        numbers.append([*found.tolist(), *[0] * (len(bodies) - len(found))])
        objects.append(known)
    return numbers, objects


def test_a_car_that_passes_has_one_number_and_its_own_velocity_heading_and_extent() -> None:
    car = Body((-12.0, 3.0), (8.0, 0.0))
    numbers, objects = drive([car], 40, np.random.default_rng(0))
    assert {row[0] for row in numbers} == {1}
    for i, known in enumerate(objects[10:], 10):
        assert len(known) == 1
        np.testing.assert_allclose(known[0].velocity, car.velocity, atol=0.3)
        assert abs(known[0].heading) < 0.05
        assert known[0].age == pytest.approx(DT * i)
        assert known[0].points > 0
    np.testing.assert_allclose(objects[-1][0].extent, car.size, atol=0.25)
    np.testing.assert_allclose(objects[-1][0].position, car.centre(3.9), atol=0.3)


def test_the_centre_does_not_jump_when_another_side_is_seen() -> None:
    car = Body((-12.0, 3.0), (8.0, 0.0))
    _, objects = drive([car], 36, np.random.default_rng(0))
    errors = np.array([known[0].position - car.centre(DT * i) for i, known in enumerate(objects)])
    assert np.abs(np.diff(errors, axis=0)).max() < 0.3  # its points' centroid jumps from the front to the rear, 4 m
    assert np.abs(errors[20:]).max() < 0.3


def test_two_that_cross_keep_their_numbers() -> None:
    walkers = [Body((-3.0, 4.0), (1.5, 0.0), (0.4, 0.4)), Body((0.0, 7.0), (0.0, -1.4), (0.4, 0.4))]
    numbers, objects = drive(walkers, 45, np.random.default_rng(1))
    assert all(row[0] in (0, 1) and row[1] in (0, 2) for row in numbers)
    assert [of.number for of in objects[-1]] == [1, 2]


def test_two_that_meet_and_pass_each_other_keep_their_numbers() -> None:
    walkers = [Body((-3.0, 4.0), (1.5, 0.0), (0.4, 0.4)), Body((3.0, 4.5), (-1.5, 0.0), (0.4, 0.4))]
    numbers, _ = drive(walkers, 40, np.random.default_rng(2))
    assert all(row[0] in (0, 1) and row[1] in (0, 2) for row in numbers)


def test_an_object_hidden_for_some_scans_is_predicted_and_found_again() -> None:
    car = Body((-8.0, 5.0), (5.0, 1.0))
    numbers, objects = drive([car], 30, np.random.default_rng(3), range(12, 18))
    assert [row[0] for row in numbers] == [0 if i in range(12, 18) else 1 for i in range(30)]
    hidden, before = objects[15][0], objects[11][0]
    assert (hidden.number, hidden.points) == (1, 0)
    np.testing.assert_allclose(hidden.position, car.centre(1.5), atol=0.5)
    assert np.linalg.det(hidden.covariance) > np.linalg.det(before.covariance)


def test_an_object_that_is_gone_is_given_up_and_its_number_never_given_again() -> None:
    car = Body((-8.0, 5.0), (5.0, 1.0))
    numbers, objects = drive([car], 40, np.random.default_rng(3), range(5, 24))
    assert objects[23] == ()
    assert {row[0] for row in numbers[24:]} == {2}


def test_a_guess_becomes_an_object_when_it_is_seen_again() -> None:
    walker = [Body((-3.0, 4.0), (0.8, 0.0), (0.3, 0.3))]
    numbers, objects = drive(walker, 4, np.random.default_rng(0), speed_noise=0.3)
    assert [len(known) for known in objects] == [0, 1, 1, 1]
    assert [row[0] for row in numbers] == [1, 1, 1, 1]
    numbers, objects = drive(walker, 12, np.random.default_rng(0), range(1, 11), speed_noise=0.3)
    assert objects == [()] * 12
    assert numbers[-1] == [2]


def test_an_object_seen_well_counts_at_once() -> None:
    _, objects = drive([Body((-6.0, 3.0), (6.0, 0.0))], 1, np.random.default_rng(0))
    assert len(objects[0]) == 1


def test_an_object_in_two_pieces_has_one_number() -> None:
    car, tracker, rng = Body((-8.0, 3.0), (6.0, 0.0)), Tracker(), np.random.default_rng(0)
    for i in range(15):
        scan = sight([car], DT * i, rng)
        if i >= 10:
            ahead = scan["points"][:, 0] > car.centre(DT * i)[0]
            scan["cluster"] = np.where(ahead, 2, 1)
            scan |= {name: np.repeat(scan[name], 2, axis=0) for name in ("velocities", "covariances")}
        numbers, objects = tracker.update(DT * i, **scan)
        assert set(numbers) == {1}
        assert len(objects) == 1
        assert objects[0].points == len(scan["points"])


def test_points_that_lie_apart_from_the_rest_of_a_cluster_belong_to_no_extent() -> None:
    car, tracker, rng = Body((-8.0, 3.0), (6.0, 0.0)), Tracker(), np.random.default_rng(0)
    for i in range(15):
        scan = sight([car], DT * i, rng)
        stray = np.array([[5.0, -20.0], [30.0, 4.0]])
        scan |= {"points": np.concatenate([scan["points"], stray]), "cluster": np.append(scan["cluster"], [1, 1])}
        numbers, objects = tracker.update(DT * i, **scan)
        assert numbers.tolist() == [1]
        assert [of.number for of in objects] == [1]
        assert (np.array(objects[0].extent) < [4.6, 2.4]).all()


def test_two_objects_in_one_cluster_keep_their_numbers() -> None:
    pair = [Body((-6.0, 3.0), (3.0, 0.0), (0.5, 0.5)), Body((-8.0, 3.0), (3.0, 0.0), (0.5, 0.5))]
    tracker, rng = Tracker(), np.random.default_rng(0)
    for i in range(12):
        scan = sight(pair, DT * i, rng)
        if i >= 6:
            scan |= {"cluster": np.minimum(scan["cluster"], 1), "velocities": scan["velocities"][:1]}
            scan |= {"covariances": scan["covariances"][:1]}
        _, objects = tracker.update(DT * i, **scan)
    assert [of.number for of in objects] == [1, 2]
    for of, body in zip(objects, pair, strict=True):
        np.testing.assert_allclose(of.position, body.centre(1.1), atol=0.2)
        assert of.points > 0


def test_two_legs_are_one_object_however_they_are_clustered() -> None:
    legs = [Body((-3.0, 4.0), (1.2, 0.0), (0.15, 0.12)), Body((-3.0, 4.25), (1.2, 0.0), (0.15, 0.12))]
    tracker, rng = Tracker(), np.random.default_rng(0)
    for i in range(20):
        scan = sight(legs, DT * i, rng)
        swing = 0.5 * np.sin(2 * i)
        scan["velocities"] += np.array([[swing, 0.0], [-swing, 0.0]])
        if i % 3 == 1:
            scan["cluster"] = np.where(scan["cluster"] == 2, 0, scan["cluster"])
        numbers, objects = tracker.update(DT * i, **scan)
        assert set(numbers) <= {0, 1}
        assert [of.number for of in objects] in ([], [1])
    np.testing.assert_allclose(objects[0].velocity, [1.2, 0.0], atol=0.5)


def test_two_who_meet_are_two() -> None:
    pair = [Body((-1.0, 4.0), (1.0, 0.0), (0.15, 0.15)), Body((1.0, 4.4), (-1.0, 0.0), (0.15, 0.15))]
    numbers, objects = drive(pair, 20, np.random.default_rng(0))
    assert all(row[0] in (0, 1) and row[1] in (0, 2) for row in numbers)
    assert [of.number for of in objects[-1]] == [1, 2]


def test_errors_have_the_covariance_that_is_stated() -> None:
    nees = []
    for seed in range(12):
        rng = np.random.default_rng(seed)
        course = rng.uniform(-0.3, 0.3)
        body = Body((-6.0, rng.uniform(3, 5)), (2.5 * np.cos(course), 2.5 * np.sin(course)), (0.5, 0.5))
        _, objects = drive([body], 25, rng)
        for i, known in enumerate(objects[12:], 12):
            error = np.concatenate([known[0].position - body.centre(DT * i), known[0].velocity - body.velocity])
            nees.append(chi_square(error, known[0].covariance))
    assert 0.3 * 4 < np.mean(nees) < 2 * 4  # bodies do not accelerate and partial views are correlated: not exactly 4
    assert np.mean(np.array(nees) < chi2.ppf(0.95, 4)) > 0.9


def test_a_velocity_that_is_not_observed_follows_from_positions() -> None:
    body, rng, tracker = Body((-4.0, 3.0), (2.0, 0.5), (0.4, 0.4)), np.random.default_rng(0), Tracker()
    for i in range(20):
        scan = sight([body], DT * i, rng)
        numbers, objects = tracker.update(DT * i, **scan | {"velocities": np.full((1, 2), np.nan)})
        assert numbers.tolist() == [1]
    np.testing.assert_allclose(objects[0].velocity, body.velocity, atol=0.4)


def test_what_slides_along_itself_is_steered_by_its_ends() -> None:
    body, rng, tracker = Body((-4.0, 3.0), (2.0, 0.0)), np.random.default_rng(0), Tracker()
    unseen = np.diag([400.0, 0.01])[None]  # a side seen from beside tells nothing of the motion along it
    for i in range(12):
        scan = sight([body], DT * i, rng) | {"covariances": unseen}
        _, loose = tracker.update(DT * i, **scan)
    assert loose[0].covariance[2, 2] > 0.1
    tracker = Tracker()
    for i in range(12):
        _, objects = tracker.update(DT * i, **sight([body], DT * i, rng) | {"covariances": unseen}, since=0.15)
    assert objects[0].covariance[2, 2] < loose[0].covariance[2, 2]
    assert abs(objects[0].heading) < 0.2


def test_the_velocity_of_a_thing_that_turns_is_that_of_its_centre() -> None:
    half = np.linspace(-2, 2, 21)
    side = np.stack([half, np.full(21, -1.0)], axis=1)  # the right side of a car, 2 m wide
    front = np.stack([np.full(11, 2.0), np.linspace(-1, 1, 11)], axis=1)
    arguments = {"cluster": np.ones(32, dtype=np.int64), "covariances": 0.01 * np.eye(2)[None]}
    points = np.concatenate([side, front])
    arm = points.mean(0)
    spun = np.array([3.0, 0.0]) + 0.5 * np.array([-arm[1], arm[0]])  # of the middle of the points, as it turns by 0.5 rad/s
    found = []
    for turns in (np.array([0.5]), np.array([np.nan]), None):
        tracker = Tracker()
        for i in range(8):
            at = points + np.array([0.3 * i, 0.0])
            _, objects = tracker.update(DT * i, at, velocities=spun[None], turns=turns, **arguments)
        found.append(objects[0].velocity)
    assert np.hypot(*(found[0] - [3.0, 0.0])) < 0.1
    assert np.hypot(*(found[1] - [3.0, 0.0])) > 0.2
    np.testing.assert_array_equal(found[1], found[2])


def test_one_wrong_velocity_neither_ends_nor_turns_a_track() -> None:
    body, rng, tracker = Body((-4.0, 3.0), (2.0, 0.0)), np.random.default_rng(0), Tracker()
    for i in range(20):
        scan = sight([body], DT * i, rng)
        if i == 15:
            scan["velocities"] = np.array([[-6.0, 5.0]])
        numbers, objects = tracker.update(DT * i, **scan)
        assert numbers.tolist() == [1]
        np.testing.assert_allclose(objects[0].velocity, body.velocity, atol=0.5)


@given(st.floats(-3, 3), st.floats(-50, 50), st.floats(-50, 50))
def test_the_world_may_lie_anywhere(theta: float, x: float, y: float) -> None:
    motion, here, there = np.array([theta, x, y]), Tracker(), Tracker()
    bodies = [Body((-3.0, 4.0), (1.5, 0.0)), Body((0.0, 9.0), (0.0, -1.4), (0.4, 0.4))]
    for i in range(6):
        scan = sight(bodies, DT * i, np.random.default_rng(i))
        ours, theirs = here.update(DT * i, **scan), there.update(DT * i, **turned(scan, motion))
        np.testing.assert_array_equal(ours[0], theirs[0])
    for a, b in zip(ours[1], theirs[1], strict=True):
        np.testing.assert_allclose(turned_point(motion, a.position), b.position, atol=1e-6)
        np.testing.assert_allclose(a.extent, b.extent, atol=1e-6)
        np.testing.assert_allclose(np.trace(a.covariance), np.trace(b.covariance))


def turned_point(motion: np.ndarray, point: np.ndarray) -> np.ndarray:
    c, s = np.cos(motion[0]), np.sin(motion[0])
    return np.array([[c, -s], [s, c]]) @ point + motion[1:]


@given(st.lists(st.tuples(st.floats(-2, 2), st.integers(0, 4), st.integers(0, 12)), max_size=12), st.integers(0, 2**16))
def test_whatever_comes_has_an_answer(scans: list[tuple[float, int, int]], seed: int) -> None:
    rng, tracker, stamp, given_away = np.random.default_rng(seed), Tracker(), 0.0, set()
    for step, movers, n in scans:
        stamp += step
        points, cluster = rng.normal(0, 5, (n, 2)), rng.integers(-1, movers + 1, n)
        covariances = rng.choice([0.0, 0.01, np.nan, 1e6], (movers, 1, 1)) * np.eye(2)
        before = {of.number for of in tracker.predict(stamp)}
        numbers, objects = tracker.update(stamp, points, cluster, rng.normal(0, 3, (movers, 2)), covariances)
        assert ((numbers > 0) == [(cluster == k).any() for k in range(1, movers + 1)]).all()
        fresh = {*numbers.tolist()} - before - {0}
        assert not fresh & given_away  # no number twice
        given_away |= fresh
        for of in objects:
            assert np.isfinite([*of.position, *of.velocity, of.heading, *of.extent]).all()
            assert (np.linalg.eigvalsh(of.covariance) >= -1e-12).all()
            assert of.age >= 0
        assert sum(of.points for of in objects) <= np.count_nonzero(cluster > 0)


def test_thirty_at_once_and_none() -> None:
    bearings = np.radians(12 * np.arange(30))
    around = np.stack([np.cos(bearings), np.sin(bearings)], axis=1)
    bodies = [Body(tuple(10 * at), tuple(2 * at), (0.5, 0.5)) for at in around]
    tracker, rng = Tracker(), np.random.default_rng(0)
    for i in range(5):
        numbers, objects = tracker.update(DT * i, **sight(bodies, DT * i, rng))
        np.testing.assert_array_equal(numbers, np.arange(1, 31))
    assert [of.number for of in objects] == list(range(1, 31))
    numbers, objects = tracker.update(0.5, **nothing())
    assert (numbers.tolist(), {of.points for of in objects}) == ([], {0})
    assert tracker.update(9.0, **nothing())[1] == ()


def test_memory_does_not_grow() -> None:
    tracker, rng = Tracker(), np.random.default_rng(0)
    for i in range(200):
        points = rng.uniform(-20, 20, (10, 2))
        tracker.update(DT * i, points, np.repeat([1, 2], 5), rng.normal(0, 5, (2, 2)), np.tile(0.01 * np.eye(2), (2, 1, 1)))
        assert len(tracker.predict(DT * i)) <= 2 * 16


def test_predictions_change_nothing_and_tell_how_far_the_points_have_moved() -> None:
    car, tracker, rng = Body((-8.0, 3.0), (6.0, 0.0)), Tracker(), np.random.default_rng(0)
    assert tracker.predict(0.0) == ()
    for i in range(10):
        tracker.update(DT * i, **(scan := sight([car], DT * i, rng)))
    ahead = tracker.predict(1.4)
    np.testing.assert_allclose(ahead[0].shift, [3.0, 0.0], atol=0.1)
    np.testing.assert_array_equal(ahead[0].points, scan["points"])
    assert ahead[0].is_confirmed
    again = tracker.predict(1.4)
    np.testing.assert_array_equal(ahead[0].covariance, again[0].covariance)
    np.testing.assert_array_equal(tracker.predict(0.9)[0].position, ahead[0].position - ahead[0].shift)


def test_stamps_that_stand_still_or_go_back() -> None:
    car, tracker, rng = Body((-8.0, 3.0), (6.0, 0.0)), Tracker(), np.random.default_rng(0)
    for i in range(10):
        tracker.update(DT * i, **sight([car], DT * i, rng))
    numbers, objects = tracker.update(0.9, **sight([car], 0.9, rng))
    assert (numbers.tolist(), len(objects)) == ([1], 1)
    numbers, _ = tracker.update(0.8, **sight([car], 1.0, rng))
    assert numbers.tolist() == [1]
    numbers, _ = tracker.update(-30.0, **sight([car], 1.0, rng))  # the log begins anew
    assert numbers.tolist() == [2]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"stamp": np.nan}, "stamp: expected finite seconds, got nan"),
        ({"points": np.zeros((3, 3))}, r"points: expected finite numbers \(N, 2\), got \(3, 3\)"),
        ({"points": np.full((2, 2), np.inf)}, "points: expected finite numbers"),
        ({"cluster": np.zeros(3, dtype=np.int64)}, r"cluster: expected one label per point \(2,\), got \(3,\)"),
        ({"cluster": np.array([0, 2])}, r"cluster: expected labels in \[-1, 1\], got 0 to 2"),
        ({"velocities": np.zeros(2)}, r"velocities: expected \(K, 2\), got \(2,\)"),
        ({"covariances": np.zeros((2, 2, 2))}, r"covariances: expected \(1, 2, 2\), got \(2, 2, 2\)"),
    ],
)
def test_wrong_arguments_are_named(change: dict, message: str) -> None:
    right = {"stamp": 0.0, "points": np.zeros((2, 2)), "cluster": np.array([0, 1]), "velocities": np.zeros((1, 2))}
    with pytest.raises(ValueError, match=message):
        Tracker().update(**right | {"covariances": np.zeros((1, 2, 2))} | change)


def test_turns_of_another_number_of_movers_are_refused() -> None:
    arguments = np.zeros((2, 2)), np.array([0, 1]), np.zeros((1, 2)), np.zeros((1, 2, 2))
    with pytest.raises(ValueError, match=r"turns: expected \(1,\), got \(2,\)"):
        Tracker().update(0.0, *arguments, turns=np.zeros(2))


def test_settings_that_contradict_each_other() -> None:
    with pytest.raises(ValueError, match="among: expected at least sightings = 2, got 1"):
        TrackerConfig(among=1)


def test_a_sighting_of_one_point_has_a_noise() -> None:
    lone = Sighting.of(np.zeros((1, 2)), np.zeros(2), np.eye(2), 0.0, 0.0, TrackerConfig())
    assert lone.noise > TrackerConfig().range_noise
