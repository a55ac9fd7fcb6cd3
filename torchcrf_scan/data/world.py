"""The simulated worlds and their movers: outlines made of segments and circles, at full size.

A world is built along its x axis, which the sensor follows; `simulate.py` scans it with a laser.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np

from torchcrf_scan.geometry import se2
from torchcrf_scan.scan import Floats

CAR_SPEED = (3.0, 15.0)  # m/s
BOX_CORNER = np.array([0.0, 0.25, 0.5]) * np.pi  # a rounded corner consists of two chords


@dataclass(frozen=True, slots=True)
class Shapes:
    """Outlines in some frame, metres.

    Attributes:
        segments: (S, 4) x, y of both ends.
        circles: (C, 4) x, y, radius and mean free path of a beam inside: 0 for a solid, more for foliage.
    """

    segments: Floats
    circles: Floats

    @classmethod
    def of(cls, segments: Iterable[Floats] = (), circles: Iterable[Floats] = ()) -> Shapes:
        """Joins lists of (S_i, 4) segments and (C_i, 4) circles."""
        return cls(np.concatenate([np.zeros((0, 4)), *segments]), np.concatenate([np.zeros((0, 4)), *circles]))

    def moved(self, motion: Floats) -> Shapes:
        """The outlines after `motion` (3,)."""
        ends = se2.apply(motion, self.segments.reshape(-1, 2)).reshape(-1, 4)
        return Shapes(ends, np.concatenate([se2.apply(motion, self.circles[:, :2]), self.circles[:, 2:]], axis=1))


@dataclass(frozen=True, slots=True)
class World:
    """The static outlines, and the areas in which things may move.

    Attributes:
        shapes: the static outlines, world frame.
        is_street: street or indoor.
        half_width: half the width of the road or corridor, metres.
        lane: y of the lane in which the sensor drives; oncoming traffic takes the opposite one.
        footway: largest |y| at which people walk.
    """

    shapes: Shapes
    is_street: bool
    half_width: float
    lane: float
    footway: float


def polyline(points: Floats) -> Floats:
    """(S, 4) segments through (S+1, 2) points."""
    return np.concatenate([points[:-1], points[1:]], axis=1)


def box(length: float, width: float, radius: float = 0.0) -> Floats:
    """(S, 4) outline of a box around the origin, x along its length, with rounded corners where `radius` > 0."""
    turns = np.arange(4)[:, None] * np.pi / 2
    angles = turns + (BOX_CORNER if radius > 0 else np.zeros(1))
    inner = np.array([length / 2 - radius, width / 2 - radius])
    centres = inner * np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]])
    arcs = centres[:, None, :] + radius * np.stack([np.cos(angles), np.sin(angles)], axis=-1)  # (4, A, 2)
    points = arcs.reshape(-1, 2)
    return polyline(np.concatenate([points, points[:1]]))


def placed(segments: Floats, theta: float, x: float, y: float) -> Floats:
    """The (S, 4) segments after a rotation by `theta` and a translation to (x, y)."""
    return se2.apply(np.array([theta, x, y]), segments.reshape(-1, 2)).reshape(-1, 4)


def disc(x: float, y: float, radius: float, free_path: float = 0.0) -> Floats:
    """One (1, 4) row of `Shapes.circles`."""
    return np.array([[x, y, radius, free_path]])


def _car_outline(rng: np.random.Generator) -> Floats:
    return box(rng.uniform(3.8, 4.9), rng.uniform(1.65, 1.9), rng.uniform(0.3, 0.6))


# --- the street ---------------------------------------------------------------------------------------------------------------


def _facade(rng: np.random.Generator, start: float, end: float, y: float, depth: float) -> Floats:
    """A building front from x = start to end at height y, side walls running `depth` back, with doorways, bays and pilasters."""
    points = [(start, y + depth), (start, y)]
    x = start + rng.uniform(0.5, 4.0)
    while True:
        kind = rng.choice(3)
        width = rng.uniform(*((1.0, 1.4), (2.0, 4.0), (0.3, 0.6))[kind])
        notch = rng.uniform(*((0.15, 0.5), (0.15, 0.6), (-0.3, -0.1))[kind])
        if x + width > end - 0.5:
            break
        points += [(x, y), (x, y + notch), (x + width, y + notch), (x + width, y)]
        x += width + rng.uniform(1.0, 5.0)
    return polyline(np.array([*points, (end, y), (end, y + depth)]))


def _hedge(rng: np.random.Generator, start: float, end: float, y: float) -> Floats:
    """Overlapping bushes in a row: (C, 4) circles that beams penetrate."""
    x = np.arange(start, end, 0.5)
    n = len(x)
    return np.stack([x, y + rng.normal(0, 0.12, n), rng.uniform(0.35, 0.65, n), rng.uniform(0.1, 0.3, n)], axis=1)


def _lots(rng: np.random.Generator, start: float, end: float, y: float, clutter: float) -> Shapes:
    """One side of a street, from x = start to end, its building line at height y: buildings, gardens, gaps and side streets."""
    segments, circles = [], []
    x = start
    while x < end:
        width = rng.uniform(7.0, 20.0)
        front = y + rng.uniform(-0.8, 0.8)
        if rng.random() < 0.15:  # a garden: a wall far back, a hedge in front of it
            segments.append(_facade(rng, x, x + width, y + rng.uniform(4.0, 12.0), 10.0))
            if rng.random() < 0.2 * clutter:
                circles.append(_hedge(rng, x, x + width, front - 0.5))
        else:
            segments.append(_facade(rng, x, x + width, front, rng.uniform(12.0, 40.0)))
            if rng.random() < 0.08 * clutter:
                circles.append(_hedge(rng, x + 1, x + rng.uniform(0.3, 0.9) * width, front - rng.uniform(0.8, 1.5)))
        x += width
        if rng.random() < 0.7:
            gap = rng.uniform(2.0, 6.0) if rng.random() < 0.5 else rng.uniform(8.0, 20.0)
            if rng.random() < 0.2:
                back = y + rng.uniform(5.0, 20.0)
                segments.append(polyline(np.array([(x - 1, back), (x + gap + 1, back)])))
            x += gap
    return Shapes.of(segments, circles)


def _kerb(rng: np.random.Generator, start: float, end: float, y: float, clutter: float) -> Shapes:
    """Trees, lamp posts, bins and bushes along a kerb at height y."""
    circles = []
    x = start + rng.uniform(0, 8)
    while x < end:
        at = y + rng.normal(0, 0.15)
        circles.append(disc(x, at, rng.choice([rng.uniform(0.1, 0.25), rng.uniform(0.05, 0.1), rng.uniform(0.15, 0.3)])))
        if rng.random() < 0.08 * clutter:  # a low crown or shoots around the trunk
            n = rng.integers(2, 5)
            around = np.stack([x + rng.normal(0, 0.6, n), at + rng.normal(0, 0.5, n)], axis=1)
            circles.append(np.concatenate([around, rng.uniform(0.3, 0.8, (n, 1)), rng.uniform(0.2, 0.8, (n, 1))], axis=1))
        x += rng.uniform(8.0, 25.0)
    return Shapes.of((), circles)


def _parked(rng: np.random.Generator, start: float, end: float, y: float) -> Shapes:
    """Cars parked along the road at height y, with gaps."""
    segments = []
    occupancy = rng.uniform(0.1, 0.6)
    for x in np.arange(start, end, 5.8):
        if rng.random() < occupancy:
            segments.append(placed(_car_outline(rng), rng.normal(0, 0.03), x + rng.uniform(-0.4, 0.4), y + rng.normal(0, 0.1)))
    return Shapes.of(segments)


def street(rng: np.random.Generator, start: float, end: float, clutter: float) -> World:
    """A two-lane street from x = start to end, sometimes closed by a building at either end."""
    half_width = rng.uniform(3.3, 4.5)
    parts = []
    for _ in range(2):
        building_line = half_width + rng.uniform(6.0, 18.0)
        parts.append(_lots(rng, start, end, building_line, clutter))
        if rng.random() < 0.5:
            parts.append(_kerb(rng, start, end, half_width + 2.5, clutter))
        if rng.random() < 0.3:
            parts.append(_parked(rng, start, end, half_width + 1.1))
        mirrored = np.array([1.0, -1.0, 1.0, -1.0])
        parts = [Shapes(s.segments * mirrored, s.circles * (1.0, -1.0, 1.0, 1.0)) for s in parts]  # the other side is next
    across = [
        placed(_facade(rng, -40, 40, 0, 5), turn, x, 0) for x, turn in ((end, -np.pi / 2), (start, np.pi / 2)) if rng.random() < 0.3
    ]
    shapes = Shapes.of([*(s.segments for s in parts), *across], [s.circles for s in parts])
    return World(shapes, True, half_width, rng.choice([-0.5, 0.5]) * half_width, half_width + 4.0)


# --- indoors ------------------------------------------------------------------------------------------------------------------


def _furniture(rng: np.random.Generator, x: float, y: float) -> Shapes:
    """One piece at (x, y): a cabinet, a table or chair on four legs, a bin or a potted plant."""
    kind = rng.choice(4)
    if kind == 0:
        return Shapes.of([placed(box(rng.uniform(0.4, 1.6), rng.uniform(0.3, 0.6)), rng.choice([0, np.pi / 2]), x, y)])
    if kind == 1:
        half = rng.uniform((0.2, 0.2), (0.9, 0.5))
        legs = half * np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]])
        turned = se2.apply(np.array([rng.uniform(-np.pi, np.pi), x, y]), legs)
        return Shapes.of((), [np.concatenate([turned, np.tile([0.025, 0.0], (4, 1))], axis=1)])
    return Shapes.of((), [disc(x, y, rng.uniform(0.12, 0.3), 0.0 if kind == 2 else 0.15)])


def _rooms(rng: np.random.Generator, start: float, end: float, y: float) -> Shapes:
    """Rooms along one side of a corridor whose wall is at height y, each with a doorway, some doors shut."""
    parts = []
    x = start
    while x < end:
        width, depth, wall = rng.uniform(3.0, 6.5), rng.uniform(3.0, 6.0), 0.15
        left = x + rng.uniform(0.3, width - 1.5)
        right = left + (rng.uniform(0.85, 1.2) if rng.random() < 0.65 else 0.0)
        front = [[(x, y), (left, y), (left, y + wall)], [(right, y + wall), (right, y), (x + width, y)]]
        behind = [[(x, y), (x, y + depth), (x + width, y + depth)], [(x, y + wall), (left, y + wall)]]
        parts.append(Shapes.of([polyline(np.array(line)) for line in front + behind]))
        if right == left:  # a shut door, a hand's breadth inside its frame
            parts.append(Shapes.of([polyline(np.array([(left, y), (left, y + 0.1), (left + 0.9, y + 0.1), (left + 0.9, y)]))]))
        for _ in range(rng.integers(1, 5)):
            parts.append(_furniture(rng, x + rng.uniform(0.5, width - 0.5), y + rng.uniform(0.8, depth - 0.4)))
        x += width
    return Shapes.of([s.segments for s in parts], [s.circles for s in parts])


def indoor(rng: np.random.Generator, start: float, end: float, clutter: float) -> World:
    """A corridor or hall from x = start to end with rooms on both sides, furniture along its walls, closed at both ends."""
    half_width = rng.choice([rng.uniform(0.9, 1.5), rng.uniform(2.0, 4.5)])
    parts = []
    for _ in range(2):
        parts.append(_rooms(rng, start, end, half_width))
        if half_width > 1.5:
            for x in np.arange(start + 1, end - 1, 2.5):
                if rng.random() < 0.4 * clutter:
                    parts.append(_furniture(rng, x + rng.uniform(-0.8, 0.8), half_width - rng.uniform(0.3, 0.7)))
        mirrored = np.array([1.0, -1.0, 1.0, -1.0])
        parts = [Shapes(s.segments * mirrored, s.circles * (1.0, -1.0, 1.0, 1.0)) for s in parts]
    ends = [np.array([[x, -12.0, x, 12.0]]) for x in (start, end)]
    shapes = Shapes.of([*(s.segments for s in parts), *ends], [s.circles for s in parts])
    return World(shapes, False, half_width, 0.0, 0.7 * half_width)


# --- loose things -------------------------------------------------------------------------------------------------------------


def _bystander(rng: np.random.Generator, x: float, y: float) -> Shapes:
    """The two legs of a person who stands at (x, y)."""
    theta, apart, radius = rng.uniform(-np.pi, np.pi), rng.uniform(0.08, 0.18), rng.uniform(0.05, 0.09)
    aside = apart * np.array([np.cos(theta), np.sin(theta)])
    return Shapes.of((), [disc(x + aside[0], y + aside[1], radius), disc(x - aside[0], y - aside[1], radius)])


def littered(rng: np.random.Generator, world: World, start: float, end: float, litter: float) -> World:
    """The world with `litter` loose things on each ten metres from x = start to end, beside the sensor's way."""
    near, far = (world.half_width + 0.3, world.half_width + 5.0) if world.is_street else (0.5 * world.half_width, world.half_width)
    parts = [world.shapes]
    for _ in range(int(rng.poisson(litter * (end - start) / 10))):
        place = rng.uniform(start, end), rng.choice([-1.0, 1.0]) * rng.uniform(near, far)
        parts.append((_furniture if rng.random() < 0.6 else _bystander)(rng, *place))
    return replace(world, shapes=Shapes.of([s.segments for s in parts], [s.circles for s in parts]))


