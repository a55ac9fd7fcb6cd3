"""Relative pose errors: by hand, and the same as evo's."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from torchcrf_scan.evaluation.trajectory import pairs_over, relative_error
from torchcrf_scan.geometry import se2


def walk(steps: int, seed: int, noise: float = 0.0) -> np.ndarray:
    """(steps + 1, 3) poses of a path with stops, whose steps are disturbed by noise."""
    rng, disturb = np.random.default_rng(seed), np.random.default_rng(seed + 1)
    poses = [np.zeros(3)]
    for _ in range(steps):
        step = np.array([rng.normal(0, 0.1), rng.choice([0.0, 0.1, 0.3]) * rng.uniform(0.9, 1.1), 0.0])
        poses.append(se2.compose(poses[-1], step + noise * disturb.normal(0, 1, 3)))
    return np.array(poses)


def test_a_scale_error_grows_with_the_distance() -> None:
    reference = np.stack([np.zeros(50), 0.25 * np.arange(50), np.zeros(50)], axis=1)
    found = [relative_error(reference * [1, 1.02, 1], reference, distance) for distance in (1.0, 2.0)]
    np.testing.assert_allclose(found[0].translation, 0.02)
    np.testing.assert_allclose(found[1].translation, 0.04)
    assert [len(of) for of in found] == [46, 42]
    np.testing.assert_array_equal(found[0].rotation, 0)


@given(st.floats(-3, 3), st.floats(-9, 9), st.integers(0, 99))
def test_frames_do_not_matter(theta: float, x: float, seed: int) -> None:
    poses, reference = walk(30, seed, 0.01), walk(30, seed)
    moved = se2.compose(np.array([theta, x, 1.0]), poses)
    ours, theirs = relative_error(poses, reference, 1.0), relative_error(moved, reference, 1.0)
    np.testing.assert_allclose(ours.translation, theirs.translation, atol=1e-9)
    np.testing.assert_allclose(ours.rotation, theirs.rotation, atol=1e-9)


@pytest.mark.parametrize("distance", [1.0, 3.0])
@pytest.mark.parametrize("seed", range(5))
def test_evo_finds_the_same(distance: float, seed: int) -> None:
    metrics = pytest.importorskip("evo.core.metrics", reason="needs evo (extra test)")
    trajectory = pytest.importorskip("evo.core.trajectory", reason="needs evo (extra test)")
    poses, reference = walk(120, seed, 0.02), walk(120, seed)

    def path(of: np.ndarray) -> object:
        zero = np.zeros(len(of))
        quaternions = np.stack([np.cos(of[:, 0] / 2), zero, zero, np.sin(of[:, 0] / 2)], axis=1)
        return trajectory.PosePath3D(np.stack([of[:, 1], of[:, 2], zero], axis=1), quaternions)

    found = relative_error(poses, reference, distance)
    for relation, errors in (("translation_part", found.translation), ("rotation_angle_rad", found.rotation)):
        kind = metrics.PoseRelation[relation]
        rpe = metrics.RPE(kind, distance, metrics.Unit.meters, 0.1, all_pairs=True, pairs_from_reference=True)
        rpe.process_data((path(reference), path(poses)))
        assert len(found) == len(rpe.error) > 20
        np.testing.assert_allclose(np.sort(errors), np.sort(rpe.error), atol=1e-6)


def test_no_path_has_no_pairs() -> None:
    for still in (np.zeros((0, 3)), np.zeros((1, 3)), np.zeros((9, 3))):
        found = relative_error(still, still, 1.0)
        assert len(found) == 0


def test_pairs_begin_everywhere_and_go_ahead() -> None:
    poses = walk(200, 0)
    start, end = pairs_over(poses, 2.0)
    assert (end > start).all()
    assert len(np.unique(start)) == len(start)


@pytest.mark.parametrize(
    ("poses", "distance", "message"),
    [(np.zeros((2, 2)), 1.0, r"poses: expected \(S, 3\)"), (np.zeros((3, 3)), 0.0, "distance: .* got 0")],
)
def test_wrong_arguments_are_named(poses: np.ndarray, distance: float, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        relative_error(poses, np.zeros((3, 3)), distance)
