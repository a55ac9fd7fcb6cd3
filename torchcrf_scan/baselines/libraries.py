"""Registration by other people's libraries, where they are installed (`pip install torchcrf-scan[bench]`)."""

from __future__ import annotations

import numpy as np

from torchcrf_scan.baselines.labels import all_outliers
from torchcrf_scan.baselines.trimmed_icp import match_under
from torchcrf_scan.scan import Floats, PairPrediction, Scan, ScanPair

REACH = 1.0  # metres between corresponding points, small_gicp's default; Open3D has none
FEWEST_POINTS = 3


def match_small_gicp(pair: ScanPair) -> PairPrediction:
    """Background everywhere under small_gicp's ICP from the identity (its GICP needs normals, and a plane's are all vertical)."""
    if min(len(pair.source), len(pair.target)) < FEWEST_POINTS:
        return _unregistered(pair)
    import small_gicp

    target, source = (small_gicp.PointCloud(_flat_cloud(scan)) for scan in (pair.target, pair.source))
    found = small_gicp.align(target, source, registration_type="ICP", max_correspondence_distance=REACH, max_iterations=50)
    return match_under(pair, planar_motion(found.T_target_source))


def match_open3d(pair: ScanPair) -> PairPrediction:
    """Background everywhere under Open3D's point-to-point ICP from the identity."""
    if min(len(pair.source), len(pair.target)) < FEWEST_POINTS:
        return _unregistered(pair)
    import open3d

    source, target = (
        open3d.geometry.PointCloud(open3d.utility.Vector3dVector(_flat_cloud(scan))) for scan in (pair.source, pair.target)
    )
    found = open3d.pipelines.registration.registration_icp(source, target, REACH)
    return match_under(pair, planar_motion(found.transformation))


def planar_motion(transform: Floats) -> Floats:
    """(3,) motion in the plane of a (4, 4) rigid transform about the vertical."""
    return np.array([np.arctan2(transform[1, 0], transform[0, 0]), transform[0, 3], transform[1, 3]])


def _flat_cloud(scan: Scan) -> Floats:
    """(N, 3) points at height 0."""
    return np.column_stack([scan.points, np.zeros(len(scan))])


def _unregistered(pair: ScanPair) -> PairPrediction:
    """What the libraries are not asked: too few points to register stay where they are."""
    is_empty = not len(pair.source) or not len(pair.target)
    return all_outliers(pair) if is_empty else match_under(pair, np.zeros(3))
