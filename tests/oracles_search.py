"""Slow and obvious twins of the search for motions (InitialiseRT): plain float64 Python that shares no code with the package.

A scan is a `Surface` made by `surface`, a hypothesis is a motion (theta, tx, ty) and the list of the source points that it moves.
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
OPEN, TRUNCATED, EXPLAINED = 1.5, 3.0, 1.0  # units


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
    step = lower_median(turns[:-1]) if P > 1 else math.radians(0.5)
    gaps = [math.dist(points[i], points[(i + 1) % P]) for i in range(P)]
    joined = []
    for i in range(P):
        near = min(ranges[i], ranges[(i + 1) % P])
        widest = near * math.sin(turns[i]) / math.sin(max(FLATTEST - turns[i], 1e-3)) + 6 * noise
        joined.append(gaps[i] <= widest and turns[i] < FLATTEST * (1 - 1e-4) and (closed or i < P - 1))
    spacing, length, tangent = [], [], []
    for i in range(P):
        footprint = ranges[i] * step
        beside = [(gaps[k], points[(k + 1) % P] - points[k]) for k in (i - 1, i) if joined[k]]
        spacing.append(min((gap for gap, _ in beside), default=footprint))
        length.append((sum(gap for gap, _ in beside) + (2 - len(beside)) * footprint) / 2)
        x, y = sum((arm for _, arm in beside), np.zeros(2))
        size = max(math.hypot(x, y), 1e-9)
        tangent.append((x / size, y / size))
    return Surface(points, origin, noise, closed, ranges, bearings, step, joined, spacing, length, tangent, numbered(joined))


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
    about = oracles.beams_about(scan.as_scan, place)
    if about is None:
        return "occluded"
    near, far, is_measured, slack = about
    mine = math.dist(place, scan.origin)
    if not is_measured:
        return "unmeasured"
    return "seen through" if mine + slack < near else "occluded" if mine > far + slack else "agrees"


# Two scans.


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
    moved: np.ndarray, partner: np.ndarray, tangent: np.ndarray, weights: np.ndarray, along: float
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
    normal += np.diag([1e-4 * lever + 1e-6 * total, 1e-3 * total, 1e-3 * total])
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
    source: Surface, weights: np.ndarray, target: Surface, motion: Motion, gates: Sequence[float], along: Sequence[float]
) -> Motion:
    """Source points on nearest target points, by steps with narrowing gates."""
    for gate, slack in zip(gates, along, strict=True):
        moved = np.array([move(motion, p) for p in source.points])
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


# Sets of points that may be one object.


def ends(members: Sequence[int], count: int) -> tuple[int, int]:
    """First and last of a set, also of one that leads round the seam of `count` points."""
    leads_round = 0 in members and count - 1 in members
    order = sorted(members, key=lambda i: (i + count // 2) % count if leads_round else i)
    return order[0], order[-1]


def groups(scan: Surface, residual: Sequence[float]) -> set[tuple[int, ...]]:
    """All sets of three points or more that may be one object. residual: units that the background leaves."""
    P = len(scan)
    is_open = [r >= OPEN for r in residual]
    of_piece = sets_of(pieces(scan))
    segments = [s for s in sets_of(scan.segment) if any(is_open[i] for i in s)]
    whole = [s for s in of_piece if any(is_open[i] for i in s) or sum(residual[i] for i in s) / len(s) >= 0.9]
    parts = [tuple(i for i in s if is_open[i]) for s in segments]
    parts = [part for part, s in zip(parts, segments, strict=True) if 10 * len(part) < 7 * len(s)]
    alike = [scan.segment[i] == scan.segment[(i + 1) % P] and is_open[i] == is_open[(i + 1) % P] for i in range(P)]
    runs = [s for s in sets_of(numbered([*alike[:-1], alike[-1] and scan.closed])) if any(is_open[i] for i in s)]
    found = [*segments, *whole, *parts, *runs, *pairs_of(scan, segments), *pairs_of(scan, whole)]
    return {s for s in found if len(s) >= 3}


def sets_of(numbers: Sequence[int]) -> list[tuple[int, ...]]:
    """The points of every number, by number."""
    return [tuple(i for i, n in enumerate(numbers) if n == number) for number in sorted(set(numbers))]


def pairs_of(scan: Surface, sets: Sequence[tuple[int, ...]]) -> list[tuple[int, ...]]:
    """Every listed set together with the next one, the last with the first, where the gap is small."""
    joined = []
    for k in range(len(sets) if len(sets) > 1 else 0):
        one, other = sets[k], sets[(k + 1) % len(sets)]
        last, first = ends(one, len(scan))[1], ends(other, len(scan))[0]
        footprint = math.hypot(*scan.points[last]) * scan.step
        if math.dist(scan.points[last], scan.points[first]) < 8 * footprint + 6 * scan.noise:
            joined.append(tuple(sorted({*one, *other})))
    return joined


def spread(members: Sequence[int], most: int) -> list[int]:
    """At most so many members, evenly spread."""
    return [members[k * len(members) // most] for k in range(most)] if len(members) > most else list(members)


def share_in_common(one: Sequence[int], other: Sequence[int]) -> float:
    smaller = min(len(one), len(other))
    return len({*one} & {*other}) / smaller if smaller else 0.0


# What tells a mover's motion from a wrong one.


@dataclass(frozen=True)
class Scene:
    """Both scans and what a background motion leaves: residuals in units, and what the other scan's beams say."""

    source: Surface
    target: Surface
    background: Motion

    def left(self) -> tuple[list[float], list[str], list[float], list[str]]:
        """Residuals and sights of the source's points, then of the target's."""
        ahead = [move(self.background, p) for p in self.source.points]
        behind = [move(invert(self.background), q) for q in self.target.points]
        return (
            [point_residual(self.target, p)[0] for p in ahead],
            [sight(self.target, p) for p in ahead],
            [point_residual(self.source, q)[0] for q in behind],
            [sight(self.source, q) for q in behind],
        )


