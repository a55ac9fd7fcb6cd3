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


class Comparison:
    """T tracks, at the time of the scan, beside its K sightings.

    Attributes:
        cost: (T, K) squared Mahalanobis distance of motion and extent; infinite beyond the gate.
        is_part: (T, K) whether the sighting lies within the track's box and moves like it.
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


def assign(cost: Floats) -> list[tuple[int, int]]:
    """Pairs (row, column) one to one: as many as possible of finite cost (T, K), and of these the cheapest."""
    from scipy.optimize import linear_sum_assignment  # slow to import, and not needed without moving objects

    finite = np.isfinite(cost)
    if not finite.any():
        return []
    beyond = float(cost[finite].max()) * min(cost.shape) + 1.0
    rows, columns = linear_sum_assignment(np.where(finite, cost, beyond))
    return [(int(i), int(k)) for i, k in zip(rows, columns, strict=True) if finite[i, k]]
