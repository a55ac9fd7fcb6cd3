"""Trimmed ICP for the background, then sequential RANSAC for the movers: a strong classical baseline."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree
from scipy.spatial.distance import cdist

from torchcrf_scan.baselines.cloud import Cloud, fit_motion
from torchcrf_scan.baselines.labels import all_outliers, to_prediction
from torchcrf_scan.baselines.trimmed_icp import association_gate, register_trimmed
from torchcrf_scan.geometry import se2
from torchcrf_scan.scan import OUTLIER, Bools, Floats, Ints, PairPrediction, ScanPair

SEED = 0
OPEN_SHARE = 0.7  # of the gate: points of larger residual are open, i.e. to be explained by a mover
OCCLUDED_COST = 0.3  # relative to an ordinary miss: an occluded point needs no mover
LARGEST_SPEED = 20.0  # metres per second over ground, and
LARGEST_TRAVEL = 2.0  # ranges
LARGEST_TURN = 0.5  # radians
LINK = 3.0  # spacings between neighbouring points of one object
WINDOW = 0.5  # of an object's visible extent: margin within which points may still belong to it
MOST_PARTS = 10
SAMPLES = 150
REFINED = 8  # samples per part that are refined, for
REFITS = 5  # rounds
FEWEST_INLIERS = 4
LEAST_GAIN = 2.0  # points explained, net of those explained before


@dataclass(frozen=True, slots=True)
class Scene:
    """A pair under the background's motion.

    Attributes:
        source, target: the scans.
        background: (3,) the motion.
        gate: (M,) metres within which a target return explains a point.
        cost: (N,) in [0, 1], degree to which the background leaves a source point unexplained.
        is_open: (N,) source points to be explained by movers.
        open_target: (T,) indices of such target points.
        expected: (N, 2) source points under the background's motion.
        travel: (N,) largest displacement of a point from there, metres.
    """

    source: Cloud
    target: Cloud
    background: Floats
    gate: Floats
    cost: Floats
    is_open: Bools
    open_target: Ints
    expected: Floats
    travel: Floats

    @classmethod
    def of(cls, pair: ScanPair) -> Scene:
        """Registers the pair's scans, which have at least one point each."""
        source, target = Cloud.of(pair.source), Cloud.of(pair.target)
        motion = register_trimmed(source, target)
        expected = se2.apply(motion, source.points)
        distance, nearest = target.nearest(expected)
        gate = association_gate(distance, target)
        back, home = source.nearest(se2.apply(se2.inverse(motion), target.points))
        cost = _miss(distance, gate[nearest])
        return cls(
            source=source,
            target=target,
            background=motion,
            gate=gate,
            cost=np.where(target.hides(expected, gate[nearest]), OCCLUDED_COST * cost, cost),
            is_open=distance > OPEN_SHARE * gate[nearest],
            open_target=np.flatnonzero(back > OPEN_SHARE * association_gate(back, source)[home]),
            expected=expected,
            travel=np.minimum(LARGEST_SPEED * pair.dt, LARGEST_TRAVEL * source.ranges),
        )


@dataclass(frozen=True, slots=True)
class Mover:
    """A motion (3,), the points (N,) that it explains better than the background does, and its total gain."""

    motion: Floats
    members: Bools
    gain: float


def match_ransac(pair: ScanPair, *, movers: int = 3) -> PairPrediction:
    """Predicts background and up to `movers` movers; a point is assigned to the motion that brings it nearest to a return."""
    if not len(pair.source) or not len(pair.target):
        return all_outliers(pair)
    scene = Scene.of(pair)
    return label_points(pair, scene, find_movers(scene, movers))


def find_movers(scene: Scene, most: int) -> list[Mover]:
    """At most `most` movers of falling gain, each with enough open points that no earlier one explains."""
    rng = np.random.default_rng(SEED)
    found = [mover for part in open_parts(scene) if (mover := search_motion(scene, part, rng)) is not None]
    free = scene.is_open.copy()
    accepted: list[Mover] = []
    for mover in sorted(found, key=lambda mover: -mover.gain):
        inliers = np.count_nonzero(mover.members & free)
        is_new = 2 * inliers >= np.count_nonzero(mover.members & scene.is_open)
        if len(accepted) < most and inliers >= FEWEST_INLIERS and is_new:
            accepted.append(mover)
            free &= ~mover.members
    return accepted


def open_parts(scene: Scene) -> list[Ints]:
    """The largest connected sets of open source points, by falling size; an object is spatially connected."""
    open_points = np.flatnonzero(scene.is_open)
    points, reach = scene.source.points[open_points], LINK * scene.source.spacing[open_points]
    linked = cdist(points, points) <= np.maximum(reach[:, None], reach)
    part = connected_components(linked, directed=False)[1] if len(points) else np.zeros(0, dtype=np.int64)
    sizes = np.bincount(part)
    largest = np.argsort(-sizes, kind="stable")[:MOST_PARTS]
    return [open_points[part == k] for k in largest if sizes[k] >= FEWEST_INLIERS]


def search_motion(scene: Scene, part: Ints, rng: np.random.Generator) -> Mover | None:
    """RANSAC within one part: sampled motions, of which the best are refitted; the best of these if it gains enough. part: (P,)."""
    window = np.flatnonzero(within_reach(scene.source, part))
    motions = sample_motions(scene, part, rng)
    motions = motions[np.argsort(-_gains(scene, motions, window).sum(-1), kind="stable")[:REFINED]]
    motions = _refit(scene, motions, window)
    motions = motions[_is_plausible(scene, motions, part, window)]
    if not len(motions):
        return None
    gains = _gains(scene, motions, window)  # (H, W)
    best = gains.sum(-1).argmax()
    members = np.zeros(len(scene.source), dtype=bool)
    members[window[gains[best] > 0]] = True
    gain = float(gains[best].sum())
    return Mover(motions[best], members, gain) if gain >= LEAST_GAIN else None


