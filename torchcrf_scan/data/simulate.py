"""Simulated scan pairs with exact annotation: a laser drives through a world of `world.py`.

Worlds, poses and ray casting are at full size; `SimulatorConfig.scale` is applied to measured ranges and motions.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np

from torchcrf_scan.data.annotate import STATIC, Capture, annotate
from torchcrf_scan.data.laser import Hits, beam_bearings, cast, in_view, measure
from torchcrf_scan.data.world import Mover, Shapes, Viewer, World, draw_mover, indoor, littered, street
from torchcrf_scan.data.worlds import SimulatorConfig
from torchcrf_scan.errors import TorchCRFScanError
from torchcrf_scan.geometry import se2
from torchcrf_scan.scan import Bools, Floats, Ints, ScanPair

ORIGIN = "torchcrf_scan simulator"

FARTHEST_WORLD = {"street": 90.0, "indoor": 25.0}  # metres of world ahead of the sensor
TURNING_RADIUS = 4.5  # metres, minimum of a car; robots turn on the spot
INDOOR_SPEED = 1.5  # m/s, the fastest robot
SENSOR_CLEARANCE = 0.3  # metres between movers and the sensor
SWEEP_PARTS = 24  # groups of beams that are cast at the same time, while a sensor sweeps
LEAST_SEEN = 3  # minimum number of returns of a mover when it enters
ENTRY_TRIES = {"any": 12, "truck": 80, "slider": 40, "passer": 40}
TRUCK_SHARE = (0.4, 0.5)  # of the returns


def _longest_step(config: SimulatorConfig) -> float:
    """Maximum travel of the sensor per pair, metres at full size."""
    return config.ego_translation if config.scene == "street" else min(config.ego_translation, INDOOR_SPEED * config.dt)


def _ego_path(config: SimulatorConfig, world: World, pairs: int, is_straight: bool, rng: np.random.Generator) -> Floats:
    """(pairs + 1, 3) poses of the sensor along the world: constant speed, and turns as large as the world allows."""
    speed = _longest_step(config) * (rng.triangular(0.0, 0.1, 1.0) if rng.random() < 0.9 else 0.0)
    limit = min(config.ego_rotation, speed / TURNING_RADIUS) if world.is_street else config.ego_rotation
    bend = limit * (0.1 if is_straight or rng.random() < 0.6 else rng.uniform(0.2, 1.0))
    start = np.array([0.0, 0.0, world.lane + rng.normal(0, 0.1) * world.half_width])
    widest = world.half_width * (0.85 if world.is_street else 0.4)
    for calmed in (1.0, 0.7, 0.5, 0.3, 0.1, 0.0):
        path = _steer(start, world, pairs, speed, calmed * bend, limit, rng)
        if np.abs(path[:, 2]).max() < widest:
            break
    return path


def _steer(start: Floats, world: World, pairs: int, speed: float, bend: float, limit: float, rng: np.random.Generator) -> Floats:
    """(pairs + 1, 3) poses from `start` on: random turns of about `bend` per pair, steered back to the lane."""
    pose = start + np.array([rng.normal(0, 0.3) * bend, 0.0, 0.0])
    poses, turn = [pose], bend * -np.sign(pose[2])  # a large turn leads across the road, not into the parked cars
    for _ in range(pairs):
        turn = np.clip(0.8 * turn + 0.4 * rng.normal() * bend, -bend, bend)
        steering = 0.3 * pose[0] + 0.1 * speed * (pose[2] - world.lane) / world.half_width
        theta = np.clip(turn - steering, -limit, limit)
        chord = speed * rng.uniform(0.9, 1.0)
        pose = se2.compose(pose, np.array([theta, chord * np.cos(theta / 2), chord * np.sin(theta / 2)]))
        poses.append(pose)
    return np.stack(poses)


@dataclass(frozen=True, slots=True)
class Part:
    """Beams that are cast together.

    Attributes:
        beams: their indices. late: seconds from the middle of the sweep to their time.
        pose: (3,) of the sensor in the world at that time.
    """

    beams: slice
    late: float
    pose: Floats

    @property
    def from_world(self) -> Floats:
        """(3,) motion of the world into the sensor's frame."""
        return se2.inverse(self.pose)


