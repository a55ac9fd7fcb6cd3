"""Moving points and objects of a scan: what the match found, checked and completed by memory and by what was expected."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from torchcrf_scan.geometry import se2
from torchcrf_scan.result import MovingObject
from torchcrf_scan.scan import BACKGROUND, OUTLIER, Bools, Floats, Ints, PairPrediction, Scan
from torchcrf_scan.search.expected import Expected
from torchcrf_scan.search.grid import ScanGrid
from torchcrf_scan.stream.config import StreamConfig
from torchcrf_scan.stream.memory import Memory, Votes
from torchcrf_scan.stream.movers import Movers
from torchcrf_scan.stream.tracks import Tracker, TrackPrediction
from torchcrf_scan.stream.view import View

LOG_MOVED, LOG_STOOD = 1.0, 2.0  # log potentials for moving of a point that has moved, against it of one that has stood
STOOD = 0.5  # share of a cluster's points that have stood, above which it does not move
NEAR = 0.1  # metres from where a point of an object was expected, beside the track's own uncertainty,
FARTHEST = 0.5  # at most
FEWEST = 2  # points at the place of an object that was expected, but not found by the match


@dataclass(frozen=True, slots=True)
class Clusters:
    """Moving clusters of one scan.

    Attributes:
        label: (P,) 0 background, k in 1..K, -1 outlier. velocity: (K, 2) over ground, NaN unknown. covariance: (K, 2, 2).
    """

    label: Ints
    velocity: Floats
    covariance: Floats


@dataclass(frozen=True, slots=True)
class Moving:
    """What moves in a scan. is_moving: (P,) bool. track: (P,) 0 background, the number of one of the objects, -1 unknown."""

    is_moving: Bools
    track: Ints
    objects: tuple[MovingObject, ...]

    def by_beam(self, scan: Scan) -> Moving:
        """The same with (n_beams,) labels, of a scan whose points they label."""
        return Moving(scan.to_beams(self.is_moving, False), scan.to_beams(self.track, OUTLIER), self.objects)


class Objects:
    """Objects over time, from scan to scan."""

    def __init__(self, config: StreamConfig) -> None:
        self.tracker = Tracker()
        self.memory = Memory(config.memory_spacing, config.memory)
        self.movers = Movers(config.least_speed)

    def expect(self, grid: ScanGrid, votes: Votes, pose: Floats, reference: View, time: float) -> Expected:
        """What is known of the movers of a scan before it is matched to an earlier one: hypotheses, never trusted blindly.

        Args:
            grid: of the scan. votes: on its points. pose: (3,) where it was probably taken, at a time in seconds.
        """
        points = se2.apply(pose, grid.scan.points)
        log_moving = LOG_MOVED * votes.has_moved - LOG_STOOD * votes.has_stood
        motions, members = [], []
        for track in self.tracker.predict(time):
            back = np.array([0.0, *(-track.velocity * (time - reference.time))])
            motions.append(se2.compose(se2.inverse(reference.pose), se2.compose(back, pose)))
            members.append(_near(points, track))
        count = len(motions)
        return Expected(np.reshape(motions, (count, 3)), np.reshape(members, (count, len(points))).astype(np.bool_), log_moving)

    def update(self, view: View, cluster: Ints, votes: Votes, found: PairPrediction, reference: View) -> Moving:
        """Takes a placed scan.

        Args:
            cluster: (P,) labels of its points, of the match `found` with an earlier scan `reference`. votes: on its points.
        """
        points = se2.apply(view.pose, view.grid.scan.points)
        seen = with_standing_removed(clusters_over_ground(view, cluster, found, reference), votes)
        seen = with_segments_filled(seen, votes, view.grid.scan.segment)
        seen = with_expected(seen, votes, points, self.tracker.predict(view.time))
        self.memory.add(view)
        sensor = view.pose[1:]
        since = view.time - reference.time
        turns = turns_over_ground(view, found, reference, len(seen.velocity))
        numbers, objects = self.tracker.update(view.time, points, seen.label, seen.velocity, seen.covariance, sensor, since, turns)
        movers = self.movers.update(view.time, objects)
        known = np.where(np.isin(numbers, [of.number for of in movers]), numbers, OUTLIER)
        track = np.concatenate([[BACKGROUND], known, [OUTLIER]])[seen.label]  # label -1 is the last
        return Moving(track > BACKGROUND, track, movers)

    def begin(self, view: View) -> None:
        """Begins with a scan, the first or that after a gap: what earlier ones saw is forgotten; objects end by themselves."""
        self.memory.clear()
        self.memory.add(view)


def nothing_moves(scan: Scan, label: int) -> Moving:
    """A scan without movers, by beam. label: of all returns, 0 background or -1 unknown."""
    return Moving(np.zeros(scan.n_beams, np.bool_), scan.to_beams(np.full(len(scan), label), OUTLIER), ())


def clusters_over_ground(view: View, cluster: Ints, found: PairPrediction, reference: View) -> Clusters:
    """The clusters of a match with their velocities in the world, at their centroids."""
    K, dt = len(found.motions) - 1, view.time - reference.time
    velocity, covariance = np.full((K, 2), np.nan), np.full((K, 2, 2), np.nan)
    for k in range(1, K + 1):
        mine = view.grid.scan.points[cluster == k]
        if len(mine) == 0 or found.covariances is None:
            continue
        centre = mine.mean(0)
        before = se2.apply(reference.pose, se2.apply(found.motions[k], centre[None]))[0]
        velocity[k - 1] = (se2.apply(view.pose, centre[None])[0] - before) / dt
        arm = se2.rotate(found.motions[k, :1], centre[None])[0]
        lever = np.array([[-arm[1], 1.0, 0.0], [arm[0], 0.0, 1.0]])  # d place / d (theta, x, y)
        turn = se2.rotate(reference.pose[:1], np.eye(2)).T
        covariance[k - 1] = turn @ lever @ found.covariances[k] @ lever.T @ turn.T / dt**2
    return Clusters(cluster.copy(), velocity, covariance)


def turns_over_ground(view: View, found: PairPrediction, reference: View, K: int) -> Floats:
    """(K,) rad/s at which the clusters of a match rotate in the world; NaN for those that it did not find."""
    turns = np.full(K, np.nan)
    turns[: len(found.motions) - 1] = se2.wrap(view.pose[0] - reference.pose[0] - found.motions[1:, 0])
    return turns / (view.time - reference.time)


def with_standing_removed(seen: Clusters, votes: Votes) -> Clusters:
    """Without clusters most of whose points lie where earlier scans saw a surface, and never free space."""
    label = seen.label.copy()
    for k in range(1, len(seen.velocity) + 1):
        mine = seen.label == k
        if mine.any() and votes.has_stood[mine].mean() > STOOD:
            label[mine] = BACKGROUND
    return Clusters(label, seen.velocity, seen.covariance)


def with_segments_filled(seen: Clusters, votes: Votes, segment: Ints) -> Clusters:
    """Points that have moved join the cluster which has most points of their segment (P,)."""
    label, K = seen.label.copy(), len(seen.velocity)
    is_mover = label > BACKGROUND
    count = np.zeros((int(segment.max()) + 1, K + 1), np.int64)
    np.add.at(count, (segment[is_mover], label[is_mover]), 1)
    joins = ~is_mover & votes.has_moved & (count.max(1) > 0)[segment]
    label[joins] = count.argmax(1)[segment[joins]]
    return Clusters(label, seen.velocity, seen.covariance)


def with_expected(seen: Clusters, votes: Votes, points: Floats, expected: Sequence[TrackPrediction]) -> Clusters:
    """Points where an object was expected join it, if the match has no place for them or their place was free until lately.

    Args:
        points: (P, 2) in the world.
    """
    label, K = seen.label.copy(), len(seen.velocity)
    velocity, covariance = [*seen.velocity], [*seen.covariance]
    for track in expected:
        near = _near(points, track)
        joins = near & ((label == OUTLIER) | ((label == BACKGROUND) & votes.has_moved)) & ~votes.has_stood
        held = np.bincount(label[near & (label > BACKGROUND)], minlength=1)
        if held.sum() > 0:
            label[joins] = held.argmax()
        elif joins.sum() >= FEWEST:
            K += 1
            label[joins] = K
            velocity.append(np.full(2, np.nan))
            covariance.append(np.full((2, 2), np.nan))
    return Clusters(label, np.reshape(velocity, (K, 2)), np.reshape(covariance, (K, 2, 2)))


def _near(points: Floats, track: TrackPrediction) -> Bools:
    """(P,) bool: the points of a scan that lie where a point of the track is expected."""
    reach = min(NEAR + float(np.sqrt(np.linalg.eigvalsh(track.covariance[:2, :2])[1])), FARTHEST)
    places = track.points + track.shift
    low, high = places.min(0) - reach, places.max(0) + reach
    near: Bools = ((points >= low) & (points <= high)).all(1)
    apart = points[near, None] - places  # (Q, n, 2)
    near[near] = ((apart**2).sum(-1) < reach**2).any(1)
    return near
