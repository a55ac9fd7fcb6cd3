"""Simulated scan pairs with exact annotation: a laser drives through a world of `world.py`.

Worlds, poses and ray casting are at full size; `SimulatorConfig.scale` is applied to measured ranges and motions.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np

from torchcrf_scan.data.world import Mover, Shapes, Viewer, World, draw_mover, indoor, littered, street
from torchcrf_scan.data.worlds import SimulatorConfig
from torchcrf_scan.geometry import se2
from torchcrf_scan.scan import MAX_RANGE_MARGIN, OUTLIER, Annotation, Bools, Floats, Ints, Scan, ScanPair

ORIGIN = "torchcrf_scan simulator"
STATIC = 0  # bodies in a scan: the static world, movers by number, and returns of no single body
NO_BODY = -1
UNSEEN = -2  # a body of the target that is not visible in the source
UNKNOWN = -3  # a body that is left out of the annotation

FARTHEST_WORLD = {"street": 90.0, "indoor": 25.0}  # metres of world ahead of the sensor
TURNING_RADIUS = 4.5  # metres, minimum of a car; robots turn on the spot
INDOOR_SPEED = 1.5  # m/s, the fastest robot
VIBRATION_KNOTS = np.radians(8.0)  # angle over which neighbouring beams share a jolt
MIXED_JUMP = (0.3, 6.0)  # metres at full size; ranges this far apart merge in one beam; farther ones give two separate echoes
GRAZING_COSINE = 0.03  # loss of grazing beams: exp(-cosine / this)
LEAST_COSINE = 0.1  # the spacing of returns on a surface is limited to ten times that at normal incidence
GATE = 3.2  # times half the scan's usual spacing plus twice its noise; annotators of recordings use one gate for a whole scan
LEAST_MOTION = 0.02  # metres at full size; bodies that move less within a pair are static
SENSOR_CLEARANCE = 0.3  # metres between movers and the sensor
SWEEP_PARTS = 24  # groups of beams that are cast at the same time, while a sensor sweeps
LEAST_SEEN = 3  # minimum number of returns of a mover when it enters
ENTRY_TRIES = {"any": 12, "truck": 80, "slider": 40}
TRUCK_SHARE = (0.4, 0.5)  # of the returns


# --- casting ------------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Hits:
    """The first hit of every beam, at full size: (B,) `ranges` (inf: none), `cosine` of incidence, and `body`."""

    ranges: Floats
    cosine: Floats
    body: Ints

    def nearer(self, other: Hits) -> Hits:
        """The nearer of the two, beam by beam."""
        closer = other.ranges < self.ranges
        pairs = ((self.ranges, other.ranges), (self.cosine, other.cosine), (self.body, other.body))
        return Hits(*(np.where(closer, theirs, ours) for ours, theirs in pairs))


def _segment_ranges(segments: Floats, directions: Floats) -> Floats:
    """(B, S) ranges at which beams from the origin meet segments (S, 4), else inf; directions: (B, 2)."""
    a, edge = segments[:, :2], segments[:, 2:] - segments[:, :2]
    dx, dy = directions[:, :1], directions[:, 1:]
    with np.errstate(divide="ignore", invalid="ignore"):  # parallel beams divide by zero and fail all comparisons below
        inverse = 1.0 / (dx * edge[:, 1] - dy * edge[:, 0])
        ranges = (a[:, 0] * edge[:, 1] - a[:, 1] * edge[:, 0]) * inverse
        along = (a[:, 0] * dy - a[:, 1] * dx) * inverse
        return np.where((ranges > 0) & (along >= 0) & (along <= 1), ranges, np.inf)


def _circle_ranges(circles: Floats, directions: Floats, rng: np.random.Generator) -> Floats:
    """(B, C) ranges at which beams meet circles (C, 4); in foliage they end at a random depth, or pass through."""
    along = directions @ circles[:, :2].T
    half_squared = circles[:, 2] ** 2 - (circles[:, :2] ** 2).sum(1) + along**2
    half = np.sqrt(np.maximum(half_squared, 0))
    ranges = along - half
    hit = (half_squared > 0) & (ranges > 0)
    leafy = np.flatnonzero(circles[:, 3] > 0)
    depth = rng.standard_exponential((len(directions), len(leafy))) * circles[leafy, 3]
    hit[:, leafy] &= depth < 2 * half[:, leafy]
    ranges[:, leafy] += depth
    return np.where(hit, ranges, np.inf)


def cast(shapes: Shapes, bearings: Floats, body: int, rng: np.random.Generator) -> Hits:
    """Casts every beam (B,) from the origin onto shapes in the sensor's frame. O(B (S + C))."""
    directions = np.stack([np.cos(bearings), np.sin(bearings)], axis=1)
    n_segments, n_shapes = len(shapes.segments), len(shapes.segments) + len(shapes.circles)
    nothing = np.full((len(bearings), 1), np.inf)
    ranges = [_segment_ranges(shapes.segments, directions), _circle_ranges(shapes.circles, directions, rng), nothing]
    table = np.concatenate(ranges, axis=1)  # (B, S + C + 1)
    nearest = table.argmin(1)
    reached = table[np.arange(len(bearings)), nearest]
    nearest[np.isinf(reached)] = n_shapes
    cosine = np.ones(len(bearings))  # foliage has no orientation

    on = np.flatnonzero(nearest < n_segments)
    edge = shapes.segments[nearest[on], 2:] - shapes.segments[nearest[on], :2]
    cross = directions[on, 0] * edge[:, 1] - directions[on, 1] * edge[:, 0]
    cosine[on] = np.abs(cross) / np.hypot(edge[:, 0], edge[:, 1])

    on = np.flatnonzero((nearest >= n_segments) & (nearest < n_shapes))
    circle = shapes.circles[nearest[on] - n_segments]
    on, circle = on[circle[:, 3] == 0], circle[circle[:, 3] == 0]
    outward = directions[on] * reached[on, None] - circle[:, :2]
    cosine[on] = np.abs((directions[on] * outward).sum(1)) / circle[:, 2]
    return Hits(reached, cosine, np.full(len(bearings), body))


