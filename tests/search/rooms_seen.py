"""A room that a sensor sees before and after it has moved, simulated pairs as the search sees them, and who was right."""

import math

import torch
from support import polar
from surveyed import seen
from torch import Tensor

from torchcrf_scan.batch import ScanPairBatch
from torchcrf_scan.geometry import se2
from torchcrf_scan.loops.pair import pair_of
from torchcrf_scan.search.grid import ScanGrid, grid_of
from torchcrf_scan.search.survey import grids_of

STILL = torch.zeros(3, dtype=torch.float64)


def see_room(motion: Tensor, beams: int = 121) -> ScanGrid:
    """Walls at x = 4, y = 3 and y = -5 after the scene has moved by `motion` in the sensor's frame."""
    bearings = torch.linspace(-1.9, 1.9, beams, dtype=torch.float64)
    direction = torch.stack([bearings.cos(), bearings.sin()], -1)
    back = se2.inverse(motion)
    ray = se2.rotate(back[0], direction)
    reach = [(wall - back[1 + axis]) / ray[:, axis] for axis, wall in ((0, 4.0), (1, 3.0), (1, -5.0))]
    ranges = torch.stack([torch.where(r > 0, r, torch.inf) for r in reach]).amin(0)
    return grid_of(seen(polar(ranges, bearings)))


def sides(batch: ScanPairBatch, b: int) -> tuple[ScanGrid, ScanGrid]:
    """Both scans of a pair."""
    return grids_of(pair_of(batch, b))


def right(found: Tensor, truth: Tensor, translation: float = 0.05, rotation: float = math.radians(1.0)) -> int:
    """How many of the motions (B, 3) are."""
    turn, shift = se2.distance(found, truth)
    return int(((turn < rotation) & (shift < translation)).sum())
