"""Simulated drives: objects that persist, and a truth that agrees with the scans."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from torchcrf_scan.data.drive import Drive, simulate_drive
from torchcrf_scan.data.worlds import NAMED_WORLDS, SimulatorConfig, every
from torchcrf_scan.geometry import se2

STREET = replace(every(NAMED_WORLDS["street"], 0.1), beams=181, movers_min=3, movers_max=4)
CARS = every(NAMED_WORLDS["cars_360"], 0.1)


@pytest.fixture(scope="module")
def street() -> Drive:
    return simulate_drive(STREET, 100, 3)


@pytest.fixture(scope="module")
def cars() -> Drive:
    return simulate_drive(CARS, 40, 1)


def test_a_hundred_scans_at_ten_hertz(street: Drive) -> None:
    assert len(street) == len(street[:]) == 100
    np.testing.assert_allclose(np.diff(street.stamps), 0.1)
    np.testing.assert_allclose(street.poses[0], 0, atol=1e-12)
    travel = np.hypot(*np.diff(street.poses[:, 1:], axis=0).T)
    assert travel.max() <= 0.1 * 10 + 1e-9
    assert [reading.stamp for reading in street.readings()] == street.stamps.tolist()


def test_objects_come_and_go_and_persist(street: Drive) -> None:
    numbers = [{of.number for of in scan.objects} for scan in street]
    lives = {number: [i for i, known in enumerate(numbers) if number in known] for number in set.union(*numbers)}
    assert all(life == list(range(life[0], life[-1] + 1)) for life in lives.values())
    assert any(life[0] > 0 for life in lives.values())
    assert any(life[-1] < 99 for life in lives.values())
    assert np.median([len(life) for life in lives.values()]) >= 20
    hidden = [of for scan in street for of in scan.objects if of.points == 0]
    assert hidden


@pytest.mark.parametrize("name", ["street", "cars"])
def test_points_lie_on_their_objects(name: str, request: pytest.FixtureRequest) -> None:
    drive = request.getfixturevalue(name)
    checked = 0
    for scan in drive:
        body = scan.body[scan.scan.beam]
        world = se2.apply(scan.pose, scan.scan.points)
        for of in scan.objects:
            assert of.points == np.count_nonzero(body == of.number)
            local = se2.rotate(np.asarray(-of.heading), world[body == of.number] - of.position)
            slack = 0.1 + 0.6 * drive.sweep * 2.0  # noise, and how far anything moves from the middle of the sweep
            assert (np.abs(local) <= np.array(of.extent) / 2 + slack).all()
            checked += len(local)
        assert np.count_nonzero(scan.moving) == sum(of.points for of in scan.objects)
    assert checked > 100


@pytest.mark.parametrize("name", ["street", "cars"])
def test_velocities_are_those_of_the_positions(name: str, request: pytest.FixtureRequest) -> None:
    for before, after in pairwise(request.getfixturevalue(name)):
        known = {of.number: of for of in before.objects}
        for of in after.objects:
            if of.number in known:
                step = (of.position - known[of.number].position) / (after.stamp - before.stamp)
                mean = (of.velocity + known[of.number].velocity) / 2
                np.testing.assert_allclose(step, mean, atol=0.01 + 0.01 * np.hypot(*mean))


def test_a_sweep_begins_before_its_stamp(cars: Drive) -> None:
    assert cars.sweep == 0.08
    np.testing.assert_allclose([reading.stamp for reading in cars.readings()], cars.stamps - 0.04)


def test_same_seed_same_bytes() -> None:
    first, again, other = (simulate_drive(STREET, 4, seed) for seed in (1, 1, 2))
    assert [of.scan.ranges.tobytes() for of in first] == [of.scan.ranges.tobytes() for of in again]
    assert first[0].scan.ranges.tobytes() != other[0].scan.ranges.tobytes()


def test_the_same_world_at_another_rate() -> None:
    fast = every(SimulatorConfig(dt=0.4, ego_translation=2.0, ego_rotation=0.2, sweep=0.2), 0.1)
    assert (fast.dt, fast.ego_translation, fast.ego_rotation, fast.sweep) == (0.1, 0.5, 0.05, 0.1)


@pytest.mark.parametrize(("scans", "seed", "message"), [(1, 0, "scans: expected at least 2, got 1"), (2, -1, "seed: .* got -1")])
def test_wrong_arguments_are_named(scans: int, seed: int, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        simulate_drive(STREET, scans, seed)