def _in_view(shapes: Shapes, reach: float, fov: float) -> Shapes:
    """Culls shapes that no beam can meet, such as most of a long street. shapes: in the sensor's frame."""
    ends = shapes.segments.reshape(-1, 2, 2)
    near = np.hypot(*(ends.mean(1)).T) < reach + np.hypot(*(ends[:, 1] - ends[:, 0]).T) / 2
    near_circles = np.hypot(shapes.circles[:, 0], shapes.circles[:, 1]) < reach + shapes.circles[:, 2]
    if fov <= 180:
        near &= ends[:, :, 0].max(1) > 0
        near_circles &= shapes.circles[:, 0] + shapes.circles[:, 2] > 0
    return Shapes(shapes.segments[near], shapes.circles[near_circles])


# --- the sensor ---------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Capture:
    """One scan with the state of the simulation.

    Attributes:
        scan: the valid returns, n of them.
        body: (n,) their bodies: `STATIC`, a mover's number, or `NO_BODY`.
        spacing: (n,) metres between neighbouring returns on the surface there.
        settled: (n, 2) their places in the sensor's frame had all beams been cast at `time`.
        time: seconds, of the middle of the sweep.
        ego: (3,) the sensor's pose in the world, at full size.
        movers: those in the world at this time, visible or not.
    """

    scan: Scan
    body: Ints
    spacing: Floats
    settled: Floats
    time: float
    ego: Floats
    movers: tuple[Mover, ...]


def beam_bearings(config: SimulatorConfig) -> tuple[Floats, float]:
    """(beams,) bearings of the sensor and the angle between neighbours, radians; a single beam looks ahead."""
    fov = np.radians(config.fov)
    step = fov / config.beams if config.fov == 360 else fov / max(config.beams - 1, 1)
    first = -fov / 2 if config.beams > 1 else 0.0
    return first + step * np.arange(config.beams), float(step)


