"""What scenes leave open, and how sure the answer is: corridors, facades, fences, empty, sparse and repeated scans."""

from collections.abc import Callable

import numpy as np
import pytest

from torchcrf_scan import JointScanCRF, PairPrediction, Scan, ScanPair
from torchcrf_scan.evaluation.calibration import normalised_error

Walls = list[tuple[float, float, float, float]]  # x1, y1, x2, y2
OPEN: dict[str, Walls] = {
    "corridor": [(-90, -1, 90, -1), (-90, 1, 90, 1)],
    "facades": [(-90, -5, 90, -5), (-90, 7, 90, 7)],
    "fence": [(-90, -3, 90, -3)],
}
SENSORS = {"ring of 12 m": (360, 360, 12.0), "half of 30 m": (361, 180, 30.0), "ring of 80 m": (720, 360, 80.0)}
ROOM: Walls = [(-4, -3, 6, -3), (6, -3, 6, 5), (6, 5, -4, 5), (-4, 5, -4, -3), (2, 1, 3, 2)]
NOISE = 0.01

Match = Callable[..., PairPrediction]


@pytest.fixture(scope="module")
def match() -> Match:
    return JointScanCRF.from_pretrained().match


def bearings_of(beams: int, field: float) -> np.ndarray:
    return np.radians(np.linspace(-field / 2, field / 2, beams, endpoint=field < 360))


def look(x: float, walls: Walls, bearings: np.ndarray, reach: float = 30.0, seed: int = 0) -> np.ndarray:
    """(beams,) noisy ranges from (x, 0), heading along x; inf where nothing is hit."""
    ranges = np.full(len(bearings), np.inf)
    for x1, y1, x2, y2 in walls:
        system = np.stack([np.stack([np.cos(bearings), np.sin(bearings)], -1), np.tile((x1 - x2, y1 - y2), (len(bearings), 1))], -1)
        system += 1e-12 * np.eye(2)
        distance, share = np.linalg.solve(system, np.tile((x1 - x, y1), (len(bearings), 1))[..., None])[..., 0].T
        ranges = np.where((distance > 0) & (share >= 0) & (share <= 1), np.minimum(ranges, distance), ranges)
    noise = NOISE * np.random.default_rng(seed).standard_normal(len(bearings))
    return np.where(ranges <= reach, ranges + noise, np.inf)


def pair_of(walls: Walls, travel: float, beams: int, field: float, reach: float, seed: int = 0) -> list[Scan]:
    bearings = bearings_of(beams, field)
    return [
        Scan.from_ranges(look(x, walls, bearings, reach, 2 * seed + k), bearings, range_max=reach)
        for k, x in enumerate((0, travel))
    ]


@pytest.mark.parametrize("sensor", SENSORS)
@pytest.mark.parametrize("scene", OPEN)
def test_the_way_along_walls_is_told_as_open(scene: str, sensor: str, match: Match) -> None:
    answer = match(*pair_of(OPEN[scene], 0.3, *SENSORS[sensor]))
    assert answer.covariances is not None
    assert answer.unobserved_shift is not None
    open_way, spread = answer.unobserved_shift[0], answer.covariances[0][1:, 1:]
    assert abs(open_way[0]) > 0.99
    assert np.sqrt(open_way @ spread @ open_way) > 3
    across = np.array([-open_way[1], open_way[0]])
    assert np.sqrt(across @ spread @ across) < 0.1  # the way itself is only known so well
    assert abs(answer.motions[0, 1]) < 0.1  # of motions that explain alike the smallest
    assert abs(answer.motions[0, 2]) < 0.02
    assert abs(answer.motions[0, 0]) < 0.005


@pytest.mark.parametrize("sensor", SENSORS)
@pytest.mark.parametrize("travel", [0.3, 1.0])
def test_along_a_corridor_the_given_motion_is_taken(travel: float, sensor: str, match: Match) -> None:
    answer = match(*pair_of(OPEN["corridor"], travel, *SENSORS[sensor]), initial_motion=np.array([0, -travel, 0]))
    assert abs(answer.motions[0, 1] + travel) < 0.03


def test_a_corridor_with_an_end_tells_the_way(match: Match) -> None:
    walls = [(-60.0, -1.0, 9.0, -1.0), (-60, 1, 9, 1), (9, -1, 9, 1)]
    answer = match(*pair_of(walls, 0.3, 361, 180, 30.0))
    assert answer.unobserved_shift is not None
    assert not answer.unobserved_shift[0].any()
    assert abs(answer.motions[0, 1] + 0.3) < 0.03


@pytest.mark.parametrize("which", ["both", "first", "second"])
def test_without_returns_nothing_is_known(which: str, match: Match) -> None:
    bearings = bearings_of(360, 360)
    nothing, room = np.full(360, np.inf), look(0.0, ROOM, bearings)
    ranges = (room if which == "second" else nothing), (room if which == "first" else nothing)
    answer = match(*[Scan.from_ranges(of, bearings, range_max=30.0) for of in ranges])
    assert answer.covariances is not None
    assert np.sqrt(np.linalg.eigvalsh(answer.covariances[0][1:, 1:]).min()) > 1


@pytest.mark.parametrize("beams", [16, 32, 64, 361])
def test_few_beams_are_no_surer_than_they_may_be(beams: int, match: Match) -> None:
    errors = []
    for seed in range(12):
        answer = match(*pair_of(ROOM, 0.1, beams, 360, 30.0, seed))
        assert answer.covariances is not None
        errors.append(normalised_error(answer.motions[0], np.array([0, -0.1, 0]), answer.covariances[0]))
    assert np.mean(errors) < 4.5


@pytest.mark.parametrize("times", [2, 3, 4])
def test_several_returns_a_beam_change_little(times: int, match: Match) -> None:
    bearings = np.radians(np.linspace(-90, 90, 61))
    ranges = [look(x, [(9, -3, 9, 4), (9, 4, -1, 4), (-1, -3, 9, -3)], bearings, seed=k) for k, x in enumerate((0, 0.3))]
    scans = [Scan.from_ranges(np.repeat(of, times), np.repeat(bearings, times)) for of in ranges]
    np.testing.assert_allclose(match(*scans).motions[0], (0, -0.3, 0), atol=0.03)


def test_a_plain_room_is_not_turned_round(match: Match) -> None:
    walls = [(-5.0, -3.0, 5.0, -3.0), (5, -3, 5, 3), (5, 3, -5, 3), (-5, 3, -5, -3)]
    for seed in range(6):
        answer = match(*pair_of(walls, 0.05, 360, 360, 30.0, seed))
        assert abs(answer.motions[0, 0]) < 0.01


def test_more_residual_than_noise_and_sampling_explain_widens_the_covariance(match: Match) -> None:
    """Scans bent by a slow wave, as by turning while they are swept: no wave of the sensor's noise."""
    bearings = bearings_of(360, 360)
    wave = 0.03 * np.sin(7 * bearings)
    ranges = [look(x, ROOM, bearings, seed=k) for k, x in enumerate((0, 0.1))]
    spread = []
    for bend in (0 * wave, wave):
        scans = [Scan.from_ranges(of + k * bend, bearings, range_max=30.0, range_noise=NOISE) for k, of in enumerate(ranges)]
        answer = JointScanCRF.from_pretrained().match_pairs([ScanPair(*scans)])[0]
        assert answer.covariances is not None
        spread.append(np.sqrt(np.diag(answer.covariances[0])))
    assert (spread[1] > 2 * spread[0]).all()
