"""Associations of points with what comes nearest under any motion of a start."""

from dataclasses import replace

import torch
from scenes import MOTIONS, make_batch, make_start
from support import make_points

from torchcrf_scan.inference.start import FOOTPRINT, nearest_association


def test_the_nearest_association_has_a_gate() -> None:
    source = torch.tensor([[[10.0, 0.0], [10.0, 1.0], [10.0, 2.0], [10.0, 3.0]]])
    unit = 10.0 * FOOTPRINT / 2 + 2 * 0.01
    target = source + torch.tensor([[0.0, 0.0], [2.8 * unit, 0.0], [3.3 * unit, 0.0], [0.0, 0.0]])
    batch = replace(make_batch(source.double(), target.double()), source_mask=torch.tensor([[True, True, True, False]]))
    motions = torch.zeros(1, 2, 3).double()
    assert nearest_association(batch, motions, torch.tensor([[True, False]])).tolist() == [[0, 1, -1, -1]]
    back = torch.tensor([[[0.0, 0.0, 0.0], [0.0, 3.3 * unit, 0.0]]]).double()
    both = torch.ones(1, 2, dtype=torch.bool)
    assert nearest_association(batch, back, both).tolist() == [[0, 1, 2, -1]]
    reach = torch.tensor([[[0.0, 0.0], [0.0, 0.0], [0.0, 0.1], [0.0, 0.0]]]).double()  # the second motion explains it, from afar
    assert nearest_association(batch, back, both, reach).tolist() == [[0, 1, -1, -1]]


def test_background_alone_is_the_first_motion() -> None:
    batch = make_batch(make_points(7, 1).expand(6, 7, 2), make_points(5, 2).expand(6, 5, 2))
    found = make_start(batch, MOTIONS)
    alone = found.background_alone()
    assert torch.equal(alone.motions, found.motions[:, :1])
    assert alone.active.shape == (6, 1)
    assert torch.equal(alone.association, found.association)