# --- movers -------------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Mover:
    """A rigid body on a circular arc, with legs that swing.

    Attributes:
        number: its number in the sequence, from 1.
        born: seconds at which it was at `start`.
        start: (3,) its pose in the world.
        shapes: its outlines in its own frame, x ahead.
        speed, turn: m/s and rad/s.
        stride: amplitude of the alternating swing of the circles, metres; 0 for everything on wheels.
    """

    number: int
    born: float
    start: Floats
    shapes: Shapes
    speed: float
    turn: float = 0.0
    stride: float = 0.0

    @property
    def half_size(self) -> Floats:
        """(2,) half length and half width, metres."""
        reach = np.abs(self.shapes.circles[:, :2]) + self.shapes.circles[:, 2:3]
        return np.concatenate([np.abs(self.shapes.segments).reshape(-1, 2), reach]).max(0) + np.array([self.stride, 0.0])

    def pose(self, time: float | Floats) -> Floats:
        """(..., 3) pose in the world at `time` (...) seconds."""
        elapsed = np.asarray(time, dtype=np.float64) - self.born
        half_turn = self.turn * elapsed / 2
        chord = self.speed * elapsed * np.sinc(half_turn / np.pi)
        step = np.stack([2 * half_turn, chord * np.cos(half_turn), chord * np.sin(half_turn)], axis=-1)
        return se2.compose(np.broadcast_to(self.start, step.shape), step)

    def at(self, time: float) -> Shapes:
        """Its outlines in the world at `time`."""
        circles = self.shapes.circles.copy()
        cycle = 2 * np.pi * self.speed * (time - self.born) / 1.4  # two steps take a walker 1.4 m
        circles[:, 0] += self.stride * np.sin(cycle + np.pi * np.arange(len(circles)))
        return Shapes(self.shapes.segments, circles).moved(self.pose(time))


