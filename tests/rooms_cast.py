"""Scans of made rooms with a known path, cast without the simulator."""

import numpy as np

from torchcrf_scan.geometry import se2
from torchcrf_scan.scan import Floats, Scan

BEAMS = np.radians(np.arange(-135, 135, 0.75))
ROOM = np.array(
    [[-4.0, -3.0, 6.0, -3.0], [6.0, -3.0, 6.0, 4.0], [6.0, 4.0, -4.0, 4.0], [-4.0, 4.0, -4.0, -3.0], [2.0, 2.0, 3.0, 2.5]]
)
CORRIDOR = np.array([[-200.0, -1.5, 200.0, -1.5], [-200.0, 1.5, 200.0, 1.5]])


def box(x: float, y: float, half: float = 0.3) -> Floats:
    """(4, 4) segments of a square."""
    corners = np.array([[x - half, y - half], [x + half, y - half], [x + half, y + half], [x - half, y + half]])
    return np.concatenate([corners, np.roll(corners, -1, axis=0)], axis=1)


def ranges_at(pose: Floats, segments: Floats, bearings: Floats = BEAMS) -> Floats:
    """(B,) distance of the first segment (S, 4) along every beam, inf where there is none."""
    ends = se2.apply(se2.inverse(pose), segments.reshape(-1, 2)).reshape(-1, 4)
    a, edge = ends[:, :2], ends[:, 2:] - ends[:, :2]
    dx, dy = np.cos(bearings)[:, None], np.sin(bearings)[:, None]
    with np.errstate(all="ignore"):
        inverse = 1 / (dx * edge[:, 1] - dy * edge[:, 0])
        ranges = (a[:, 0] * edge[:, 1] - a[:, 1] * edge[:, 0]) * inverse
        along = (a[:, 0] * dy - a[:, 1] * dx) * inverse
        return np.where((ranges > 0) & (along >= 0) & (along <= 1), ranges, np.inf).min(1)


def scan_at(pose: Floats, segments: Floats = ROOM, seed: int = 0, noise: float = 0.005, reach: float = 25.0) -> Scan:
    """A noisy scan from a pose (3,); the same seed gives the same noise."""
    ranges = ranges_at(pose, segments) + np.random.default_rng(seed).normal(0, noise, len(BEAMS))
    return Scan.from_ranges(ranges, BEAMS, range_min=0.05, range_max=reach)


def path_of(count: int, step: tuple[float, float, float] = (0.03, 0.04, 0.0)) -> Floats:
    """(count, 3) poses, each a step (theta, x, y) from the one before."""
    poses = [np.zeros(3)]
    for _ in range(count - 1):
        poses.append(se2.compose(poses[-1], np.array(step)))
    return np.stack(poses)