@dataclass
class _Drive:
    """A sequence under construction: the world, the sensor's path (T, 3) at `times` (T,), and the kinds of movers wanted.

    A mover that has been out of sight for more than `patience` scans is replaced by a new one.
    """

    config: SimulatorConfig
    rng: np.random.Generator
    world: World
    path: Floats
    times: Floats
    kinds: list[str]
    patience: int = 0
    movers: dict[int, Mover] = field(default_factory=dict)  # by index in `kinds`
    unseen: dict[int, int] = field(default_factory=dict)  # scans since it was seen, by number
    born: int = 0
    sweep: list[Part] = field(default_factory=list)  # of the present scan

    def capture(self, i: int) -> Capture:
        """The scan at time i; movers that were out of sight for too long (all, at first) are replaced by new ones."""
        config, rng, self.sweep = self.config, self.rng, self._sweep(i)
        hits = self._cast(lambda _: self.world.shapes, STATIC, i)
        for mover in self.movers.values():
            hits = hits.nearer(self._cast(mover.at, mover.number, i))
        for place, kind in enumerate(self.kinds):
            if place not in self.movers:
                hits = self._enter(place, kind, i, hits)
        movers = tuple(self.movers.values())
        scan, beam, body, spacing = measure(hits, config, rng)
        self.unseen = {m.number: 0 if (body == m.number).any() else self.unseen.get(m.number, 0) + 1 for m in movers}
        self.movers = {place: mover for place, mover in self.movers.items() if self.unseen[mover.number] <= self.patience}
        settled = self._settle(scan.points, beam, body, i, movers)
        return Capture(scan, body, spacing, settled, self.times[i], self.path[i], movers)

    def _sweep(self, i: int) -> list[Part]:
        """The parts of the scan at time i; a single one where the sensor does not sweep."""
        config, step = self.config, min(i, len(self.times) - 2)
        if config.sweep == 0:
            return [Part(slice(0, config.beams), 0.0, self.path[i])]
        edges = np.linspace(0, config.beams, SWEEP_PARTS + 1).round().astype(int)
        edges = edges[np.append(True, np.diff(edges) > 0)]
        late = config.sweep * ((edges[:-1] + edges[1:]) / (2 * config.beams) - 0.5)
        onwards = se2.compose(se2.inverse(self.path[step]), self.path[step + 1])  # the last step goes on at the end
        poses = se2.compose(np.broadcast_to(self.path[i], (len(late), 3)), late[:, None] / config.dt * onwards)
        return [Part(slice(a, b), *of) for (a, b), *of in zip(pairwise(edges), late.tolist(), poses, strict=True)]

    def _cast(self, outlines: Callable[[float], Shapes], body: int, i: int) -> Hits:
        """The hits of all beams on the outlines that a body has at a time, seconds."""
        bearings, reach = beam_bearings(self.config)[0], self.config.range_max / self.config.scale
        found = []
        for part in self.sweep:
            shapes = outlines(self.times[i] + part.late).moved(part.from_world)
            shapes = in_view(shapes, reach, self.config.fov) if body == STATIC else shapes
            found.append(cast(shapes, bearings[part.beams], body, self.rng))
        return Hits(*(np.concatenate([getattr(of, name) for of in found]) for name in ("ranges", "cosine", "body")))

    def _settle(self, points: Floats, beam: Ints, body: Ints, i: int, movers: tuple[Mover, ...]) -> Floats:
        """(n, 2) the returns (n, 2) where their bodies would have been seen, had all beams been cast at time i."""
        settled, now, by_number = points.copy(), self.times[i], {m.number: m for m in movers}
        for part in self.sweep if self.config.sweep > 0 else []:
            in_part = (beam >= part.beams.start) & (beam < part.beams.stop)
            for number in np.unique(body[in_part]).tolist():
                mover, on = by_number.get(number), in_part & (body == number)
                carry = se2.compose(mover.pose(now), se2.inverse(mover.pose(now + part.late))) if mover else np.zeros(3)
                motion = se2.compose(se2.inverse(self.path[i]), se2.compose(carry, part.pose))
                settled[on] = se2.apply(motion * np.array([1.0, self.config.scale, self.config.scale]), points[on])
        return settled

    def _enter(self, place: int, kind: str, i: int, hits: Hits) -> Hits:
        """Places a new mover, if one of a few random ones is visible and unobstructed; returns the new hits."""
        step = min(i, len(self.times) - 2)
        speed = float(np.hypot(*(self.path[step + 1] - self.path[step])[1:])) / self.config.dt
        viewer = Viewer(self.path[i], speed, self.config.fov > 200)
        obstacles = self._obstacles(i)
        for _ in range(ENTRY_TRIES[kind]):
            mover = draw_mover(self.rng, self.world, viewer, self.born + 1, float(self.times[i]), kind)
            if not _is_clear(mover, obstacles, self.times[i:]):
                continue
            seen = hits.nearer(self._cast(mover.at, mover.number, i))
            if self._is_seen(seen, mover.number, kind):
                self.movers[place] = mover
                self.born += 1
                return seen
        return hits

    def _is_seen(self, hits: Hits, number: int, kind: str) -> bool:
        returns: Bools = hits.ranges < self.config.range_max / self.config.scale
        n_mover = int(np.count_nonzero(returns & (hits.body == number)))
        if kind == "truck":
            return bool(TRUCK_SHARE[0] <= n_mover / max(int(np.count_nonzero(returns)), 1) <= TRUCK_SHARE[1])
        return bool(n_mover >= min(LEAST_SEEN, self.config.beams))

    def _obstacles(self, i: int) -> tuple[Floats, Floats]:
        """(O, T - i, 2) positions of the sensor and the other movers from time i on, and (O, 2) their half sizes."""
        movers = self.movers.values()
        paths = [self.path[i:, 1:], *(mover.pose(self.times[i:])[:, 1:] for mover in movers)]
        return np.stack(paths), np.stack([np.full(2, SENSOR_CLEARANCE), *(mover.half_size for mover in movers)])


