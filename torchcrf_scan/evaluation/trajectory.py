"""Errors of trajectories: relative pose error over given distances, as on odometry benchmarks."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from torchcrf_scan.errors import TorchCRFScanError
from torchcrf_scan.geometry import se2
from torchcrf_scan.scan import Floats, Ints

TOLERANCE = 0.1  # share of a distance by which the nearest pair of poses may miss it


@dataclass(frozen=True, slots=True)
class RelativeError:
    """Relative pose errors of P pairs of poses.

    Attributes:
        translation: (P,) metres. rotation: (P,) radians.
    """

    translation: Floats
    rotation: Floats

    def __len__(self) -> int:
        return len(self.translation)


def pairs_over(poses: Floats, distance: float) -> tuple[Ints, Ints]:
    """Pairs (P,), (P,) of poses between which the path is `distance` metres long, within a tenth of it: one for every start.

    poses: (S, 3) along the path, in order.
    """
    path = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(poses[:, 1:], axis=0).T))])
    start = np.arange(len(poses))
    wanted = path + distance
    after = np.minimum(np.searchsorted(path, wanted), len(path) - 1)
    before = np.searchsorted(path, path[np.maximum(after - 1, 0)])  # the first of poses that stand still
    end = np.where(np.abs(path[before] - wanted) <= np.abs(path[after] - wanted), before, after)
    end = np.where(end > start, end, after)
    kept = (end > start) & (np.abs(path[end] - wanted) <= TOLERANCE * distance)
    return start[kept], end[kept]


def relative_error(poses: Floats, reference: Floats, distance: float) -> RelativeError:
    """Errors of the motion over stretches of a path of a given length.

    The same as `evo_rpe --delta D --delta_unit m --all_pairs --pairs_from_reference`.

    Args:
        poses: (S, 3) estimated. reference: (S, 3) true, at the same times. Each in a frame of its own.
        distance: metres along the reference.

    Raises:
        TorchCRFScanError: other shapes, or a distance that is not positive.

    Source: Sturm et al., A Benchmark for the Evaluation of RGB-D SLAM Systems, IROS 2012.
    """
    if poses.ndim != 2 or poses.shape[1] != 3 or poses.shape != reference.shape:
        raise TorchCRFScanError(f"poses: expected (S, 3) like the reference {reference.shape}, got {poses.shape}")
    if not distance > 0:
        raise TorchCRFScanError(f"distance: expected metres above 0, got {distance}")
    if not len(poses):
        return RelativeError(np.zeros(0), np.zeros(0))
    start, end = pairs_over(reference, distance)
    moved, should = (se2.compose(se2.inverse(of[start]), of[end]) for of in (poses, reference))
    error = se2.compose(se2.inverse(should), moved)
    return RelativeError(np.hypot(error[:, 1], error[:, 2]), np.abs(error[:, 0]))
