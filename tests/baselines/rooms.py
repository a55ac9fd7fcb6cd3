"""Hand-made pairs for the baselines: an uneven room, with or without a box in it, seen from two places."""

import numpy as np

from torchcrf_scan.geometry import se2
from torchcrf_scan.scan import Floats, Scan, ScanPair

BEARINGS = np.radians(np.arange(-90.0, 90.5, 1.0))
ROOM = np.array([[-3, -4], [6, -4], [6, -1], [8, -1], [8, 3], [5, 3], [5, 5], [1, 5], [1, 4], [-3, 4]], dtype=float)
BOX = np.array([[2.0, -0.6], [2.8, -0.6], [2.8, 0.4], [2.0, 0.4]])
EMPTY = Scan.from_ranges([np.nan] * 3, [0.0, 0.1, 0.2])
ONE = Scan.from_ranges([2.0], [0.1])
HOLES = Scan.from_ranges([5.0, np.nan, 5.1, 5.2, np.inf, 5.0], np.linspace(0.0, 0.5, 6))
TWINS = Scan.from_ranges([2.0] * 6, [0.1] * 6)  # six returns in one place
AWKWARD = {"empty": EMPTY, "one": ONE, "holes": HOLES, "twins": TWINS}


def scan_of(outlines: list[Floats], noise: float = 0.0, seed: int = 0) -> Scan:
    """What a sensor at the origin sees of closed outlines, (P, 2) each."""
    start = np.concatenate(outlines)
    edge = np.concatenate([np.roll(outline, -1, axis=0) - outline for outline in outlines])
    beam = np.stack([np.cos(BEARINGS), np.sin(BEARINGS)], axis=-1)[:, None]  # (N, 1, 2)
    with np.errstate(divide="ignore", invalid="ignore"):
        across = beam[..., 0] * edge[:, 1] - beam[..., 1] * edge[:, 0]
        ranges = (start[:, 0] * edge[:, 1] - start[:, 1] * edge[:, 0]) / across
        along = (start[:, 0] * beam[..., 1] - start[:, 1] * beam[..., 0]) / across
    hits = np.where((ranges > 0) & (along >= 0) & (along <= 1), ranges, np.inf).min(1)
    return Scan.from_ranges(hits + noise * np.random.default_rng(seed).normal(size=len(hits)), BEARINGS)


def room_pair(motion: Floats, box_shift: Floats | None = None, noise: float = 0.0) -> ScanPair:
    """The room before and after the static world moved by `motion`; the box, if there is one, is shifted over ground first."""
    before, after = [ROOM], [se2.apply(motion, ROOM)]
    if box_shift is not None:
        before.append(BOX)
        after.append(se2.apply(motion, BOX + box_shift))
    return ScanPair(scan_of(before, noise, 0), scan_of(after, noise, 1), dt=0.2)
