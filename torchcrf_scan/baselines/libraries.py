"""Registration by third-party libraries, if installed (`pip install torchcrf-scan[bench]`)."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from torchcrf_scan.baselines.labels import IDENTITY, all_outliers
from torchcrf_scan.baselines.trimmed_icp import match_under
from torchcrf_scan.scan import Floats, PairPrediction, Scan, ScanPair

REACH = 1.0  # metres between corresponding points, the default of small_gicp; Open3D has none
FEWEST_POINTS = 3
ITERATIONS = 50


def register_small_gicp(pair: ScanPair, guess: Floats = IDENTITY) -> Floats:
    """(3,) motion of small_gicp's ICP in one thread, clouds and tree built anew; its GICP needs normals, undefined for a plane."""
    import small_gicp

    target, source = (small_gicp.PointCloud(_flat_cloud(scan)) for scan in (pair.target, pair.source))
    options = {"registration_type": "ICP", "max_correspondence_distance": REACH, "max_iterations": ITERATIONS, "num_threads": 1}
    return planar_motion(small_gicp.align(target, source, init_T_target_source=spatial_motion(guess), **options).T_target_source)


def register_open3d(pair: ScanPair, guess: Floats = IDENTITY) -> Floats:
    """(3,) motion of Open3D's point-to-point ICP, with its own choice of threads."""
    import open3d

    source, target = (
        open3d.geometry.PointCloud(open3d.utility.Vector3dVector(_flat_cloud(scan))) for scan in (pair.source, pair.target)
    )
    found = open3d.pipelines.registration.registration_icp(source, target, REACH, spatial_motion(guess))
    return planar_motion(found.transformation)


def match_small_gicp(pair: ScanPair) -> PairPrediction:
    """Background everywhere under `register_small_gicp` from the identity."""
    return _match(pair, register_small_gicp)


def match_open3d(pair: ScanPair) -> PairPrediction:
    """Background everywhere under `register_open3d` from the identity."""
    return _match(pair, register_open3d)


def _match(pair: ScanPair, register: Callable[[ScanPair], Floats]) -> PairPrediction:
    """Registers a pair; with too few points the motion is the identity."""
    if not len(pair.source) or not len(pair.target):
        return all_outliers(pair)
    is_enough = min(len(pair.source), len(pair.target)) >= FEWEST_POINTS
    return match_under(pair, register(pair) if is_enough else IDENTITY)


def spatial_motion(motion: Floats) -> Floats:
    """(4, 4) rigid transform about the vertical axis of a planar motion (3,)."""
    theta, x, y = motion
    transform = np.eye(4)
    transform[:2, :2] = [[np.cos(theta), -np.sin(theta)], [np.sin(theta), np.cos(theta)]]
    transform[:2, 3] = x, y
    return transform


def planar_motion(transform: Floats) -> Floats:
    """(3,) planar motion of a (4, 4) rigid transform about the vertical axis."""
    return np.array([np.arctan2(transform[1, 0], transform[0, 0]), transform[0, 3], transform[1, 3]])


def _flat_cloud(scan: Scan) -> Floats:
    """(N, 3) points at height 0."""
    return np.column_stack([scan.points, np.zeros(len(scan))])
