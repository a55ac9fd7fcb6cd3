"""A made-up laser among made-up boxes that move at constant velocities: what a tracker gets, and the truth."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from torchcrf_scan.data.laser import cast
from torchcrf_scan.data.world import Shapes, box
from torchcrf_scan.geometry import se2

BEARINGS = np.radians(np.arange(-180, 180, 0.5))


@dataclass(frozen=True)
class Body:
    """A box of `size` (length, width) that is at `start` at time 0."""

    start: tuple[float, float]
    velocity: tuple[float, float]
    size: tuple[float, float] = (4.0, 1.8)

    def centre(self, time: float) -> np.ndarray:
        return np.add(self.start, time * np.array(self.velocity))

    def pose(self, time: float) -> np.ndarray:
        return np.array([np.arctan2(self.velocity[1], self.velocity[0]), *self.centre(time)])


def sight(
    bodies: list[Body], time: float, rng: np.random.Generator, *, noise: float = 0.01, speed_noise: float = 0.1, sensor=(0.0, 0.0)
) -> dict[str, np.ndarray]:
    """The arguments of `Tracker.update` but the stamp; body b is cluster b + 1, hidden ones have no points."""
    hits = cast(Shapes.of(), BEARINGS, 0, rng)
    for number, body in enumerate(bodies, 1):
        shapes = Shapes.of([box(*body.size)]).moved(body.pose(time)).moved(np.array([0.0, -sensor[0], -sensor[1]]))
        hits = hits.nearer(cast(shapes, BEARINGS, number, rng))
    hit = np.isfinite(hits.ranges)
    ranges = hits.ranges[hit] + rng.normal(0, noise, hit.sum())
    points = ranges[:, None] * np.stack([np.cos(BEARINGS[hit]), np.sin(BEARINGS[hit])], axis=1) + sensor
    velocities = np.array([body.velocity for body in bodies], dtype=float).reshape(-1, 2)
    return {
        "points": points,
        "cluster": hits.body[hit],
        "velocities": velocities + rng.normal(0, speed_noise, velocities.shape),
        "covariances": np.tile(speed_noise**2 * np.eye(2), (len(bodies), 1, 1)),
        "sensor": np.array(sensor),
    }


def nothing() -> dict[str, np.ndarray]:
    """The arguments of a scan in which nothing moves."""
    return {
        "points": np.zeros((0, 2)),
        "cluster": np.zeros(0, dtype=np.int64),
        "velocities": np.zeros((0, 2)),
        "covariances": np.zeros((0, 2, 2)),
    }


def turned(scan: dict[str, np.ndarray], motion: np.ndarray) -> dict[str, np.ndarray]:
    """The same scan in a world that is moved by `motion` (3,)."""
    turn = np.array([motion[0], 0.0, 0.0])
    axes = se2.apply(turn, np.eye(2))
    covariances = axes.T @ scan["covariances"] @ axes
    places = {"points": se2.apply(motion, scan["points"]), "sensor": se2.apply(motion, scan["sensor"][None])[0]}
    return scan | places | {"velocities": se2.apply(turn, scan["velocities"]), "covariances": covariances}
