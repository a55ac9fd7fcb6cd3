"""Both engines give the same labels where scenes are extreme: circles, repeated points, thirty movers, few points."""

from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import torch

from torchcrf_scan import JointScanCRF, Scan, ScanPair, ScanPairBatch
from torchcrf_scan.data.simulate import simulate_pairs
from torchcrf_scan.data.worlds import NAMED_WORLDS
from torchcrf_scan.scan import Floats

TURN, HALF = np.radians(np.arange(-180.0, 180.0, 2.0)), np.radians(np.arange(-90.0, 90.1, 1.0))


@cache
def model(backend: str) -> JointScanCRF:
    return JointScanCRF.from_pretrained(backend=backend).double().requires_grad_(False)


def of_points(points: Floats) -> Scan:
    """A scan that sees points (P, 2), whatever lies in front of them."""
    bearings = np.arctan2(points[:, 1], points[:, 0])
    order = np.argsort(bearings, kind="stable")
    return Scan.from_ranges(np.hypot(*points.T)[order], bearings[order])


def circles(rng: np.random.Generator) -> Iterator[ScanPair]:
    for noise in (0.0, 1e-6, 0.01):
        scans = [Scan.from_ranges(5.0 + noise * rng.normal(size=len(TURN)), TURN) for _ in range(2)]
        yield ScanPair(*scans)


def few_points(rng: np.random.Generator) -> Iterator[ScanPair]:
    for count in (1, 2, 3, 4):
        for noise in (0.0, 0.01, 0.3):
            points = rng.uniform(1, 5, (count, 2))
            yield ScanPair(of_points(points), of_points(points + rng.normal(0, noise, (count, 2))))


def repeated_points(rng: np.random.Generator) -> Iterator[ScanPair]:
    """Two or three returns on each bearing: the usual turn to the next return is 0."""
    for count in (3, 10, 40):
        for times in (2, 3):
            points = np.repeat(rng.uniform(1, 6, (count, 2)), times, axis=0)
            yield ScanPair(of_points(points), of_points(points + np.array([0.1, 0.0])))


def thirty_movers(rng: np.random.Generator) -> Iterator[ScanPair]:
    """Before a round wall that is exactly the same in both scans: beams lie on beams, up to rounding."""
    for noise in (0.0, 0.0, 0.0, 0.01):
        ranges = np.full((2, len(HALF)), 20.0)
        for first in range(4, 154, 5):
            width, place = rng.integers(1, 4), rng.uniform(3, 15)
            ranges[0, first : first + width] = place
            ranges[1, first + rng.integers(-2, 3) :][:width] = place + rng.uniform(-0.6, 0.6)
        yield ScanPair(*(Scan.from_ranges(of + noise * rng.normal(size=len(HALF)), HALF) for of in ranges))


def straight_walls(rng: np.random.Generator) -> Iterator[ScanPair]:
    x = np.linspace(-8.0, 8.0, 90)
    for shift in rng.uniform(-1, 1, 3):
        yield ScanPair(*(of_points(np.stack([x + by, np.full(90, 3.0)], 1)) for by in (0.0, shift)))


def whole_numbers(rng: np.random.Generator) -> Iterator[ScanPair]:
    for shift in range(3):
        ranges = np.round(rng.uniform(1, 8, len(HALF)))
        yield ScanPair(Scan.from_ranges(ranges, HALF), Scan.from_ranges(np.roll(ranges, shift), HALF))


def other_scales(rng: np.random.Generator) -> Iterator[ScanPair]:
    for factor in (1e-3, 1e3):
        for pair in simulate_pairs(replace(NAMED_WORLDS["street"], beams=91), 2, 2, 9):
            yield ScanPair(*(Scan.from_ranges(of.ranges * factor, of.bearings) for of in (pair.source, pair.target)))


@pytest.mark.parametrize(
    "scenes", [circles, few_points, repeated_points, thirty_movers, straight_walls, whole_numbers, other_scales]
)
def test_both_engines_agree(scenes: Callable[[np.random.Generator], Iterator[ScanPair]]) -> None:
    for pair in scenes(np.random.default_rng(0)):
        batch = ScanPairBatch.collate([pair], torch.float64)
        start = model("compiled").initialise(batch)
        found, expected = (model(backend)(batch, start) for backend in ("compiled", "eager"))
        assert found.motions.isfinite().all()
        assert not found.log_association.isnan().any()
        assert not found.log_cluster.isnan().any()
        torch.testing.assert_close(found.association, expected.association)
        torch.testing.assert_close(found.cluster, expected.cluster)
        size = float(np.median(pair.source.ranges))
        torch.testing.assert_close(found.motions[..., 1:] / size, expected.motions[..., 1:] / size, rtol=1e-6, atol=1e-7)
        torch.testing.assert_close(found.motions[..., 0], expected.motions[..., 0], rtol=1e-6, atol=1e-7)


@pytest.mark.parametrize("times", [1e-3, 1e3])  # millimetres and milliseconds that count as metres and seconds, and the other way
@pytest.mark.parametrize("world", ["street", "indoor"])
def test_labels_do_not_depend_on_the_units_of_length_and_time(world: str, times: float) -> None:
    def of_size(scan: Scan, times: float) -> Scan:
        """Ranges and their noise so many times as large; how far the sensor sees, which has bounds in metres, is not told."""
        return replace(scan, ranges=scan.ranges * times, range_noise=0.01 * times, range_min=None, range_max=None)

    for pair in simulate_pairs(replace(NAMED_WORLDS[world], beams=121), 6, 3, 9):
        one, other = (
            model("compiled").match(of_size(pair.source, factor), of_size(pair.target, factor), pair.dt * factor)
            for factor in (1.0, times)
        )
        np.testing.assert_array_equal(one.association, other.association)
        np.testing.assert_array_equal(one.cluster, other.cluster)
