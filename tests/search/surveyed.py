"""Scans, pairs and scenes as the search sees them, and the same for the oracles."""

from dataclasses import dataclass
from functools import cache, cached_property
from pathlib import Path
from typing import Any

import numpy as np
import oracles_movers
import oracles_search as oracles
import torch
from hypothesis import strategies as st
from support import make_points
from torch import Tensor

from torchcrf_scan.batch import ScanPairBatch
from torchcrf_scan.data.pair_file import read_pair
from torchcrf_scan.data.simulate import simulate_pairs
from torchcrf_scan.data.worlds import SimulatorConfig
from torchcrf_scan.geometry import se2
from torchcrf_scan.loops.jit import Array
from torchcrf_scan.loops.pair import Pair, pair_of
from torchcrf_scan.scan import ScanPair
from torchcrf_scan.search.grid import ScanGrid, grid_of
from torchcrf_scan.search.hypotheses import Hypotheses, members_of
from torchcrf_scan.search.leftover import Leftover
from torchcrf_scan.search.sides import Sides
from torchcrf_scan.search.surface import Surface, surface_of
from torchcrf_scan.search.survey import grids_of, survey_at

PAIRS = Path(__file__).resolve().parents[3] / "shared" / "data" / "pairs"
SIMULATED = {
    "street": SimulatorConfig(beams=181, range_noise=0.02),
    "room": SimulatorConfig(scene="indoor", beams=181),
    "closed": SimulatorConfig(beams=240, fov=360.0),
}
REAL = sorted(PAIRS.glob("*.npz"))[::40]
POOR = ["one", "two", "three", "one spot", "duplicates", "collinear", "closed three"]
SCENES = [*SIMULATED, *(path.name for path in REAL), *POOR]
NOISE = 0.01


def array(values: Tensor | np.ndarray) -> Array:
    """In double precision, in one piece."""
    return np.ascontiguousarray(np.asarray(values), np.float64)


def seen(points: Tensor | np.ndarray, noise: float = NOISE, *, closed: bool = False, origin: Any = (0.0, 0.0)) -> Surface:
    """A scan as pieces of surface. points: (P, 2)."""
    return surface_of(array(points), float(noise), closed, array(origin))


def grids(*scans: Surface) -> list[ScanGrid]:
    return [grid_of(scan) for scan in scans]


def oracle_of(scan: Surface) -> oracles.Surface:
    """The same scan by the oracle."""
    return oracles.surface(scan.points, scan.noise, scan.is_closed, tuple(scan.origin))


@st.composite
def any_scan(draw: st.DrawFn) -> Surface:
    """A scan of few or many points: spread, on one spot, twice each, or in line; open or closed; the sensor anywhere."""
    n, kind = draw(st.integers(1, 5) | st.integers(20, 70)), draw(st.sampled_from(["spread", "arc", "spot", "twice", "line"]))
    seed, closed = draw(st.integers(0, 10_000)), draw(st.booleans())
    points = make_points(n, seed, closed=closed).numpy()
    if kind == "arc":
        points *= 5.0 / np.linalg.norm(points, axis=1, keepdims=True)
    if kind == "spot":
        points = np.tile(points[:1], (n, 1))
    if kind == "twice":
        points = np.repeat(points, 2, axis=0)
    if kind == "line":
        points = np.c_[np.full(n, 2.0), np.linspace(-1.03, 1.0, n)]
    offset = np.array([draw(st.floats(-3, 3)), draw(st.floats(-20, 20)), draw(st.floats(-20, 20))])
    return seen(se2.apply(offset, points), draw(st.sampled_from([0.0, 0.01, 0.2])), closed=closed, origin=offset[1:])


@dataclass(frozen=True)
class Surveyed:
    """One pair, and what the search made of it at a background motion (3,) that is not quite right."""

    pair: Pair
    background: Array
    leftover: Leftover
    found: Hypotheses
    features: Array
    sides: Sides

    @property
    def source(self) -> Surface:
        return self.leftover.source.grid.scan

    @property
    def target(self) -> Surface:
        return self.leftover.target.grid.scan

    @property
    def members(self) -> list[list[int]]:
        """The points that every hypothesis moves."""
        rows = members_of(self.found, np.arange(len(self.found.motions)), len(self.source.points))
        return [np.flatnonzero(row).tolist() for row in rows]

    @cached_property
    def scene(self) -> oracles_movers.Scene:
        """For the oracles."""
        return oracles_movers.Scene(oracle_of(self.source), oracle_of(self.target), tuple(self.background))


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
    dt, noise = torch.tensor([0.2]).double(), torch.tensor([0.02]).double()
    return ScanPairBatch(points[None], moved[None], mask, mask, closed, closed, dt, noise, torch.zeros(1, 3).double())


def as_pair(pair: ScanPair) -> Pair:
    return pair_of(ScanPairBatch.collate([pair], torch.float64).without_truth(), 0)


@cache
def survey(name: str) -> Surveyed:
    """A scene by its name."""
    background = np.array([0.02, -0.15, 0.05])
    if name in SIMULATED:
        simulated = simulate_pairs(SIMULATED[name], 1, 1, seed=4)[0]
        assert simulated.annotation is not None
        pair, background = as_pair(simulated), simulated.annotation.motions[0] + 0.003
    elif name.endswith(".npz"):
        pair = as_pair(read_pair(PAIRS / name))
    else:
        pair = pair_of(poor_batch(name), 0)
    known = survey_at(*grids_of(pair), background, pair.dt)
    return Surveyed(pair._replace(initial_motion=np.full(3, 0.125)), background, *known)


def thinned(whole: Surveyed, most: int) -> Surveyed:
    """The same scene by every so many beams, so that a scan has about `most` points at most."""
    stride = -(-max(len(whole.pair.source), len(whole.pair.target)) // most)
    source, target = (np.ascontiguousarray(points[::stride]) for points in (whole.pair.source, whole.pair.target))
    pair = whole.pair._replace(source=source, target=target)
    return Surveyed(pair, whole.background, *survey_at(*grids_of(pair), whole.background, pair.dt))
