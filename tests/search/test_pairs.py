"""Where the rounds start: backgrounds are found near and far, movers from runs, and nothing breaks on nearly empty scans."""

from dataclasses import fields, replace

import numpy as np
import pytest
import torch
from support import assert_close
from torch import Tensor

from torchcrf_scan.batch import ScanPairBatch
from torchcrf_scan.data.simulate import simulate_pairs
from torchcrf_scan.data.worlds import NAMED_WORLDS, SimulatorConfig, every
from torchcrf_scan.geometry import se2
from torchcrf_scan.inference.start import FARTHEST, Start
from torchcrf_scan.loops.pair import PairStart, pair_of
from torchcrf_scan.scan import Scan, ScanPair
from torchcrf_scan.search.accept import score_of
from torchcrf_scan.search.pairs import choose, initialise, start_arrays, start_pair, start_pairs, survey
from torchcrf_scan.search.score import HypothesisScore
from torchcrf_scan.search.survey import grids_of
from torchcrf_scan.search.trusted import choose_background

ROTATION, TRANSLATION = np.radians(1.0), 0.05
OFFSET = np.array([-0.35, 2.8, 2.1])  # 3.5 m
SCORE = score_of(HypothesisScore())


@pytest.fixture(scope="module")
def pairs() -> list[ScanPair]:
    """Six pairs of six scenes."""
    return simulate_pairs(SimulatorConfig(beams=181), 6, 6, 0)


def start_of(batch: ScanPairBatch, clusters: int = 7) -> Start:
    return initialise(batch, SCORE, clusters)


def recovered(found: Tensor, truth: np.ndarray, translation: float = TRANSLATION) -> int:
    """How many of the (B, 3) motions are right."""
    turn, shift = se2.distance(found.double().numpy(), truth)
    return int(((turn < ROTATION) & (shift < translation)).sum())


def backgrounds(pairs: list[ScanPair]) -> np.ndarray:
    return np.array([pair.annotation.motions[0] for pair in pairs if pair.annotation is not None])


def test_a_sensor_that_stands_is_seen_to_stand_while_somebody_passes() -> None:
    passed = simulate_pairs(every(NAMED_WORLDS["passed_512"], 0.1), 24, 12, 4)
    starts = start_of(ScanPairBatch.collate(passed))
    assert recovered(starts.motions[:, 0], np.zeros((len(passed), 3))) == len(passed)


def test_a_motion_that_explains_far_less_than_standing_still_is_not_believed() -> None:
    angles = np.radians(np.linspace(-135, 135, 541))
    ahead, beside = 4 / np.maximum(np.cos(angles), 1e-9), 3 / np.maximum(np.abs(np.sin(angles)), 1e-9)
    scan = Scan.from_ranges(np.minimum(ahead, beside), angles)
    source, target = grids_of(pair_of(ScanPairBatch.collate([ScanPair(scan, scan, 0.1)]), 0))
    believed = choose_background(np.array([0.7, 2.0, -1.0]), np.array([0.0, 0.5, 0.0]), source, target)
    assert not believed.is_found
    assert np.abs(believed.motion).max() < 0.01
    assert choose_background(np.array([0.001, 0.0, 0.0]), np.zeros(3), source, target).is_found


def test_a_plain_room_is_not_believed_to_be_turned_round() -> None:
    pair = simulate_pairs(every(NAMED_WORLDS["passed_512"], 0.3), 42, 21, 4)[40]
    start = start_of(ScanPairBatch.collate([pair]))
    assert recovered(start.motions[:, 0], np.zeros((1, 3))) == 1


def test_of_motions_that_explain_a_plain_room_alike_the_one_near_the_guess_is_believed() -> None:
    angles = np.radians(np.arange(-180.0, 180.0))
    room = np.minimum(4 / np.maximum(np.abs(np.cos(angles)), 1e-9), 3 / np.maximum(np.abs(np.sin(angles)), 1e-9))
    scan = Scan.from_ranges(room, angles)
    source, target = grids_of(pair_of(ScanPairBatch.collate([ScanPair(scan, scan, 0.1)]), 0))
    turned = np.array([0.999 * np.pi, 0.0, 0.0])
    assert np.abs(choose_background(turned, np.zeros(3), source, target).motion).max() < 0.01
    assert choose_background(turned, turned, source, target).is_found