@dataclass(frozen=True, slots=True)
class Viewer:
    """The sensor's state for placing movers: `pose` (3,) in the world, `speed` in m/s, whether its view includes its rear."""

    pose: Floats
    speed: float
    sees_behind: bool


def _ahead(rng: np.random.Generator, viewer: Viewer, near: float, far: float) -> float:
    """An x at `near` to `far` metres from the viewer, also behind it if its view includes its rear."""
    side = -1.0 if viewer.sees_behind and rng.random() < 0.4 else 1.0
    return float(viewer.pose[1] + side * rng.uniform(near, far))


def _car(rng: np.random.Generator, world: World, viewer: Viewer, number: int, time: float) -> Mover:
    kind = rng.random()
    speed, turn = rng.triangular(CAR_SPEED[0], *CAR_SPEED), rng.normal(0, 0.05)
    if kind < 0.4:
        pose = [np.pi, _ahead(rng, viewer, 8, 45), -world.lane]
    elif kind < 0.65:  # overtakes in the other lane
        pose = [0.0, viewer.pose[1] + rng.uniform(-1, 30), -world.lane]
    elif kind < 0.9:  # ahead in the same lane
        pose = [0.0, _ahead(rng, viewer, 8, 40), world.lane]
        speed = np.clip(viewer.speed + rng.uniform(-3, 3), *CAR_SPEED)
    else:  # crosses
        pose = [rng.choice([-0.5, 0.5]) * np.pi, _ahead(rng, viewer, 12, 30), rng.uniform(-6, 6)]
        speed, turn = rng.uniform(3, 8), rng.normal(0, 0.3)
    return Mover(number, time, np.array(pose), Shapes.of([_car_outline(rng)]), float(speed), turn)


