"""The paper's start: motions of runs of associations, and the movers that they give."""

import pytest
import torch
from scenes import make_batch
from support import assert_close, normal
from torch import Tensor

from torchcrf_scan.config import InferenceConfig, ModelConfig
from torchcrf_scan.features.potentials import PairView
from torchcrf_scan.geometry import se2
from torchcrf_scan.inference.start import FARTHEST
from torchcrf_scan.model import JointScanCRF
from torchcrf_scan.variants.paper_start import EXPLAINED, FEWEST, movers_from_associations, run_motions

TRUE = torch.tensor([[0.1, -0.5, 0.2], [-0.3, 1.0, 0.4], [0.4, 0.0, -2.0]], dtype=torch.float64)


def row(n: int, x: float = 0.0) -> Tensor:
    """(n, 2) points half a metre apart, not quite in line."""
    return torch.stack([x + 0.5 * torch.arange(n), 0.1 * torch.arange(n) ** 2 % 0.3], dim=-1).double()


def test_every_run_has_its_motion_the_largest_first() -> None:
    source = torch.cat([row(5), row(8, 20.0)])
    partner = torch.cat([se2.apply(TRUE[1], source[:5]), se2.apply(TRUE[2], source[5:])])
    assert_close(run_motions(source, partner, torch.arange(13))[0], TRUE[[2, 1]])


def test_a_gap_in_number_ends_a_run() -> None:
    source = row(10)
    partner = torch.cat([se2.apply(TRUE[1], source[:4]), se2.apply(TRUE[2], source[4:])])
    joined, parted = torch.arange(10), torch.arange(10) + 4 * (torch.arange(10) >= 4)
    assert_close(run_motions(source, partner, parted)[0], TRUE[[2, 1]])
    assert run_motions(source, partner, joined)[0].shape == (1, 3)
    barely = torch.arange(10) + 2 * (torch.arange(10) >= 4)  # a step of three is no gap
    assert run_motions(source, partner, barely)[0].shape == (1, 3)


def test_runs_that_move_alike_are_one() -> None:
    source = torch.cat([row(6), row(5, 10.0), row(4, 20.0)])
    partner = torch.cat([se2.apply(TRUE[1], source[:11]), se2.apply(TRUE[2], source[11:])])
    motions, runs = run_motions(source, partner, torch.arange(15))
    assert_close(motions, TRUE[[1, 2]])
    assert [row.nonzero()[:, 0].tolist() for row in runs] == [list(range(6)), list(range(11, 15))]
    assert EXPLAINED < 1


@pytest.mark.parametrize("n", range(FEWEST + 1))
def test_short_runs_say_nothing(n: int) -> None:
    source = row(n)
    motions, runs = run_motions(source, se2.apply(TRUE[1], source), torch.arange(n))
    assert motions.shape == ((1, 3) if n >= FEWEST else (0, 3))
    assert runs.shape == (len(motions), n)


def test_many_short_runs_say_nothing() -> None:
    source = torch.cat([row(3, 10.0 * k) for k in range(5)])
    assert run_motions(source, source + 1, torch.arange(15))[0].shape == (0, 3)


def test_movers_from_associations() -> None:
    source = torch.cat([row(20), row(6, 30.0)])[None]
    target = torch.cat([source[0, :20], source[0, 20:] + torch.tensor([2.0, 0.0]).double()])[None]
    batch = make_batch(source, target)
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
            assert (start.reach[0, 20:, 1] == 0).all()
            assert (start.reach[0, :15, 1] == FARTHEST).all()
            assert (start.reach[..., 0] == 0).all()


def test_the_papers_start_needs_no_more_than_a_model() -> None:
    source = torch.cat([row(20), row(8, 30.0)])[None] + 0.001 * normal(1, 28, 2)
    target = source.clone()
    target[0, 20:] += torch.tensor([2.5, 0.0]).double()  # farther than one motion may be from both
    model = JointScanCRF(ModelConfig(start="paper", inference=InferenceConfig(clusters=5, candidates=0))).double()
    start = model.initialise(make_batch(source, target))
    assert start.motions.shape == (1, 4, 3)
    turn, shift = se2.distance(start.motions[0, 0], torch.zeros(3).double())
    assert float(turn) < 0.02
    assert float(shift) < 0.1
    assert start.motions.isfinite().all()
