"""Where the iterations start: backgrounds are found near and far, movers from runs, and nothing breaks on nearly empty scans."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from support import assert_close, make_points, normal
from torch import Tensor
from torchcrf_scan.inference.cold import shape_association
from torchcrf_scan.inference.initialise import initialise

from torchcrf_scan.batch import ScanPairBatch
from torchcrf_scan.config import InferenceConfig, ModelConfig
from torchcrf_scan.data.simulate import simulate_pairs
from torchcrf_scan.data.worlds import SimulatorConfig
from torchcrf_scan.features.potentials import PairView
from torchcrf_scan.geometry import se2
from torchcrf_scan.inference.start import FOOTPRINT, Start, nearest_association
from torchcrf_scan.model import JointScanCRF
from torchcrf_scan.scan import Scan, ScanPair
from torchcrf_scan.search.cold import ransac_motions
from torchcrf_scan.search.score import HypothesisScore
from torchcrf_scan.variants.paper_start import EXPLAINED, FEWEST, movers_from_associations, run_motions

ROTATION, TRANSLATION = np.radians(1.0), 0.05
OFFSET = np.array([-0.35, 2.8, 2.1])  # 3.5 m
TRUE = torch.tensor([[0.1, -0.5, 0.2], [-0.3, 1.0, 0.4], [0.4, 0.0, -2.0]], dtype=torch.float64)


@pytest.fixture(scope="module")
def pairs() -> list[ScanPair]:
    """Six pairs of six scenes."""
    return simulate_pairs(SimulatorConfig(beams=181), 6, 6, 0)


def start_of(batch: ScanPairBatch, clusters: int = 7) -> Start:
    return initialise(batch, HypothesisScore().to(batch.source.dtype), clusters)


def recovered(found: Tensor, truth: np.ndarray, translation: float = TRANSLATION) -> int:
    """How many of the (B, 3) motions are right."""
    turn, shift = se2.distance(found.double().numpy(), truth)
    return int(((turn < ROTATION) & (shift < translation)).sum())


def backgrounds(pairs: list[ScanPair]) -> np.ndarray:
    return np.array([pair.annotation.motions[0] for pair in pairs if pair.annotation is not None])


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


def test_the_nearest_association_has_a_gate() -> None:
    source = torch.tensor([[[10.0, 0.0], [10.0, 1.0], [10.0, 2.0], [10.0, 3.0]]])
    unit = 10.0 * FOOTPRINT / 2 + 2 * 0.01
    target = source + torch.tensor([[0.0, 0.0], [2.8 * unit, 0.0], [3.3 * unit, 0.0], [0.0, 0.0]])
    batch = replace(plain_batch(source.double(), target.double()), source_mask=torch.tensor([[True, True, True, False]]))
    motions = torch.zeros(1, 2, 3).double()
    assert nearest_association(batch, motions, torch.tensor([[True, False]])).tolist() == [[0, 1, -1, -1]]
    back = torch.tensor([[[0.0, 0.0, 0.0], [0.0, 3.3 * unit, 0.0]]]).double()
    assert nearest_association(batch, back, torch.ones(1, 2, dtype=torch.bool)).tolist() == [[0, 1, 2, -1]]


def test_background_alone_is_the_first_motion(found: Start) -> None:
    alone = found.background_alone()
    assert alone.motions.shape == (6, 1, 3)
    assert alone.active.shape == (6, 1)
    assert torch.equal(alone.association, found.association)


# --- cold start ---------------------------------------------------------------------------------------------------------------


def test_ransac_recovers_the_motion_of_the_majority() -> None:
    source = make_points(60, 1)
    target = se2.apply(TRUE[0], source)
    target[::3] = make_points(20, 2)  # a third is wrong
    motions = ransac_motions(source, target, torch.tensor(0.05).double(), 4)
    assert motions.shape == (4, 3)
    assert_close(motions[0], TRUE[0])


@pytest.mark.parametrize(("points", "motions"), [(0, 0), (1, 0), (2, 4)])
def test_ransac_of_few_points(points: int, motions: int) -> None:
    source = make_points(2, 1)[:points]
    found = ransac_motions(source, se2.apply(TRUE[0], source), torch.tensor(0.05).double(), 4)
    assert found.shape == (motions, 3)
    assert found.isfinite().all()
    if motions:
        assert_close(found[0], TRUE[0])


def test_ransac_draws_the_same_samples_every_time() -> None:
    source, target, gate = make_points(30, 1), make_points(30, 2), torch.tensor(0.5).double()
    first = ransac_motions(source, target, gate, 8)
    torch.manual_seed(123)
    assert torch.equal(ransac_motions(source, target, gate, 8), first)


def test_ransac_of_identical_points_is_finite() -> None:
    here = torch.ones(5, 2).double()
    assert ransac_motions(here, here + 1, torch.tensor(0.1).double(), 3).isfinite().all()


def test_shapes_alone_find_the_partners_wherever_the_scan_went() -> None:
    source = make_points(40, 3)[None]
    target = se2.apply(torch.tensor([[1.0, 20.0, -7.0]]).double(), source)[:, 5:]
    batch = plain_batch(source, target)
    found = shape_association(PairView.of(batch))[0]
    assert (found[8:32] == torch.arange(8, 32) - 5).all()


def test_shapes_of_an_empty_scan_match_nothing() -> None:
    batch = plain_batch(make_points(5, 1)[None], make_points(4, 2)[None])
    for name in ("source_mask", "target_mask"):
        empty = replace(batch, **{name: torch.zeros_like(getattr(batch, name))})
        assert (shape_association(PairView.of(empty)) == -1).all()


# --- the paper's start --------------------------------------------------------------------------------------------------------


def plain_batch(source: Tensor, target: Tensor) -> ScanPairBatch:
    B = len(source)
    return ScanPairBatch(
        source=source,
        target=target,
        source_mask=torch.ones(source.shape[:2], dtype=torch.bool),
        target_mask=torch.ones(target.shape[:2], dtype=torch.bool),
        source_closed=torch.zeros(B, dtype=torch.bool),
        target_closed=torch.zeros(B, dtype=torch.bool),
        dt=torch.full((B,), 0.1).to(source),
        range_noise=torch.full((B,), 0.01).to(source),
        initial_motion=torch.zeros(B, 3).to(source),
    )


def row(n: int, x: float = 0.0) -> Tensor:
    """(n, 2) points half a metre apart, not quite in line."""
    return torch.stack([x + 0.5 * torch.arange(n), 0.1 * torch.arange(n) ** 2 % 0.3], dim=-1).double()


def test_every_run_has_its_motion_the_largest_first() -> None:
    source = torch.cat([row(5), row(8, 20.0)])
    partner = torch.cat([se2.apply(TRUE[1], source[:5]), se2.apply(TRUE[2], source[5:])])
    assert_close(run_motions(source, partner, torch.arange(13)), TRUE[[2, 1]])


def test_a_gap_in_number_ends_a_run() -> None:
    source = row(10)
    partner = torch.cat([se2.apply(TRUE[1], source[:4]), se2.apply(TRUE[2], source[4:])])
    joined, parted = torch.arange(10), torch.arange(10) + 4 * (torch.arange(10) >= 4)
    assert_close(run_motions(source, partner, parted), TRUE[[2, 1]])
    assert run_motions(source, partner, joined).shape == (1, 3)
    barely = torch.arange(10) + 2 * (torch.arange(10) >= 4)  # a step of three is no gap
    assert run_motions(source, partner, barely).shape == (1, 3)


def test_runs_that_move_alike_are_one() -> None:
    source = torch.cat([row(6), row(5, 10.0), row(4, 20.0)])
    partner = torch.cat([se2.apply(TRUE[1], source[:11]), se2.apply(TRUE[2], source[11:])])
    assert_close(run_motions(source, partner, torch.arange(15)), TRUE[[1, 2]])
    assert EXPLAINED < 1


@pytest.mark.parametrize("n", range(FEWEST + 1))
def test_short_runs_say_nothing(n: int) -> None:
    source = row(n)
    found = run_motions(source, se2.apply(TRUE[1], source), torch.arange(n))
    assert found.shape == ((1, 3) if n >= FEWEST else (0, 3))


def test_many_short_runs_say_nothing() -> None:
    source = torch.cat([row(3, 10.0 * k) for k in range(5)])
    assert run_motions(source, source + 1, torch.arange(15)).shape == (0, 3)


def test_movers_from_associations() -> None:
    source = torch.cat([row(20), row(6, 30.0)])[None]
    target = torch.cat([source[0, :20], source[0, 20:] + torch.tensor([2.0, 0.0]).double()])[None]
    batch = plain_batch(source, target)
    parameters = JointScanCRF().double().fitted
    association = torch.arange(26)[None].clone()
    association[0, 3] = -1
    for clusters, movers in ((4, 1), (1, 0)):
        start = movers_from_associations(PairView.of(batch), torch.zeros(1, 3).double(), association, parameters, clusters, target)
        assert start.motions.shape == (1, clusters, 3)
        assert start.active.sum().item() == 1 + movers
        assert torch.equal(start.association, association)
        if movers:
            assert_close(start.motions[0, 1], torch.tensor([0.0, 2.0, 0.0]).double())


def test_the_papers_start_needs_no_more_than_a_model() -> None:
    source = torch.cat([row(20), row(8, 30.0)])[None] + 0.001 * normal(1, 28, 2)
    target = source.clone()
    target[0, 20:] += torch.tensor([0.0, 0.8]).double()
    model = JointScanCRF(ModelConfig(start="paper", inference=InferenceConfig(clusters=5, candidates=0))).double()
    start = model.initialise(plain_batch(source, target))
    assert start.motions.shape == (1, 4, 3)
    turn, shift = se2.distance(start.motions[0, 0], torch.zeros(3).double())
    assert float(turn) < 0.02
    assert float(shift) < 0.1
    assert start.motions.isfinite().all()