def _is_clear(mover: Mover, obstacles: tuple[Floats, Floats], times: Floats) -> bool:
    """Whether the mover never collides with an obstacle; (O, T, 2) and (O, 2) of these, at `times` (T,)."""
    paths, half_sizes = obstacles
    relative = se2.apply(se2.inverse(mover.pose(times)), paths[:, :, None])[:, :, 0]  # (O, T, 2) in the mover's frame
    reach = mover.half_size + half_sizes[:, None]
    return not (np.abs(relative) < reach).all(-1).any()


def simulate_sequence(config: SimulatorConfig, pairs: int, rng: np.random.Generator, patience: int = 0) -> list[Capture]:
    """The pairs + 1 scans of one drive. patience: scans for which a mover that is out of sight stays in the world."""
    n_movers = int(rng.integers(config.movers_min, config.movers_max, endpoint=True))
    special = [kind for kind, p in (("truck", config.dominant_mover), ("slider", config.aperture)) if rng.random() < p]
    special += ["passer"] if config.passer > 0 and rng.random() < config.passer else []
    kinds = (special + ["any"] * max(n_movers - len(special), 0))[: config.movers_max]
    beyond = min(config.range_max / config.scale, FARTHEST_WORLD[config.scene]) * rng.uniform(0.4, 1.0)
    build = street if config.scene == "street" else indoor
    start, end = -beyond if config.fov > 180 else -20.0, pairs * _longest_step(config) + beyond
    world = build(rng, start, end, config.clutter)
    world = littered(rng, world, start, end, config.litter) if config.litter > 0 else world
    path = _ego_path(config, world, pairs, "truck" in kinds, rng)
    drive = _Drive(config, rng, world, path, config.dt * np.arange(pairs + 1, dtype=np.float64), kinds, patience)
    return [drive.capture(i) for i in range(pairs + 1)]


def simulate_pairs(config: SimulatorConfig, pairs: int, sequences: int, seed: int) -> list[ScanPair]:
    """Simulates `pairs` annotated pairs in `sequences` drives of (as nearly as possible) equal length.

    The pairs of a drive follow each other: the target scan of one is the source scan of the next. The same arguments give the
    same bytes.

    Raises:
        TorchCRFScanError: fewer than one pair, no drive or more drives than pairs, a negative seed.
    """
    if pairs < 1:
        raise TorchCRFScanError(f"pairs: expected at least 1, got {pairs}")
    if not 1 <= sequences <= pairs:
        raise TorchCRFScanError(f"sequences: expected 1 to pairs = {pairs}, got {sequences}")
    if seed < 0:
        raise TorchCRFScanError(f"seed: expected at least 0, got {seed}")
    simulated = []
    for s in range(sequences):
        length = pairs // sequences + (s < pairs % sequences)
        captures = simulate_sequence(config, length, np.random.default_rng([seed, s]))
        for index, (source, target) in enumerate(pairwise(captures)):
            annotation = annotate(source, target, config)
            scans = source.scan, target.scan, config.dt, annotation
            simulated.append(ScanPair(*scans, sequence=f"sim{seed}_{s}", name=f"sim_s{s}_{index:03d}", origin=ORIGIN))
    return simulated