def hypothesis_features(scene: Scene, motions: Sequence[Motion], members: Sequence[Sequence[int]]) -> list[dict[str, float]]:
    """The named features of every hypothesis, one after the other."""
    left = scene.left()
    rows = [features_alone(scene, left, motion, which) for motion, which in zip(motions, members, strict=True)]
    for row, which in zip(rows, members, strict=True):
        rivals = [other for other, its in zip(rows, members, strict=True) if share_in_common(which, its) > 0.7]
        row["gain_both_ways"] = math.log1p(math.expm1(row["total_gain"]) + math.expm1(row["target_total_gain"]))
        row["residual_to_best"] = row["residual"] - min(other["residual"] for other in rivals)
        for name in ("total_gain", "target_total_gain"):
            row[f"{name}_to_best"] = row[name] - max(other[name] for other in rivals)
    return rows


def features_alone(
    scene: Scene, left: tuple[list[float], list[str], list[float], list[str]], motion: Motion, members: Sequence[int]
) -> dict[str, float]:
    """Those that no other hypothesis has a part in."""
    source, target = scene.source, scene.target
    before, excuse, there, there_excuse = left
    size, sample = len(members), spread(members, 24)
    L = len(sample)
    moved = [move(motion, source.points[i]) for i in sample]
    landing = [point_residual(target, p) for p in moved]
    seen = [sight(target, p) for p in moved]

    def mean(values: Sequence[float]) -> float:
        return sum(values) / L

    def share_of(numbers: Sequence[int]) -> float:
        """Of the sets that the members lie in, by their numbers."""
        return min(size / (sum(list(numbers).count(numbers[i]) for i in members) / size), 1.0)

    chosen = source.points[sample]
    spreads = np.linalg.eigvalsh(np.atleast_2d(np.cov(chosen.T, bias=True)))
    across, long = (math.sqrt(max(value, 0.0)) for value in spreads)
    unit, reach = mean([source.units[i] for i in sample]), mean([source.ranges[i] for i in sample])
    unknown = ("occluded", "unmeasured")
    units = [min(u, OPEN) if s == "occluded" else u for (u, _), s in zip(landing, seen, strict=True)]
    gain = mean([before[i] - u for i, u in zip(sample, units, strict=True)])
    fair = mean(
        [(min(before[i], 1.0) if excuse[i] in unknown else before[i]) - u for i, (u, _) in zip(sample, landing, strict=True)]
    )
    unexcused = mean([before[i] >= OPEN and excuse[i] not in unknown for i in sample])
    landing_unexcused = mean([there[j] >= OPEN and there_excuse[j] not in unknown for _, j in landing])
    row = {
        "size": math.log(size),
        "share_of_segment": share_of(source.segment),
        "share_of_piece": share_of(pieces(source)),
        "extent": math.log1p(long / unit),
        "linearity": 1 - across / max(long, 1e-6),
        "range": math.log(reach / lower_median(source.ranges)),
        "residual": mean(units),
        "gain": gain,
        "total_gain": math.log1p(max(gain, 0.0) * size),
        "fair_gain": math.log1p(max(fair * size, 0.0)),
        "explained": mean([u < EXPLAINED for u in units]),
        "open_before": mean([before[i] >= OPEN for i in sample]),
        "occluded_before": mean([excuse[i] == "occluded" for i in sample]),
        "seen_through_before": mean([excuse[i] == "seen through" for i in sample]),
        "seen_through": mean([s == "seen through" for s in seen]),
        "occluded": mean([s == "occluded" for s in seen]),
        "landing_open": mean([there[j] >= OPEN for _, j in landing]),
        "landing_seen_through_before": mean([there_excuse[j] == "seen through" for _, j in landing]),
        "landing_occluded_before": mean([there_excuse[j] == "occluded" for _, j in landing]),
        "unexcused": unexcused,
        "landing_unexcused": landing_unexcused,
        "unexcused_both": math.sqrt(unexcused * landing_unexcused),
        "stands_out": stands_out(source, members),
    }
    row |= features_of_shift(scene, motion, sample, moved, long, unit, reach)
    row |= features_around(before, members)
    return row | features_of_target(target, there, np.array(moved), {j for _, j in landing}, size, long)