def _cyclist(rng: np.random.Generator, world: World, viewer: Viewer, number: int, time: float) -> Mover:
    side = rng.choice([-1.0, 1.0])
    pose = np.array([rng.choice([0.0, np.pi]) + rng.normal(0, 0.1), _ahead(rng, viewer, 5, 25), side * (world.half_width - 0.9)])
    outline = Shapes.of([box(1.7, 0.06)], [disc(-0.1, 0.1, 0.1), disc(0.15, -0.1, 0.1)])
    return Mover(number, time, pose, outline, rng.uniform(3, 7), rng.normal(0, 0.1))


def _walker(rng: np.random.Generator, world: World, viewer: Viewer, number: int, time: float) -> Mover:
    near, far = (4.0, 18.0) if world.is_street else (1.5, 8.0)
    pose = np.array([rng.uniform(-np.pi, np.pi), _ahead(rng, viewer, near, far), rng.uniform(-1, 1) * world.footway])
    return _walking(rng, number, time, pose)


def _passer(rng: np.random.Generator, viewer: Viewer, number: int, time: float) -> Mover:
    """Somebody who walks across the view, so near that the legs hide much of it."""
    bearing, away = rng.uniform(-np.pi / 3, np.pi / 3), rng.uniform(0.55, 1.0)
    across = bearing + rng.choice([-0.5, 0.5]) * np.pi + rng.normal(0, 0.2)
    return _walking(rng, number, time, se2.compose(viewer.pose, np.array([across, away * np.cos(bearing), away * np.sin(bearing)])))