def seen_from_afar(pair: ScanPair) -> ScanPair:
    """The second scan as a sensor elsewhere would number and measure the same points."""
    points = se2.apply(OFFSET, pair.target.points)
    bearings = np.arctan2(points[:, 1], points[:, 0])
    order = np.argsort(bearings)
    target = Scan.from_ranges(np.hypot(*points.T)[order], bearings[order], range_noise=pair.target.range_noise)
    return replace(pair, target=target, annotation=None)


@pytest.fixture(scope="module")
def found(pairs: list[ScanPair]) -> Start:
    return start_of(ScanPairBatch.collate(pairs))


def test_the_background_is_found(pairs: list[ScanPair], found: Start) -> None:
    assert recovered(found.motions[:, 0], backgrounds(pairs)) >= 5
    assert found.active[:, 0].all()


def test_some_movers_are_found(pairs: list[ScanPair], found: Start) -> None:
    right = 0
    for b, pair in enumerate(pairs):
        assert pair.annotation is not None
        for motion in pair.annotation.motions[1:]:
            turn, shift = se2.distance(found.motions[b, 1:].double().numpy(), motion)
            right += bool(((turn < 0.1) & (shift < 0.5) & found.active[b, 1:].numpy()).any())
    assert right >= 3


def test_the_background_is_found_from_afar(pairs: list[ScanPair]) -> None:
    start = start_of(ScanPairBatch.collate([seen_from_afar(pair) for pair in pairs]), 1)
    assert recovered(start.motions[:, 0], se2.compose(np.tile(OFFSET, (6, 1)), backgrounds(pairs)), 2 * TRANSLATION) >= 4


def test_a_wrong_guess_spoils_nothing(pairs: list[ScanPair]) -> None:
    batch = ScanPairBatch.collate(pairs)
    guess = torch.tensor([0.3, 3.0, -1.0]).expand(6, 3)
    start = start_of(replace(batch, initial_motion=guess), 1)
    assert recovered(start.motions[:, 0], backgrounds(pairs)) >= 5


def test_a_pair_is_started_as_if_alone(pairs: list[ScanPair], found: Start) -> None:
    for b in (1, 4):
        alone = start_of(ScanPairBatch.collate(pairs[b : b + 1]))
        n, m = len(pairs[b].source), len(pairs[b].target)
        assert torch.equal(alone.active[0], found.active[b])
        assert_close(alone.motions[0], found.motions[b], tolerance=1e-4)
        assert_close(alone.target_tangents[0], found.target_tangents[b, :m])
        assert (alone.association[0] == found.association[b, :n]).float().mean() > 0.98


def test_the_start_is_the_same_every_time(pairs: list[ScanPair], found: Start) -> None:
    torch.manual_seed(77)
    again = start_of(ScanPairBatch.collate(pairs[:2]))
    longest = again.association.shape[1]
    assert_close(again.motions, found.motions[:2], tolerance=1e-4)
    assert (again.association == found.association[:2, :longest]).float().mean() > 0.98


def test_a_double_batch_gives_a_double_start(pairs: list[ScanPair], found: Start) -> None:
    start = start_of(ScanPairBatch.collate(pairs[1:2], torch.float64))
    assert start.motions.dtype == start.target_tangents.dtype == torch.float64
    turn, shift = se2.distance(start.motions[0, 0], found.motions[1, 0].double())
    assert float(turn) < 1e-3
    assert float(shift) < 1e-2