def features_of_shift(
    scene: Scene, motion: Motion, sample: Sequence[int], moved: Sequence[Point], long: float, unit: float, reach: float
) -> dict[str, float]:
    """How far the members go beyond the background."""
    source, heading = scene.source, scene.background[0]
    carried = np.array([move(scene.background, source.points[i]) for i in sample])
    x, y = (np.array(moved) - carried).mean(0)
    length = max(math.hypot(x, y), 1e-6)
    turned = [move((heading, 0.0, 0.0), source.tangent[i]) for i in sample]
    return {
        "displacement": math.log1p(length / unit),
        "displacement_in_spacings": math.log1p(length / (reach * source.step)) if source.step > 0 else math.inf,
        "displacement_in_range": length / reach,
        "displacement_in_extent": math.log1p(length / max(long, 1e-6)),
        "along_surface": sum(abs(tx * x + ty * y) for tx, ty in turned) / len(sample) / length,
        "rotation": math.log1p(abs(oracles.wrap(motion[0] - heading)) / 0.1),
    }


def features_around(before: Sequence[float], members: Sequence[int]) -> dict[str, float]:
    """How well the background fits the 15 beams to both sides of the members, and all that are no members."""
    rest = [i for i in range(len(before)) if i not in {*members}]
    beside = [before[i] for i in rest if any(abs(i - k) <= 15 for k in members)]
    return {
        "units_around": (sum(beside) + 2.0) / (len(beside) + 3.0),
        "scene_open": sum(before[i] >= OPEN for i in rest) / max(len(rest), 1),
    }


