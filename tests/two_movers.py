"""A street with two boxes that move, seen before and after, and hypotheses of who moves how."""

import math
from collections.abc import Sequence

import numpy as np

from torchcrf_scan.geometry import se2
from torchcrf_scan.loops.jit import Array, Booleans, Integers
from torchcrf_scan.search.accept import probabilities_of, score_of, select
from torchcrf_scan.search.grid import ScanGrid, grid_of
from torchcrf_scan.search.groups import Groups
from torchcrf_scan.search.hypotheses import Hypotheses, members_of
from torchcrf_scan.search.hypothesis_features import hypothesis_features
from torchcrf_scan.search.leftover import leftover_of
from torchcrf_scan.search.score import HypothesisScore
from torchcrf_scan.search.sides import sliding_sides
from torchcrf_scan.search.surface import surface_of
from torchcrf_scan.search.survey import Survey, survey_at

Segment = tuple[float, float, float, float]
NOISE, DT = 0.01, 0.2
WALLS = [(-2.0, -8.0, 25.0, -8.0), (25.0, -8.0, 25.0, 8.0), (25.0, 8.0, -2.0, 8.0), (6.0, -8.0, 6.0, -6.0), (14.0, 8.0, 14.0, 6.5)]
EGO = np.array([0.03, -0.6, 0.05])  # T_target_source of what stands still
STEPS = {"ahead": np.array([0.0, 1.1, 0.1]), "across": np.array([0.02, -0.2, -0.8])}  # movers, in the source frame


def box(x: float, y: float, long: float, wide: float) -> list[Segment]:
    a, b, c, d = x - long / 2, y - wide / 2, x + long / 2, y + wide / 2
    return [(a, b, c, b), (c, b, c, d), (c, d, a, d), (a, d, a, b)]


BOXES = {"ahead": box(9.0, 3.0, 4.0, 1.8), "across": box(11.0, -3.0, 1.8, 1.8)}


def carried(segments: Sequence[Segment], motion: Array) -> list[Segment]:
    ends = se2.apply(motion, np.array(segments).reshape(-1, 2)).reshape(-1, 4)
    return [tuple(row) for row in ends.tolist()]


def cast(segments: Sequence[Segment], seed: int) -> Array:
    """(P, 2) nearest hits of 361 beams over 180 degrees, a little noisy."""
    table = np.array(segments)
    a, edge = table[:, :2], table[:, 2:] - table[:, :2]
    bearing = np.linspace(-math.pi / 2, math.pi / 2, 361)[:, None]
    dx, dy = np.cos(bearing), np.sin(bearing)
    det = dx * edge[:, 1] - dy * edge[:, 0] + 1e-12
    r = (a[:, 0] * edge[:, 1] - a[:, 1] * edge[:, 0]) / det
    along = (a[:, 0] * dy - a[:, 1] * dx) / det
    r = np.where((r > 0) & (along >= 0) & (along <= 1), r, np.inf).min(1)
    r = r + np.random.default_rng(seed).normal(0, 0.01, len(r))
    hit = np.isfinite(r)
    return np.c_[r * dx[:, 0], r * dy[:, 0]][hit]


def grid(points: Array, noise: float = NOISE) -> ScanGrid:
    """An open scan (P, 2) from the origin."""
    return grid_of(surface_of(np.ascontiguousarray(points, np.float64), noise, False, np.zeros(2)))


def scene(moving: Sequence[str] = ("ahead", "across"), steps: dict[str, Array] = STEPS) -> tuple[ScanGrid, ScanGrid]:
    source, target = list(WALLS), carried(WALLS, EGO)
    for name, segments in BOXES.items():
        step = steps[name] if name in moving else np.zeros(3)
        source += segments
        target += carried(segments, se2.compose(EGO, step))
    return grid(cast(source, 1)), grid(cast(target, 2))


def in_box(points: Array, name: str) -> Booleans:
    """(P,) which points are of a box in the source."""
    ends = np.array(BOXES[name]).reshape(-1, 2)
    return ((points > ends.min(0) - 0.1) & (points < ends.max(0) + 0.1)).all(-1)


def hypotheses_of(motions: Array, members: Booleans) -> Hypotheses:
    """H motions (H, 3) of members (H, P), in any order."""
    sets = [tuple(np.flatnonzero(row).tolist()) for row in members]
    kinds = sorted(set(sets))
    group = np.array([kinds.index(of) for of in sets], np.int64)
    start = np.cumsum([0, *map(len, kinds)])
    return Hypotheses(np.array(motions, np.float64), group, Groups(start, np.concatenate(kinds).astype(np.int64)))


def survey_of(source: ScanGrid, target: ScanGrid, background: Array, motions: Array, members: Booleans) -> Survey:
    """What a background (3,) leaves, and these hypotheses with their features."""
    leftover, hypotheses = leftover_of(source, target, background), hypotheses_of(motions, members)
    return Survey(leftover, hypotheses, hypothesis_features(leftover, hypotheses), sliding_sides(leftover))


def accepted_of(survey: Survey, score: HypothesisScore | None = None) -> Integers:
    """(G,) the hypotheses that the score accepts."""
    own = score_of(score or HypothesisScore())
    return select(survey.leftover, survey.hypotheses, probabilities_of(own, survey.features), own.threshold, 6)


def movers_of(source: ScanGrid, target: ScanGrid, background: Array = EGO, dt: float = DT) -> tuple[Array, Booleans, Array]:
    """(G, 3) motions, (G, P) members and (G,) probabilities of the accepted movers."""
    survey = survey_at(source, target, background, dt)
    chosen = accepted_of(survey)
    probabilities = probabilities_of(score_of(HypothesisScore()), survey.features)[chosen]
    return survey.hypotheses.motions[chosen], members_of(survey.hypotheses, chosen, len(source.features)), probabilities
