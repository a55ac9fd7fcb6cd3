"""Slow and obvious twins of the search for movers (InitialiseRT): plain float64 Python that shares no code with it.

A hypothesis is a motion (theta, tx, ty) and the list of the source points that it moves.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import oracles
from oracles import move
from oracles_search import (
    TRUNCATED,
    Motion,
    Point,
    Surface,
    follow,
    invert,
    lower_median,
    nearest,
    numbered,
    pieces,
    point_residual,
    register,
    sight,
    unit_length,
)

OPEN, EXPLAINED = 1.5, 1.0  # units


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


# Motions that a set may have.


def flags(members: Sequence[int], count: int) -> list[bool]:
    return [i in members for i in range(count)]


def marks(points: np.ndarray, members: Sequence[int]) -> list[np.ndarray]:
    """Centroid, first and last point of a set."""
    first, last = ends(members, len(points))
    return [points[list(members)].mean(0), points[first], points[last]]


def hypothesise(scene: Scene, dt: float) -> list[tuple[tuple[int, ...], Motion]]:
    """Every set of the source with its five best translations to a set of the target, registered; in the order of flags."""
    source, target = scene.source, scene.target
    left, _, there, _ = scene.left()
    carried = np.array([move(scene.background, p) for p in source.points])
    landings = sorted(groups(target, there), key=lambda members: flags(members, len(target)))
    goals = [marks(target.points, members) for members in landings]
    found = []
    for members in sorted(groups(source, left), key=lambda members: flags(members, len(source))):
        own = marks(carried, members)
        reach = min(math.hypot(*own[0]), 45.0 * dt)
        shifts = [np.zeros(2)] + [goal[m] - own[m] for goal in goals for m in range(3)]
        shifts = [shift for shift in shifts if math.hypot(*shift) <= reach]
        for shift in best_shifts(target, carried[spread(members, 8)], shifts, 2 * unit_length(source, target)):
            theta, x, y = scene.background
            found.append((members, settle(scene, members, (oracles.wrap(theta), x + shift[0], y + shift[1]))))
    return found


def best_shifts(target: Surface, points: np.ndarray, shifts: Sequence[np.ndarray], near: float) -> list[np.ndarray]:
    """At most five translations that leave the smallest residuals, none near another."""
    costs = [sum(point_residual(target, p + shift)[0] for p in points) for shift in shifts]
    chosen: list[np.ndarray] = []
    for k in sorted(range(len(shifts)), key=lambda k: costs[k]):
        if len(chosen) < 5 and all(math.dist(shifts[k], other) >= near for other in chosen):
            chosen.append(shifts[k])
    return chosen


def settle(scene: Scene, members: Sequence[int], start: Motion) -> Motion:
    """Registers a set, then turns it back about its centre as far as its points do not tell of a turn (0.1 radians are usual)."""
    points, unit = scene.source.points[spread(members, 16)], unit_length(scene.source, scene.target)
    gates, along = [unit * gate for gate in (4.0, 3.0, 2.0, 2.0, 1.5, 1.5)], (1.0, 1.0, 0.5, 0.5, 0.2, 0.2)
    motion = register(points, np.ones(len(points)), scene.target, start, gates, along)
    moved = np.array([move(motion, p) for p in points])
    centre = moved.mean(0)
    told = ((moved - centre) ** 2).sum() / unit**2
    turn = -oracles.wrap(motion[0] - scene.background[0]) / (1 + told * 0.1**2)
    return follow(motion, (turn, *(centre - move((turn, 0.0, 0.0), centre))))


# What tells a mover's motion from a wrong one.


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
    error = unit_length(source, target)
    its, mine = source.points[list(one[1])], source.points[list(other[1])]
    apart = math.hypot(*np.maximum(np.maximum(its.min(0), mine.min(0)) - np.minimum(its.max(0), mine.max(0)), 0.0))
    sample = spread(other[1], 24)
    worse = [
        point_residual(target, move(one[0], source.points[i]))[0] - point_residual(target, move(other[0], source.points[i]))[0]
        for i in sample
    ]
    return apart < math.hypot(*(its.max(0) - its.min(0))) / 2 + 4 * error and sum(worse) / len(sample) < 0.5