def sample_motions(scene: Scene, part: Ints, rng: np.random.Generator) -> Floats:
    """(S, 3) motions of two points of the part to two target returns at equal distance, and shifts of one to one.

    The first return is an open one; both are within travel.
    """
    can_reach = cdist(scene.expected[part], scene.target.points[scene.open_target]) <= scene.travel[part][:, None]  # (P, T)
    starts = np.flatnonzero(can_reach.any(-1))
    if not len(starts):
        return np.zeros((0, 3))
    drawn = rng.choice(starts, SAMPLES)
    first, second = part[drawn], part[rng.integers(len(part), size=SAMPLES)]
    to_first = scene.open_target[_draw(can_reach[drawn], rng)]
    near = cKDTree(scene.expected[part]).query(scene.target.points)[0] <= scene.travel[part].max()
    ends = np.flatnonzero(near)
    length = np.linalg.norm(scene.source.points[first] - scene.source.points[second], axis=-1)  # (S,)
    between = np.linalg.norm(scene.target.points[to_first][:, None] - scene.target.points[ends], axis=-1)  # (S, E)
    fits = (np.abs(between - length[:, None]) <= scene.gate[to_first][:, None] / 2) & (between > 0) & (length > 0)[:, None]
    to_second = ends[_draw(fits, rng)]
    turned = fit_motion(
        scene.source.points[np.stack([first, second], axis=1)], scene.target.points[np.stack([to_first, to_second], axis=1)]
    )
    shifts = np.tile(scene.background, (SAMPLES // 2, 1))
    shifts[:, 1:] += (scene.target.points[to_first] - scene.expected[first])[: len(shifts)]
    return np.concatenate([turned[fits.any(-1) & _turns_little(scene, turned)], shifts])


def within_reach(source: Cloud, known: Ints | Bools) -> Bools:
    """(N,) points that may belong to an object, given some of its points (indices or mask, at least one)."""
    points = source.points[known]
    extent = float(np.linalg.norm(np.ptp(points, axis=0)))
    return cKDTree(points).query(source.points)[0] <= WINDOW * extent + LINK * source.spacing


def label_points(pair: ScanPair, scene: Scene, movers: list[Mover]) -> PairPrediction:
    """Assigns every point to the motion that brings it nearest to a return, relative to the gate; beyond it, outliers."""
    motions = np.stack([scene.background, *(mover.motion for mover in movers)])
    distance, nearest = scene.target.nearest(se2.apply(motions, scene.source.points))  # (K+1, N)
    share = np.where(distance <= scene.gate[nearest], distance / np.maximum(scene.gate[nearest], 1e-9), np.inf)
    for k, mover in enumerate(movers, start=1):
        share[k, ~within_reach(scene.source, mover.members)] = np.inf
    cluster = share.argmin(0)  # ties go to the background
    points = np.arange(len(cluster))
    is_explained = np.isfinite(share[cluster, points])
    association = np.where(is_explained, nearest[cluster, points], OUTLIER)
    return to_prediction(pair, association, np.where(is_explained, cluster, OUTLIER), motions)


def _gains(scene: Scene, motions: Floats, window: Ints) -> Floats:
    """(H, W) in [-1, 1]: reduction of the cost of the window's points by each motion, relative to the background."""
    distance, nearest = scene.target.nearest(se2.apply(motions, scene.source.points[window]))
    return scene.cost[window] - _miss(distance, scene.gate[nearest])


def _refit(scene: Scene, motions: Floats, window: Ints) -> Floats:
    """(H, 3) ICP of the window's points within the gate."""
    points = scene.source.points[window]
    for _ in range(REFITS):
        distance, nearest = scene.target.nearest(se2.apply(motions, points))  # (H, W)
        weights = (distance <= scene.gate[nearest]).astype(np.float64)
        found = fit_motion(np.broadcast_to(points, (*distance.shape, 2)), scene.target.points[nearest], weights)
        motions = np.where(weights.sum(-1, keepdims=True) >= FEWEST_INLIERS, found, motions)
    return motions


def _is_plausible(scene: Scene, motions: Floats, part: Ints, window: Ints) -> Bools:
    """(H,) motions of small rotation and of plausible travel of the window's centre."""
    centre = se2.apply(motions, scene.source.points[window]).mean(-2)  # (H, 2)
    travelled = np.linalg.norm(centre - scene.expected[window].mean(0), axis=-1)
    return _turns_little(scene, motions) & (travelled <= scene.travel[part].max())


def _turns_little(scene: Scene, motions: Floats) -> Bools:
    return np.abs(se2.wrap(motions[:, 0] - scene.background[0])) <= LARGEST_TURN


def _miss(distance: Floats, gate: Floats) -> Floats:
    """In [0, 1]: squared share of the gate, truncated there."""
    return np.minimum(distance / np.maximum(gate, 1e-9), 1.0) ** 2


def _draw(allowed: Bools, rng: np.random.Generator) -> Ints:
    """(S,) one random allowed column of every row (S, T); column 0 if none is allowed."""
    return (rng.random(allowed.shape) * allowed).argmax(-1)
