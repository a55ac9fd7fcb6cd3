"""Which moving cluster of a scan continues which track: one to one, by motion and extent, gated by covariance."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from torchcrf_scan.geometry import se2
from torchcrf_scan.scan import Bools, Floats
from torchcrf_scan.stream import extent as box
from torchcrf_scan.stream.filter import chi_square
from torchcrf_scan.stream.track import DOUBT, Sighting, Track, TrackerConfig

POSITION_GATE = 13.8  # chi-square of two degrees of freedom, 99.9 %
LOOSE = 0.2  # share of an object's size by which its visible part is uncertain
GUESS = 2.0  # added to the cost of tracks that are not confirmed
LARGER = 4.0  # cost of a cluster that is e times as large as the track
SMALL = 0.3  # metres, beneath which sizes do not differ
WITHIN = 0.1  # metres by which the middle of a part may lie beyond the box
ONE = 0.7  # metres; what fits in there and goes the same way is one thing, such as two legs,
SWING = 1.0  # m/s, even if parts of it move so much faster than others


class Comparison:
    """T tracks, at the time of the scan, beside its K sightings.

    Attributes:
        cost: (T, K) squared Mahalanobis distance of motion and extent; infinite beyond the gate.
        is_part: (T, K) whether the sighting lies within the track's box and moves like it, or is one small thing with it.
    """

    cost: Floats
    is_part: Bools

    def __init__(self, tracks: Sequence[Track], sightings: Sequence[Sighting], config: TrackerConfig) -> None:
        headings = np.array([track.heading for track in tracks])
        extent = np.stack([track.extent for track in tracks])[:, None]  # (T, 1, 2)
        covariance = np.stack([track.covariance for track in tracks])[:, None]  # (T, 1, 4, 4)
        sizes = [len(of.points) for of in sightings]
        points = np.concatenate([of.points for of in sightings])
        starts = np.cumsum([0, *sizes[:-1]])
        seen = box.covers(points, starts, np.stack([track.centre for track in tracks]), headings)  # (T, K, 2)
        axes = se2.rotate(headings[:, None] * np.ones(2), np.broadcast_to(np.eye(2), (len(tracks), 2, 2)))  # (T, 2, 2) rows
        position = axes @ covariance[:, 0, :2, :2] @ axes.mT  # (T, 2, 2) along and across
        ends = np.array([of.noise for of in sightings])[:, None] + LOOSE * np.minimum(extent, seen.size)  # (T, K, 2)
        near = chi_square(box.gap(seen, extent), position[:, None] + ends[..., None] ** 2 * np.eye(2))  # (T, K)
        change = np.stack([of.velocity for of in sightings]) - np.stack([track.velocity for track in tracks])[:, None]
        alike = chi_square(change, covariance[..., 2:, 2:] + np.stack([of.covariance for of in sightings]))  # (T, K)
        apart = ((seen.middle / (SMALL + extent)) ** 2).sum(-1)  # breaks ties of boxes within each other
        larger = np.log((SMALL + seen.size) / (SMALL + extent)).max(-1)
        cost = near + np.minimum(alike, DOUBT) + apart + LARGER * np.maximum(larger, 0) ** 2
        cost += GUESS * np.array([not track.is_confirmed for track in tracks])[:, None]
        self.cost = np.where((near < POSITION_GATE) & (cost < config.gate), cost, np.inf)
        is_inside = (np.abs(seen.middle) <= extent / 2 + WITHIN).all(-1)
        self.is_part = is_inside & (alike < DOUBT)
        course = np.stack([track.velocity for track in tracks])[:, None]
        self.is_part |= _fits(seen, extent) & _goes_along(course, np.stack([of.velocity for of in sightings]))


def _fits(seen: box.Interval, extent: Floats) -> Bools:
    """(...) whether points and box fit into `ONE`. extent: (..., 2)."""
    size = np.maximum(seen.high, extent / 2) - np.minimum(seen.low, -extent / 2)
    return np.asarray(size.max(-1) < ONE)


def _goes_along(velocity: Floats, other: Floats) -> Bools:
    """(...) whether two velocities (..., 2) may be those of one small thing."""
    return (np.linalg.norm(velocity - other, axis=-1) < SWING) & ((velocity * other).sum(-1) >= 0)


def twins(tracks: Sequence[Track]) -> dict[int, int]:
    """Tracks that follow parts of one small thing: number of the later one -> number of the first."""
    if len(tracks) < 2:
        return {}
    headings, centres = np.array([track.heading for track in tracks]), np.stack([track.centre for track in tracks])
    extent = np.stack([track.extent for track in tracks])
    corners = np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]]) * extent[:, None] / 2
    corners = se2.apply(np.concatenate([headings[:, None], centres], axis=1), corners)  # (T, 4, 2)
    seen = box.covers(corners.reshape(-1, 2), 4 * np.arange(len(tracks)), centres, headings)  # (T, T, 2)
    velocity = np.stack([track.velocity for track in tracks])
    is_one = _fits(seen, extent[:, None]) & _goes_along(velocity[:, None], velocity)
    first: dict[int, int] = {}
    for i, j in np.argwhere(is_one & is_one.T).tolist():
        if i < j and tracks[i].number not in first:
            first.setdefault(tracks[j].number, tracks[i].number)
    return first


def assign(cost: Floats) -> list[tuple[int, int]]:
    """Pairs (row, column) one to one: as many as possible of finite cost (T, K), and of these the cheapest."""
    from scipy.optimize import linear_sum_assignment  # slow to import, and not needed without moving objects

    finite = np.isfinite(cost)
    if not finite.any():
        return []
    beyond = float(cost[finite].max()) * min(cost.shape) + 1.0
    rows, columns = linear_sum_assignment(np.where(finite, cost, beyond))
    return [(int(i), int(k)) for i, k in zip(rows, columns, strict=True) if finite[i, k]]
