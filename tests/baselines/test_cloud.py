"""A scan as a cloud: spacing between bounds, directions of surfaces, what hides behind what, and fitted motions."""

import numpy as np
from rooms import BEARINGS, ONE, ROOM, TWINS, scan_of

from torchcrf_scan.baselines.cloud import GRAZING, Cloud, fit_motion
from torchcrf_scan.geometry import se2
from torchcrf_scan.scan import Scan

RING = Cloud.of(Scan.from_ranges(np.full(360, 4.0), np.radians(np.arange(-180.0, 180.0))))


def test_spacing_lies_between_a_beam_step_and_grazing_incidence() -> None:
    cloud = Cloud.of(scan_of([ROOM]))
    footprint = cloud.ranges * np.radians(1.0)
    assert (cloud.spacing >= footprint * (1 - 1e-9)).all()
    assert (cloud.spacing <= footprint / GRAZING * (1 + 1e-9)).all()
    assert np.allclose(RING.spacing, 4.0 * np.radians(1.0), rtol=1e-3)


def test_tangents_follow_the_wall_and_vanish_for_lonely_points() -> None:
    wall = Cloud.of(Scan.from_ranges(5.0 / np.cos(BEARINGS[60:121]), BEARINGS[60:121]))
    assert np.allclose(wall.tangent, [0.0, 1.0])
    assert Cloud.of(ONE).tangent.tolist() == [[0.0, 0.0]]
    assert not Cloud.of(TWINS).tangent.any()
    assert np.allclose((RING.tangent * RING.points).sum(-1), 0.0)  # the full circle closes
    assert np.allclose(np.linalg.norm(RING.tangent, axis=-1), 1.0)


def test_what_lies_behind_a_wall_is_hidden() -> None:
    points, slack = np.array([[3.0, 0.0], [4.05, 0.0], [4.5, 0.0], [-4.5, 0.01], [-3.5, -0.01]]), np.full(5, 0.1)
    assert RING.hides(points, slack).tolist() == [False, False, True, True, False]


def test_what_no_beam_looks_at_is_hidden() -> None:
    half = Cloud.of(scan_of([ROOM]))
    assert half.hides(np.array([[-1.0, 0.0], [1.0, 0.0]]), np.zeros(2)).tolist() == [True, False]


def test_fitted_motions_of_weighted_points() -> None:
    motion = np.array([0.3, 1.0, -2.0])
    source = np.random.default_rng(0).normal(size=(5, 2))
    target = se2.apply(motion, source)
    assert np.allclose(fit_motion(source, target), motion)
    target[0] += 9.0
    assert np.allclose(fit_motion(source, target, np.array([0.0, 1, 1, 1, 1])), motion)
    assert fit_motion(source, target, np.zeros(5)).tolist() == [0.0, 0.0, 0.0]