def _mix_edges(ranges: Floats, body: Ints, config: SimulatorConfig, rng: np.random.Generator) -> tuple[Floats, Ints]:
    """Mixed pixels: at some depth edges a beam returns a range between both surfaces, which belongs to no body."""
    with np.errstate(invalid="ignore"):
        jump = np.diff(ranges)  # inf - inf is nan: no edge
        is_edge = (np.abs(jump) > MIXED_JUMP[0]) & (np.abs(jump) < MIXED_JUMP[1]) & (rng.random(len(jump)) < config.mixed_pixels)
    edge = np.flatnonzero(is_edge)
    far = edge + (jump[edge] > 0)
    near = ranges[edge + (jump[edge] <= 0)]
    mixed, bodies = ranges.copy(), body.copy()
    mixed[far] = near + rng.uniform(0.1, 0.9, len(edge)) * np.abs(jump[edge])
    bodies[far] = NO_BODY
    return mixed, bodies


def _noise(bearings: Floats, config: SimulatorConfig, rng: np.random.Generator) -> Floats:
    """(B,) range noise of the beams plus the vibration shared by neighbours, metres."""
    knots = np.arange(bearings[0] - VIBRATION_KNOTS, bearings[-1] + 2 * VIBRATION_KNOTS, VIBRATION_KNOTS)
    jolts = np.interp(bearings, knots, rng.normal(0, config.vibration, len(knots)))
    return rng.normal(0, config.range_noise, len(bearings)) + jolts


def _measure(hits: Hits, config: SimulatorConfig, rng: np.random.Generator) -> tuple[Scan, Ints, Ints, Floats]:
    """The measured scan of `hits`, and beam, body and spacing (n,) of its returns."""
    bearings, step = beam_bearings(config)
    ranges, body = _mix_edges(hits.ranges, hits.body, config, rng)
    ranges = config.scale * ranges + _noise(bearings, config, rng)
    grazing = np.exp(-hits.cosine / GRAZING_COSINE)
    lost = rng.random(len(ranges)) < config.dropout + (1 - config.dropout) * grazing
    keep = np.flatnonzero(~lost & (ranges > config.range_min) & (ranges < config.range_max - MAX_RANGE_MARGIN))
    limits = {"range_min": config.range_min, "range_max": config.range_max, "range_noise": config.range_noise}
    limits = limits if config.states_limits else {}
    scan = Scan.from_ranges(ranges[keep], bearings[keep], **limits)
    assert len(scan) == len(keep)
    return scan, keep, body[keep], scan.ranges * step / np.maximum(hits.cosine[keep], LEAST_COSINE)


# --- annotation ---------------------------------------------------------------------------------------------------------------


def association_gate(spacing: Floats, config: SimulatorConfig) -> float:
    """Maximum distance of a moved return to its counterpart, metres; spacing: (M,) of the target scan, not empty."""
    noise = float(np.hypot(config.range_noise, config.vibration))
    return GATE * (float(np.median(spacing)) / 2 + 2 * noise)


def _associate(moved: Floats, seen: Floats, body: Ints, target: Capture, target_body: Ints, config: SimulatorConfig) -> Ints:
    """(N,) the target return of the same body that was seen nearest, of those truly within the gate, or -1. O(N M).

    Args:
        moved, seen: (N, 2) the moved source returns, where they were had the sweep taken no time, and as they were measured.
    """
    association = np.full(len(moved), OUTLIER)
    if not len(moved) or not len(target_body):
        return association
    is_near = _distances(moved, target.settled) <= association_gate(target.spacing, config)
    distance = np.where((body[:, None] == target_body) & is_near, _distances(seen, target.scan.points), np.inf)
    nearest = distance.argmin(1)
    found = np.isfinite(distance[np.arange(len(moved)), nearest])
    association[found] = nearest[found]
    return association


def _distances(points: Floats, others: Floats) -> Floats:
    """(N, M) distances between (N, 2) and (M, 2) points."""
    offset = points[:, None, :] - others  # (N, M, 2)
    return np.hypot(offset[..., 0], offset[..., 1])