def features_of_target(
    target: Surface, there: Sequence[float], moved: np.ndarray, landed: set[int], size: int, long: float
) -> dict[str, float]:
    """What the moved members explain of the target. landed: its points that are nearest to them."""
    M = range(len(target))
    back = [nearest(moved, q)[0] / unit for q, unit in zip(target.points, target.units, strict=True)]
    open_near = [j for j in M if there[j] >= OPEN and back[j] < 6.0 + long / target.units[j]]
    covered, piece = {j for j in M if back[j] < OPEN}, pieces(target)
    on_segments = {j for j in M if target.segment[j] in {target.segment[k] for k in landed} and there[j] >= OPEN}
    on_pieces = {j for j in M if piece[j] in {piece[k] for k in landed}}
    gain = sum(there[j] - min(back[j], TRUNCATED) for j in open_near)
    return {
        "distinct": math.log1p(len(covered) / size),
        "target_open": math.log1p(len(open_near)),
        "target_residual": sum(min(back[j], TRUNCATED) for j in open_near) / max(len(open_near), 1),
        "target_gain": gain / max(len(open_near), 1),
        "target_total_gain": math.log1p(max(gain, 0.0)),
        "target_cover": len(on_segments & covered) / max(len(on_segments), 1),
        "landing_piece_cover": len(on_pieces & covered) / len(on_pieces),
        "landing_stands_out": stands_out(target, sorted(landed | covered)),
    }


def stands_out(scan: Surface, members: Sequence[int]) -> float:
    """-1 to 1: whether the returns beside both ends of a set lie four units behind them, or before."""
    first, last = ends(members, len(scan))
    total = 0.0
    for end, beside in ((first, first - 1), (last, last + 1)):
        if scan.closed or 0 <= beside < len(scan):
            jump = scan.ranges[beside % len(scan)] - scan.ranges[end]
            total += min(max(jump / (4 * scan.units[end]), -1.0), 1.0)
    return total / 2


# Which hypotheses are accepted.


def accept(
    scene: Scene,
    motions: Sequence[Motion],
    members: Sequence[Sequence[int]],
    probabilities: Sequence[float],
    threshold: float,
    most: int,
) -> list[int]:
    """The likeliest first, without those that move, or explain, what an accepted one does."""
    target = scene.target
    accepted: list[int] = []
    explained: dict[int, list[int]] = {}
    likely = [h for h in range(len(motions)) if probabilities[h] >= threshold]
    for h in sorted(likely, key=lambda h: -probabilities[h]):
        moved = np.array([move(motions[h], scene.source.points[i]) for i in spread(members[h], 24)])
        explained[h] = [j for j, unit in enumerate(target.units) if nearest(moved, target.points[j])[0] < EXPLAINED * unit]
        shares = [max(share_in_common(members[g], members[h]), share_in_common(explained[g], explained[h])) for g in accepted]
        is_new = all(share <= 0.4 for share in shares)
        is_new = is_new and not any(explains(scene, (motions[g], members[g]), (motions[h], members[h])) for g in accepted)
        if is_new and len(accepted) < most:
            accepted.append(h)
    return accepted


def explains(scene: Scene, one: tuple[Motion, Sequence[int]], other: tuple[Motion, Sequence[int]]) -> bool:
    """Whether the motion of one object explains another's points nearly as well, and they are near enough to be the same."""
    source, target = scene.source, scene.target
    error = lower_median([*source.spacing, *target.spacing]) / 2 + 2 * max(source.noise, target.noise)
    its, mine = source.points[list(one[1])], source.points[list(other[1])]
    apart = math.hypot(*np.maximum(np.maximum(its.min(0), mine.min(0)) - np.minimum(its.max(0), mine.max(0)), 0.0))
    sample = spread(other[1], 24)
    worse = [
        point_residual(target, move(one[0], source.points[i]))[0] - point_residual(target, move(other[0], source.points[i]))[0]
        for i in sample
    ]
    return apart < math.hypot(*(its.max(0) - its.min(0))) / 2 + 4 * error and sum(worse) / len(sample) < 0.5
