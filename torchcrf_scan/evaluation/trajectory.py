"""Errors of trajectories: relative pose error over given distances, as on odometry benchmarks."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from torchcrf_scan.errors import TorchCRFScanError
from torchcrf_scan.geometry import se2
from torchcrf_scan.scan import Floats, Ints

TOLERANCE = 0.1  # share of a distance by which the nearest pair of poses may miss it
SAME_TIME = 0.01  # seconds between stamps that count as the same


@dataclass(frozen=True, slots=True)
class RelativeError:
    """Relative pose errors of P pairs of poses.

    Attributes:
        distance: metres of the reference's path between the poses of each pair.
        translation: (P,) metres. rotation: (P,) radians.
    """

    distance: float
    translation: Floats
    rotation: Floats

    def __len__(self) -> int:
        return len(self.translation)

    def summary(self) -> dict[str, float]:
        """`pairs`; root mean square and median of `translation` (metres) and `rotation` (radians); NaN without pairs."""
        return {
            "pairs": float(len(self)),
            **_spread("translation", self.translation),
            **_spread("rotation", self.rotation),
        }


def _spread(key: str, values: Floats) -> dict[str, float]:
    is_empty = not len(values)
    rmse, median = (np.nan, np.nan) if is_empty else (np.sqrt((values**2).mean()), np.median(values))
    return {f"{key}_rmse": float(rmse), f"{key}_median": float(median)}


def same_times(stamps: Floats, others: Floats, tolerance: float = SAME_TIME) -> tuple[Ints, Ints]:
    """Indices (P,) into both of the stamps that are nearest to each other, within `tolerance` seconds, in the first's order.

    stamps: (S,), others: (T,), seconds, in any order.
    """
    if not len(stamps) or not len(others):
        return np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.int64)
    there, back = _nearest(stamps, others), _nearest(others, stamps)
    ours = np.arange(len(stamps))
    kept = (back[there] == ours) & (np.abs(stamps - others[there]) <= tolerance)
    return ours[kept], there[kept]


def _nearest(stamps: Floats, others: Floats) -> Ints:
    """(S,) index of the nearest of `others` (T,), T > 0, to every stamp; the earlier one of two as near."""
    order = np.argsort(others, kind="stable")
    after = np.clip(np.searchsorted(others[order], stamps), 0, len(others) - 1)
    before = np.maximum(after - 1, 0)
    is_before = np.abs(others[order[before]] - stamps) <= np.abs(others[order[after]] - stamps)
    return np.where(is_before, order[before], order[after])


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
        poses: (S, 3) estimated. reference: (S, 3) true, at the same times (`same_times`). Each in a frame of its own.
        distance: metres along the reference.

    Raises:
        ValueError: other shapes, or a distance that is not positive.

    Source: Sturm et al., A Benchmark for the Evaluation of RGB-D SLAM Systems, IROS 2012.
    """
    if poses.ndim != 2 or poses.shape[1] != 3 or poses.shape != reference.shape:
        raise TorchCRFScanError(f"poses: expected (S, 3) like the reference {reference.shape}, got {poses.shape}")
    if not distance > 0:
        raise TorchCRFScanError(f"distance: expected metres above 0, got {distance}")
    if not len(poses):
        return RelativeError(distance, np.zeros(0), np.zeros(0))
    start, end = pairs_over(reference, distance)
    moved, should = (se2.compose(se2.inverse(of[start]), of[end]) for of in (poses, reference))
    error = se2.compose(se2.inverse(should), moved)
    return RelativeError(distance, np.hypot(error[:, 1], error[:, 2]), np.abs(error[:, 0]))
