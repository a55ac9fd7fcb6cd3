"""Pairs as the eager and the compiled start of the movers see them."""

from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import numpy as np
import torch
from support import make_points
from torch import Tensor
from torchcrf_scan.inference.surface import Surface

from torchcrf_scan.batch import ScanPairBatch
from torchcrf_scan.data.pair_file import read_pair
from torchcrf_scan.data.simulate import simulate_pairs
from torchcrf_scan.data.worlds import SimulatorConfig
from torchcrf_scan.geometry import se2
from torchcrf_scan.inference import hypotheses as eager
from torchcrf_scan.scan import ScanPair
from torchcrf_scan.search.grid import Field, field_of
from torchcrf_scan.search.hypotheses import Hypotheses, hypothesise, members_of
from torchcrf_scan.search.hypothesis_features import hypothesis_features
from torchcrf_scan.search.leftover import Leftover, leftover_of
from torchcrf_scan.search.surface import surface_of

PAIRS = Path(__file__).resolve().parents[3] / "shared" / "data" / "pairs"
SIMULATED = {
    "street": SimulatorConfig(beams=181, range_noise=0.02),
    "room": SimulatorConfig(scene="indoor", beams=181),
    "closed": SimulatorConfig(beams=240, fov=360.0),
}
REAL = sorted(PAIRS.glob("*.npz"))[::40]
SCENES = [*SIMULATED, *(path.name for path in REAL), "one", "two", "three", "one spot", "duplicates", "collinear", "closed three"]
NOISE = 0.02


@dataclass(frozen=True)
class Surveyed:
    """One pair, what the eager modules take, and what the compiled ones made of it."""

    batch: ScanPairBatch
    source: Surface
    target: Surface
    background: Tensor
    leftover: Leftover
    found: Hypotheses
    features: np.ndarray

    @property
    def dt(self) -> float:
        return float(self.batch.dt[0])

    @property
    def as_eager(self) -> eager.Hypotheses:
        """What the compiled code found."""
        members = members_of(self.found, np.arange(len(self.found.motions)), len(self.source))
        return eager.Hypotheses(torch.from_numpy(self.found.motions), torch.from_numpy(members))


def compiled(surface: Surface) -> Field:
    """The same scan for compiled code."""
    points, origin = (np.ascontiguousarray(values.numpy()) for values in (surface.points, surface.origin))
    return field_of(surface_of(points, float(surface.noise), surface.is_closed, origin))


def poor_batch(name: str) -> ScanPairBatch:
    """Scans that say little."""
    points = {
        "one": make_points(1, 5),
        "two": make_points(2, 4),
        "three": make_points(3, 3),
        "one spot": torch.tensor([[1.0, 2.0]], dtype=torch.float64).expand(7, 2),
        "duplicates": make_points(6, 7).repeat_interleave(2, 0),
        "collinear": torch.stack([torch.full((19,), 2.0), torch.linspace(-1, 1, 19)], -1).double(),
        "closed three": make_points(3, 8, closed=True),
    }[name]
    moved = se2.apply(torch.tensor([0.3, 0.4, -0.2], dtype=torch.float64), points)
    mask, closed = torch.ones(1, len(points), dtype=torch.bool), torch.tensor([name.startswith("closed")])
    dt, noise = torch.tensor([0.2]).double(), torch.tensor([NOISE]).double()
    return ScanPairBatch(points[None], moved[None], mask, mask, closed, closed, dt, noise, torch.zeros(1, 3).double())


def batch_of(pair: ScanPair) -> ScanPairBatch:
    return ScanPairBatch.collate([pair], torch.float64).without_truth()


@cache
def survey(name: str) -> Surveyed:
    """A scene by its name."""
    background = torch.tensor([0.02, -0.15, 0.05], dtype=torch.float64)
    if name in SIMULATED:
        pair = simulate_pairs(SIMULATED[name], 1, 1, seed=4)[0]
        assert pair.annotation is not None
        batch, background = batch_of(pair), torch.from_numpy(pair.annotation.motions[0]) + 0.003
    elif name.endswith(".npz"):
        batch = batch_of(read_pair(PAIRS / name))
    else:
        batch = poor_batch(name)
    source = Surface.of(batch.source[0], batch.range_noise[0], bool(batch.source_closed[0]))
    target = Surface.of(batch.target[0], batch.range_noise[0], bool(batch.target_closed[0]), batch.target_origin[0])
    leftover = leftover_of(compiled(source), compiled(target), background.numpy())
    found = hypothesise(leftover, float(batch.dt[0]))
    batch = replace(batch, initial_motion=torch.full((1, 3), 0.125, dtype=torch.float64))
    return Surveyed(batch, source, target, background, leftover, found, hypothesis_features(leftover, found))
