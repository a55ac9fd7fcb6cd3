"""Slow and obvious twins of the search for the background (InitialiseRT): plain float64 Python that shares no code with it.

A scan is a `Surface` made by `surface`.
"""

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import oracles
from oracles import move

Point = Sequence[float]
Motion = Sequence[float]

FLATTEST = math.radians(10.0)  # that a surface is met at
ROUGH, LONELY = 0.1, 0.5  # shares of the spacing
TRUNCATED = 3.0  # units


def lower_median(values: Sequence[float]) -> float:
    return sorted(values)[(len(values) - 1) // 2]


def invert(motion: Motion) -> tuple[float, float, float]:
    """The motion that undoes another."""
    theta, tx, ty = motion
    return (-theta, *move((-theta, 0.0, 0.0), (-tx, -ty)))


def nearest(points: np.ndarray, place: Point) -> tuple[float, int]:
    """Distance to and index of the nearest point, the first of equals."""
    squared = (points[:, 0] - place[0]) ** 2 + (points[:, 1] - place[1]) ** 2
    j = int(squared.argmin())
    return math.sqrt(squared[j]), j


# One scan.


@dataclass(frozen=True)
class Surface:
    """A scan with its geometry; `joined[i]` says that points i and i + 1 (the last one: and 0) lie on one surface."""

    points: np.ndarray
    origin: Point
    noise: float
    closed: bool
    ranges: list[float]
    bearings: list[float]
    step: float
    joined: list[bool]
    spacing: list[float]
    length: list[float]
    tangent: list[tuple[float, float]]
    segment: list[int]

    def __len__(self) -> int:
        return len(self.points)

    @property
    def as_scan(self) -> tuple[Sequence[Sequence[float]], Point, bool, float]:
        """As `oracles.look` takes it."""
        return self.points.tolist(), self.origin, self.closed, self.noise

    @property
    def units(self) -> list[float]:
        """Metres that a well registered point may lie from each."""
        return [spacing / 2 + 2 * self.noise for spacing in self.spacing]


def rising(angle: float) -> float:
    """Counter-clockwise turn below a full one; a hair's breadth back is none."""
    angle %= 2 * math.pi
    return 0.0 if angle > 2 * math.pi - 1e-4 else angle


def surface(points: np.ndarray, noise: float, closed: bool, origin: Point = (0.0, 0.0)) -> Surface:
    """Who is on one surface with whom, and what follows from it."""
    P = len(points)
    ranges = [math.dist(p, origin) for p in points]
    raw = [math.atan2(p[1] - origin[1], p[0] - origin[0]) for p in points]
    bearings = [raw[0]]
    for before, after in itertools.pairwise(raw):
        bearings.append(bearings[-1] + rising(after - before))
    turns = [rising(bearings[(i + 1) % P] - bearings[i]) for i in range(P)]
    step = lower_median([turn for turn in turns[:-1] if turn >= 1e-9] or [math.radians(0.5)])
    gaps = [math.dist(points[i], points[(i + 1) % P]) for i in range(P)]
    joined = []
    for i in range(P):
        near = min(ranges[i], ranges[(i + 1) % P])
        widest = near * math.sin(turns[i]) / math.sin(max(FLATTEST - turns[i], 1e-3)) + 6 * noise
        joined.append(gaps[i] <= widest and turns[i] < FLATTEST * (1 - 1e-4) and (closed or i < P - 1))
    spacing, length, tangent = [], [], []
    for i in range(P):
        footprint = ranges[i] * step
        edges = [next_edge(i - 1, -1, gaps, joined), next_edge(i, 1, gaps, joined)]
        beside = [(gaps[k], points[(k + 1) % P] - points[k]) for k in edges if joined[k]]
        spacing.append(min((gap for gap, _ in beside), default=footprint))
        length.append((sum(gap for gap, _ in beside) + (2 - len(beside)) * footprint) / 2)
        x, y = sum((arm for _, arm in beside), np.zeros(2))
        size = max(math.hypot(x, y), 1e-9)
        tangent.append((x / size, y / size))
    return Surface(points, origin, noise, closed, ranges, bearings, step, joined, spacing, length, tangent, numbered(joined))


def next_edge(k: int, direction: int, gaps: Sequence[float], joined: Sequence[bool]) -> int:
    """The first edge from k on, one way, that leads to a point elsewhere or off the surface."""
    P = len(gaps)
    ways = [(k + direction * n) % P for n in range(P)]
    return next((way for way in ways if gaps[way] > 0 or not joined[way]), k % P)


def numbered(joined: Sequence[bool]) -> list[int]:
    """Number of every point's run; the last run is the first where it goes on there."""
    numbers = [0]
    for is_joined in joined[:-1]:
        numbers.append(numbers[-1] + (not is_joined))
    return [0 if joined[-1] and n == numbers[-1] else n for n in numbers]


def pieces(scan: Surface) -> list[int]:
    """Number of every point's piece: neighbours of a segment that are no more than 2.5 footprints apart."""
    P = len(scan)
    joined = [
        scan.segment[i] == scan.segment[(i + 1) % P]
        and math.dist(scan.points[i], scan.points[(i + 1) % P]) <= 2.5 * scan.ranges[i] * scan.step + 6 * scan.noise
        and (scan.closed or i < P - 1)
        for i in range(P)
    ]
    return numbered(joined)


def sight(scan: Surface, place: Point) -> str:
    """What a scan's beams say of a point: `seen through`, `occluded`, `unmeasured` or `agrees`."""
    about = oracles.beams_about(scan.as_scan, place, scan.step)
    if about is None:
        return "occluded"
    near, far, is_measured, slack = about
    mine = math.dist(place, scan.origin)
    if not is_measured:
        return "unmeasured"
    return "seen through" if mine + slack < near else "occluded" if mine > far + slack else "agrees"


# Two scans.


def unit_length(source: Surface, target: Surface) -> float:
    """Metres: an ordinary registration error."""
    return lower_median([*source.spacing, *target.spacing]) / 2 + 2 * max(source.noise, target.noise)


def point_residual(scan: Surface, place: Point) -> tuple[float, int]:
    """Distance of a point to a scan in local units, truncated, and the nearest point."""
    distance, j = nearest(scan.points, place)
    return min(distance / scan.units[j], TRUNCATED), j


def surface_residual(scan: Surface, place: Point) -> tuple[float, int]:
    """Distance to a scan whose surface goes on for half a spacing along every tangent, in units of roughness and noise."""
    distance, j = nearest(scan.points, place)
    tx, ty = scan.tangent[j]
    gap = place[0] - scan.points[j, 0], place[1] - scan.points[j, 1]
    along = abs(gap[0] * tx + gap[1] * ty)
    beyond, across = max(along - scan.spacing[j] / 2, 0.0), math.sqrt(max(distance**2 - along**2, 0.0))
    rough = LONELY if (tx, ty) == (0, 0) else ROUGH
    return math.hypot(beyond, across) / (rough * scan.spacing[j] + 2 * scan.noise), j


def one_way_cost(motion: Motion, scan: Surface, other: Surface, slack: float = 1.0) -> float:
    """Mean residual of a scan's points in the other, weighted by the surface that they stand for."""
    usual, total, weight = max(lower_median(scan.length), 1e-6), 0.0, 0.0
    for p, length in zip(scan.points, scan.length, strict=True):
        place = move(motion, p)
        residual = surface_residual(other, place)[0] / slack
        if residual >= TRUNCATED:
            charge = {"seen through": TRUNCATED + 3.0, "agrees": TRUNCATED, "occluded": 1.5, "unmeasured": 1.5}
            residual = charge[sight(other, place)]
        share = min(max(length / usual, 0.1), 10.0)
        total, weight = total + share * residual, weight + share
    return total / weight


def background_cost(motion: Motion, source: Surface, target: Surface, slack: float = 1.0) -> float:
    return one_way_cost(motion, source, target, slack) + one_way_cost(invert(motion), target, source, slack)


def gauss_newton_step(
    moved: np.ndarray, partner: np.ndarray, tangent: np.ndarray, weights: np.ndarray, along: float, damping: float = 1e-10
) -> tuple[float, float, float]:
    """Solves the damped normal equations of sum w r^T (I - (1 - along) t t^T) r; turns about the weighted centre, 0.5 at most."""
    total = max(float(weights.sum()), 1e-9)
    centre = (weights[:, None] * moved).sum(0) / total
    normal, right, lever = np.zeros((3, 3)), np.zeros(3), 0.0
    for p, q, t, w in zip(moved, partner, tangent, weights, strict=True):
        x, y = p - centre
        jacobian = np.array([[-y, 1.0, 0.0], [x, 0.0, 1.0]])
        metric = w * (np.eye(2) - (1 - along) * np.outer(t, t))
        normal += jacobian.T @ metric @ jacobian
        right -= jacobian.T @ metric @ (p - q)
        lever += w * (x * x + y * y)
    normal += np.diag([1e-4 * lever + damping * total, 1e-3 * total, 1e-3 * total])
    theta, dx, dy = np.linalg.solve(normal, right)
    theta = min(max(theta, -0.5), 0.5)
    back = move((theta, 0.0, 0.0), centre)
    return theta, centre[0] - back[0] + dx, centre[1] - back[1] + dy


def follow(motion: Motion, step: Motion) -> tuple[float, float, float]:
    """A motion, then a step."""
    return (oracles.wrap(motion[0] + step[0]), *move(step, motion[1:]))


def robust(residual: float, gate: float) -> float:
    """Geman-McClure weight."""
    return 1 / (1 + (residual / gate) ** 2) ** 2


def register(
    points: np.ndarray, weights: np.ndarray, target: Surface, motion: Motion, gates: Sequence[float], along: Sequence[float]
) -> Motion:
    """Points (P, 2) on nearest target points, by steps with narrowing gates."""
    for gate, slack in zip(gates, along, strict=True):
        moved = np.array([move(motion, p) for p in points])
        pairs = [nearest(target.points, p) for p in moved]
        trust = [robust(distance, gate + target.spacing[j] / 2) for distance, j in pairs]
        partner, tangent = (np.array([of[j] for _, j in pairs]) for of in (target.points, target.tangent))
        motion = follow(motion, gauss_newton_step(moved, partner, tangent, weights * trust, slack))
    return motion


def register_both(source: Surface, target: Surface, motion: Motion, gates: Sequence[float], along: Sequence[float]) -> Motion:
    """Both scans on each other in one step, weighted by the residual to the other's surface."""
    for gate, slack in zip(gates, along, strict=True):
        moved = [move(motion, p) for p in source.points]
        rows = []
        for p in moved:
            residual, j = surface_residual(target, p)
            rows.append((p, target.points[j], target.tangent[j], robust(residual, gate)))
        for q in target.points:
            residual, i = surface_residual(source, move(invert(motion), q))
            rows.append((moved[i], q, move((motion[0], 0.0, 0.0), source.tangent[i]), robust(residual, gate)))
        motion = follow(motion, gauss_newton_step(*(np.array(column) for column in zip(*rows, strict=True)), slack))
    return motion