def _walking(rng: np.random.Generator, number: int, time: float, pose: Floats) -> Mover:
    apart, radius = rng.uniform(0.09, 0.13), rng.uniform(0.06, 0.09)
    legs = Shapes.of((), [disc(0, apart, radius), disc(0, -apart, radius)])
    return Mover(number, time, pose, legs, rng.uniform(0.6, 1.8), rng.normal(0, 0.1), stride=rng.uniform(0.03, 0.14))


def _robot(rng: np.random.Generator, world: World, viewer: Viewer, number: int, time: float) -> Mover:
    pose = np.array([rng.uniform(-np.pi, np.pi), _ahead(rng, viewer, 1.2, 7), rng.uniform(-1, 1) * world.footway])
    round_or_box = rng.random() < 0.5
    outline = Shapes.of((), [disc(0, 0, rng.uniform(0.17, 0.3))]) if round_or_box else Shapes.of([box(0.65, 0.5, 0.08)])
    return Mover(number, time, pose, outline, rng.uniform(0.3, 1.2), rng.normal(0, 0.3))


def _beside(rng: np.random.Generator, world: World, viewer: Viewer, number: int, time: float, kind: str) -> Mover:
    """A `truck` or a `slider` (a car of which one side is visible) next to the sensor, on the same course."""
    size = 1.0 if world.is_street else 0.25
    is_truck = kind == "truck"
    length = size * (rng.uniform(8, 14) if is_truck else rng.uniform(4, 5.5))
    width = size * (2.5 if is_truck else 1.8)
    ahead = rng.uniform(-0.6, 0.8) * length if is_truck else rng.uniform(-0.2, 0.4) * length
    aside = np.sign(-world.lane or rng.normal()) * (size * rng.uniform(1.0, 2.5) + width / 2)
    excess = size * (rng.uniform(-1.0, 1.0) if is_truck else rng.choice([-1, 1]) * rng.uniform(1.5, 5.0))
    speed = viewer.speed + excess if viewer.speed + excess > size else size + abs(excess)
    pose = se2.compose(viewer.pose, np.array([0.0, ahead, aside]))
    return Mover(number, time, pose, Shapes.of([box(length, width, 0.1 * size if is_truck else 0.0)]), float(speed))


def draw_mover(rng: np.random.Generator, world: World, viewer: Viewer, number: int, time: float, kind: str = "any") -> Mover:
    """A mover near the viewer: `truck`, `slider`, `passer`, or `any` that is usual in the world."""
    if kind == "passer":
        return _passer(rng, viewer, number, time)
    if kind != "any":
        return _beside(rng, world, viewer, number, time, kind)
    if world.is_street:
        draw = (_car, _cyclist, _walker)[rng.choice(3, p=[0.5, 0.2, 0.3])]
    else:
        draw = (_walker, _robot)[rng.choice(2, p=[0.7, 0.3])]
    return draw(rng, world, viewer, number, time)
