import math

import torch
from torch import Tensor
from torchcrf_scan.inference.hypotheses import ends, hypothesise, pieces
from torchcrf_scan.inference.surface import Surface

NOISE = torch.tensor(0.01)
STEP = math.radians(0.5)
FAR = 30.0


def wall_and_car(shift: float) -> Surface:
    """A wall across the view, 30 m ahead, and a car's rear 0.8 m before it, `shift` metres to the left."""
    bearing = torch.arange(-60, 61) * STEP
    is_car = (FAR * bearing.tan() - shift).abs() < 0.9
    return Surface.of(polar((FAR - 0.8 * is_car) / bearing.cos(), bearing), NOISE, False)


def polar(ranges: Tensor, bearing: Tensor) -> Tensor:
    return torch.stack([ranges * bearing.cos(), ranges * bearing.sin()], dim=-1)


def on_car(surface: Surface) -> Tensor:
    return surface.points[:, 0] < FAR - 0.4


def test_a_car_that_shares_its_segment_with_the_wall_is_a_piece() -> None:
    surface = wall_and_car(0.0)
    assert surface.segment.unique().tolist() == [0]
    numbers = pieces(surface)
    assert numbers[on_car(surface)].unique().tolist() == [1]
    assert numbers[~on_car(surface)].unique().tolist() == [0, 2]


def test_the_pool_moves_that_car_alone() -> None:
    source, target = wall_and_car(-1.0), wall_and_car(1.0)
    pool = hypothesise(source, target, torch.zeros(3), 0.2)
    is_alone = (pool.members == on_car(source)).all(-1)
    assert is_alone.any()
    assert (pool.motions[is_alone] - torch.tensor([0.0, 0.0, 2.0])).norm(dim=-1).min() < 0.3


def test_no_hypothesis_twice_the_same_members() -> None:
    pool = hypothesise(wall_and_car(-1.0), wall_and_car(1.0), torch.zeros(3), 0.2)
    rows = torch.cat([pool.members.float(), pool.motions], dim=-1)
    assert len(rows.unique(dim=0)) == len(rows)


def test_a_piece_leads_round_the_seam_of_a_closed_scan() -> None:
    bearing = torch.arange(720) * STEP
    ranges = torch.where((bearing > 3) & (bearing < 3.2), 3.0, 5.0)
    numbers = pieces(Surface.of(polar(ranges, bearing), NOISE, True))
    assert numbers[0] == numbers[-1]
    assert len(numbers.unique()) == 2


def test_ends_of_a_set_that_leads_round_the_seam() -> None:
    members = torch.zeros(3, 10, dtype=torch.bool)
    members[0, 2:5] = members[1, [0, 1, 8, 9]] = members[2, 9] = True
    first, last = ends(members)
    assert first.tolist() == [2, 8, 9]
    assert last.tolist() == [4, 1, 9]