@pytest.mark.parametrize(("source", "target"), [(0, 30), (2, 30), (30, 0), (30, 2), (0, 0), (1, 1), (2, 2)])
def test_too_few_points_leave_the_guess(source: int, target: int) -> None:
    bearings = np.linspace(-1.2, 1.2, 30)
    wall = 4.0 / np.cos(bearings / 2)
    scans = [Scan.from_ranges(np.where(np.arange(30) < count, wall, np.inf), bearings) for count in (source, target)]
    batch = ScanPairBatch.collate([ScanPair(*scans)])
    guess = torch.tensor([[0.1, 0.2, 0.3]])
    start = start_of(replace(batch, initial_motion=guess), 3)
    assert_close(start.motions, guess[:, None].expand(1, 3, 3))
    assert start.active.tolist() == [[True, False, False]]
    assert (start.target_tangents == 0).all()
    assert target > 0 or bool((start.association == -1).all())


def test_three_points_are_enough_for_an_answer() -> None:
    scan = Scan.from_ranges([2.0, 2.1, 2.2], [0.0, 0.1, 0.2])
    start = start_of(ScanPairBatch.collate([ScanPair(scan, scan)]))
    assert start.motions.isfinite().all()


# --- the ways to a start ------------------------------------------------------------------------------------------------------


def assert_equal(one: Start, other: Start) -> None:
    for field in fields(Start):
        assert torch.equal(getattr(one, field.name), getattr(other, field.name)), field.name


def test_what_was_surveyed_gives_the_same_start(pairs: list[ScanPair], found: Start) -> None:
    batch = ScanPairBatch.collate(pairs)
    surveys = survey(batch)
    assert all(seen is not None for seen in surveys)
    assert_equal(choose(batch, surveys, SCORE, 7), found)
    assert choose(batch, surveys, SCORE, 2).motions.shape == (6, 2, 3)


def test_a_start_as_arrays_is_that_as_tensors(pairs: list[ScanPair]) -> None:
    batch = ScanPairBatch.collate(pairs, torch.float64)
    together = start_of(batch)
    pairs_as_arrays = [pair_of(batch, b) for b in range(len(batch))]
    for b, arrays in enumerate(start_pairs(pairs_as_arrays, SCORE, 7)):
        alone = start_pair(pairs_as_arrays[b], SCORE, 7)
        back = start_arrays(together, b, pairs_as_arrays[b])
        for name in PairStart._fields:
            for other in (alone, back):
                np.testing.assert_array_equal(getattr(arrays, name), getattr(other, name), err_msg=name)


def test_padding_is_no_point(pairs: list[ScanPair], found: Start) -> None:
    batch = ScanPairBatch.collate(pairs)
    assert found.reach is not None
    assert (found.association[~batch.source_mask] == -1).all()
    assert (found.target_tangents[~batch.target_mask] == 0).all()
    assert (found.reach[~batch.source_mask][:, 0] == 0).all()
    assert (found.reach[~batch.source_mask][:, 1:] == FARTHEST).all()


@pytest.mark.parametrize("empty", ["both", "source", "target"])
def test_an_empty_scan_changes_no_other_start(pairs: list[ScanPair], found: Start, empty: str) -> None:
    nothing = Scan.from_ranges(np.full(9, np.inf), np.linspace(-0.5, 0.5, 9))
    source, target = (nothing if empty in ("both", side) else getattr(pairs[0], side) for side in ("source", "target"))
    start = start_of(ScanPairBatch.collate([*pairs[:2], ScanPair(source, target)]))
    assert torch.equal(start.motions[:2], found.motions[:2])
    assert torch.equal(start.active[:2], found.active[:2])
    for b in range(2):
        n, m = len(pairs[b].source), len(pairs[b].target)
        assert torch.equal(start.association[b, :n], found.association[b, :n])
        assert torch.equal(start.target_tangents[b, :m], found.target_tangents[b, :m])
    assert (start.association[2] == -1).all()
    assert (start.target_tangents[2] == 0).all()
    assert start.active[2].tolist() == [True] + [False] * 6
    assert start.motions[2].isfinite().all()