def annotate(source: Capture, target: Capture, config: SimulatorConfig) -> Annotation:
    """Ground truth of every source return, from the true motions of the sensor and of every body."""
    table, label = _bodies(source, target, config)
    body = np.array([label[b] for b in source.body], dtype=np.int64)
    target_body = np.array([label.get(b, UNSEEN) for b in target.body], dtype=np.int64)
    motion = table[np.maximum(body, 0)]
    moved, seen = (se2.rotate(motion[:, 0], points) + motion[:, 1:] for points in (source.settled, source.scan.points))
    partner = np.where(body < 0, OUTLIER, _associate(moved, seen, body, target, target_body, config))
    ignore = body == UNKNOWN
    body = np.where((body < 0) | ((source.body == NO_BODY) & (partner == OUTLIER)), NO_BODY, body)
    return Annotation(partner, np.where(partner == OUTLIER, OUTLIER, body), table, body, ignore)


def _bodies(source: Capture, target: Capture, config: SimulatorConfig) -> tuple[Floats, dict[int, int]]:
    """(K + 1, 3) motions of the background and of the annotated movers, and the label of every body of the source."""
    scale = np.array([1.0, config.scale, config.scale])
    motions = [se2.compose(se2.inverse(target.ego), source.ego) * scale]
    label = {STATIC: 0, NO_BODY: 0 if config.matches_mixed else NO_BODY}
    least = config.least_travel * (association_gate(target.spacing, config) if config.least_travel and len(target.spacing) else 0.0)
    for mover in source.movers:
        before, after = mover.pose(source.time), mover.pose(target.time)
        if np.hypot(*(after - before)[1:]) < LEAST_MOTION and abs(se2.wrap(after[0] - before[0])) < LEAST_MOTION:
            label[mover.number] = 0
            continue
        points = source.settled[source.body == mover.number]
        to_world = se2.compose(after, se2.inverse(before))
        motion = se2.compose(se2.inverse(target.ego), se2.compose(to_world, source.ego)) * scale
        travel = np.hypot(*(se2.apply(motion, points) - se2.apply(motions[0], points)).T)
        if len(points) and travel.max() < least:
            label[mover.number] = UNKNOWN
        elif len(points):
            label[mover.number] = len(motions)
            motions.append(motion)
    return np.stack(motions), label


# --- sequences ----------------------------------------------------------------------------------------------------------------


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


@dataclass
class _Drive:
    """A sequence under construction: the world, the sensor's path (T, 3) at `times` (T,), and the kinds of movers wanted."""

    config: SimulatorConfig
    rng: np.random.Generator
    world: World
    path: Floats
    times: Floats
    kinds: list[str]
    movers: dict[int, Mover] = field(default_factory=dict)  # by index in `kinds`
    born: int = 0

    def capture(self, i: int) -> Capture:
        """The scan at time i; movers that were not visible in the scan before (all, at first) are replaced by new ones."""
        config, rng = self.config, self.rng
        hits = self._cast(lambda _: self.world.shapes, STATIC, i)
        for mover in self.movers.values():
            hits = hits.nearer(self._cast(mover.at, mover.number, i))
        for place, kind in enumerate(self.kinds):
            if place not in self.movers:
                hits = self._enter(place, kind, i, hits)
        movers = tuple(self.movers.values())
        scan, beam, body, spacing = _measure(hits, config, rng)
        self.movers = {place: mover for place, mover in self.movers.items() if (body == mover.number).any()}
        settled = self._settle(scan.points, beam, body, i, movers)
        return Capture(scan, body, spacing, settled, self.times[i], self.path[i], movers)

    def _sweep(self) -> list[tuple[slice, float]]:
        """The beams that are cast together, and the seconds from the middle of the sweep to their time."""
        if self.config.sweep == 0:
            return [(slice(0, self.config.beams), 0.0)]
        edges = np.linspace(0, self.config.beams, SWEEP_PARTS + 1).round().astype(int)
        return [(slice(a, b), self.config.sweep * ((a + b) / (2 * self.config.beams) - 0.5)) for a, b in pairwise(edges) if a < b]

    def _pose(self, i: int, late: float) -> Floats:
        """(3,) the sensor's pose `late` seconds after time i, at the speed of the step from there (of the last, at the end)."""
        if late == 0:
            pose: Floats = self.path[i]
            return pose
        step = min(i, len(self.times) - 2)
        return se2.compose(self.path[i], late / self.config.dt * se2.compose(se2.inverse(self.path[step]), self.path[step + 1]))

    def _cast(self, outlines: Callable[[float], Shapes], body: int, i: int) -> Hits:
        """The hits of all beams on the outlines that a body has at a time, seconds."""
        bearings, reach = beam_bearings(self.config)[0], self.config.range_max / self.config.scale
        parts = []
        for beams, late in self._sweep():
            shapes = outlines(self.times[i] + late).moved(se2.inverse(self._pose(i, late)))
            shapes = _in_view(shapes, reach, self.config.fov) if body == STATIC else shapes
            parts.append(cast(shapes, bearings[beams], body, self.rng))
        return Hits(*(np.concatenate([getattr(part, name) for part in parts]) for name in ("ranges", "cosine", "body")))

    def _settle(self, points: Floats, beam: Ints, body: Ints, i: int, movers: tuple[Mover, ...]) -> Floats:
        """(n, 2) the returns (n, 2) where their bodies would have been seen, had all beams been cast at time i."""
        settled, now = points.copy(), self.times[i]
        for beams, late in self._sweep() if self.config.sweep > 0 else []:
            in_part = (beam >= beams.start) & (beam < beams.stop)
            carried = [(STATIC, np.zeros(3)), (NO_BODY, np.zeros(3))]
            carried += [(m.number, se2.compose(m.pose(now), se2.inverse(m.pose(now + late)))) for m in movers]
            for number, carry in carried:
                on = in_part & (body == number)
                motion = se2.compose(se2.inverse(self.path[i]), se2.compose(carry, self._pose(i, late)))
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


