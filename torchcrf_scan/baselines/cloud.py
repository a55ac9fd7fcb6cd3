"""A scan as a point cloud: neighbours, spacing and direction of the surface. Independent of the model's own geometry."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from scipy.spatial import cKDTree

from torchcrf_scan.geometry.kabsch import kabsch
from torchcrf_scan.scan import Bools, Floats, Ints, Scan

GRAZING = math.sin(math.radians(10.0))  # a larger angle of incidence counts as a depth jump


@dataclass(frozen=True, slots=True)
class Cloud:
    """The valid returns of a scan, at least one.

    Attributes:
        points: (N, 2) metres, in beam order.
        ranges: (N,) metres.
        spacing: (N,) metres to the nearest other return, bounded by the footprint of a beam step at normal and grazing incidence.
        tangent: (N, 2) unit vector along the surface, 0 for a point without neighbours on it.
        step: radians between beams, the median.
        tree: the points in a k-d tree.
    """

    points: Floats
    ranges: Floats
    spacing: Floats
    tangent: Floats
    step: float
    tree: cKDTree

    @classmethod
    def of(cls, scan: Scan) -> Cloud:
        """The cloud of a scan with at least one return."""
        points = scan.points
        step = float(np.median(np.diff(scan.bearings))) if len(scan) > 1 else 0.0
        footprint = scan.ranges * step
        tree = cKDTree(points)
        apart = tree.query(points, k=2)[0][:, 1]
        spacing = np.clip(apart, footprint, footprint / GRAZING)
        return cls(points, scan.ranges, spacing, _tangents(points, footprint / GRAZING, scan.is_closed), step, tree)

    def __len__(self) -> int:
        return len(self.points)

    def nearest(self, points: Floats) -> tuple[Floats, Ints]:
        """Distance to and index of the nearest return. points: (..., 2). Returns (...,) each."""
        return self.tree.query(points)

    def hides(self, points: Floats, slack: Floats) -> Bools:
        """(N,) whether points (N, 2) are occluded in this scan: behind the returns of its beams, or where no beam returned.

        slack: (N,) metres by which they must lie behind all the nearest beams.
        """
        ranges = np.linalg.norm(points, axis=-1)
        beams = cKDTree(self.points / self.ranges[:, None])  # on the unit circle, so a full circle needs no special case
        ahead = points / np.maximum(ranges, 1e-9)[:, None]
        apart, index = beams.query(ahead, k=range(1, 1 + min(3, len(self))))  # (N, 3)
        return (apart[:, 0] > 1.5 * self.step) | (ranges - slack > self.ranges[index].max(-1))


def fit_motion(source: Floats, target: Floats, weights: Floats | None = None) -> Floats:
    """(..., 3) least-squares rigid motions. source, target: (..., P, 2) paired points; weights: (..., P), default 1."""
    weights = np.ones(source.shape[:-1]) if weights is None else weights
    return kabsch(*(torch.tensor(array) for array in (source, target, weights))).numpy()


def _tangents(points: Floats, reach: Floats, is_closed: bool) -> Floats:
    """(N, 2) direction from the previous to the next point, using only those within reach. reach: (N,) metres."""
    following = np.roll(points, -1, axis=0) - points  # (N, 2), the last one wraps round
    is_joined = np.linalg.norm(following, axis=1) <= np.minimum(reach, np.roll(reach, -1))
    is_joined[-1] &= is_closed
    arm = following * is_joined[:, None]
    arm = arm + np.roll(arm, 1, axis=0)
    length = np.linalg.norm(arm, axis=1, keepdims=True)
    return arm / np.where(length > 0, length, 1.0)