def _simulate_sequence(config: SimulatorConfig, pairs: int, rng: np.random.Generator) -> list[Capture]:
    """The pairs + 1 scans of one drive."""
    n_movers = int(rng.integers(config.movers_min, config.movers_max, endpoint=True))
    special = [kind for kind, p in (("truck", config.dominant_mover), ("slider", config.aperture)) if rng.random() < p]
    kinds = (special + ["any"] * max(n_movers - len(special), 0))[: config.movers_max]
    beyond = min(config.range_max / config.scale, FARTHEST_WORLD[config.scene]) * rng.uniform(0.4, 1.0)
    build = street if config.scene == "street" else indoor
    start, end = -beyond if config.fov > 180 else -20.0, pairs * _longest_step(config) + beyond
    world = build(rng, start, end, config.clutter)
    world = littered(rng, world, start, end, config.litter) if config.litter > 0 else world
    path = _ego_path(config, world, pairs, "truck" in kinds, rng)
    drive = _Drive(config, rng, world, path, config.dt * np.arange(pairs + 1, dtype=np.float64), kinds)
    return [drive.capture(i) for i in range(pairs + 1)]


def simulate_pairs(config: SimulatorConfig, pairs: int, sequences: int, seed: int) -> list[ScanPair]:
    """Simulates `pairs` annotated pairs in `sequences` drives of (as nearly as possible) equal length.

    The pairs of a drive follow each other: the target scan of one is the source scan of the next. The same arguments give the
    same bytes.

    Raises:
        ValueError: fewer than one pair, no drive or more drives than pairs, a negative seed.
    """
    if pairs < 1:
        raise ValueError(f"pairs: expected at least 1, got {pairs}")
    if not 1 <= sequences <= pairs:
        raise ValueError(f"sequences: expected 1 to pairs = {pairs}, got {sequences}")
    if seed < 0:
        raise ValueError(f"seed: expected at least 0, got {seed}")
    simulated = []
    for s in range(sequences):
        length = pairs // sequences + (s < pairs % sequences)
        captures = _simulate_sequence(config, length, np.random.default_rng([seed, s]))
        for index, (source, target) in enumerate(pairwise(captures)):
            annotation = annotate(source, target, config)
            scans = source.scan, target.scan, config.dt, annotation
            simulated.append(ScanPair(*scans, sequence=f"sim{seed}_{s}", name=f"sim_s{s}_{index:03d}", origin=ORIGIN))
    return simulated
