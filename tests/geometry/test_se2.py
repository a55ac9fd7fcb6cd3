import math

import numpy as np
import oracles
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from support import assert_close, normal

from torchcrf_scan.geometry import se2

ANGLES = st.floats(-50, 50)
MOTIONS = st.tuples(ANGLES, st.floats(-20, 20), st.floats(-20, 20))


def as_row(motion: tuple[float, ...]) -> torch.Tensor:
    return torch.tensor(motion, dtype=torch.float64)


@given(ANGLES)
def test_wrap(angle: float) -> None:
    wrapped = float(se2.wrap(as_row((angle,))))
    assert -math.pi <= wrapped <= math.pi
    assert math.cos(wrapped) == pytest.approx(math.cos(angle), abs=1e-9)
    assert math.sin(wrapped) == pytest.approx(math.sin(angle), abs=1e-9)


def test_wrap_keeps_pi_and_turns_minus_pi() -> None:
    angles = np.array([math.pi, -math.pi, 3 * math.pi, 0.0, -0.5])
    np.testing.assert_allclose(se2.wrap(angles), [math.pi, math.pi, math.pi, 0.0, -0.5])


@given(MOTIONS, st.integers(0, 5))
def test_apply(motion: tuple[float, ...], points: int) -> None:
    p = normal(points, 2)
    moved = se2.apply(as_row(motion), p)
    assert moved.shape == (points, 2)
    for before, after in zip(p.tolist(), moved.tolist(), strict=True):
        assert after == pytest.approx(oracles.move(motion, before))


@given(MOTIONS, MOTIONS)
def test_compose_applies_the_first_then_the_second(second: tuple[float, ...], first: tuple[float, ...]) -> None:
    p = normal(4, 2)
    composed = se2.compose(as_row(second), as_row(first))
    assert_close(se2.apply(composed, p), se2.apply(as_row(second), se2.apply(as_row(first), p)), tolerance=1e-8)
    assert -math.pi <= float(composed[0]) <= math.pi


@given(MOTIONS)
def test_inverse_undoes(motion: tuple[float, ...]) -> None:
    p = normal(4, 2)
    assert_close(se2.apply(se2.inverse(as_row(motion)), se2.apply(as_row(motion), p)), p, tolerance=1e-8)


def test_inverse_of_half_a_turn_stays_in_the_range_of_angles() -> None:
    assert se2.inverse(np.array([math.pi, 1.0, 0.0])) == pytest.approx([math.pi, 1.0, 0.0])


def test_distance() -> None:
    rotation, translation = se2.distance(as_row((math.pi - 0.1, 3.0, 0.0)), as_row((0.1 - math.pi, 0.0, 4.0)))
    assert float(rotation) == pytest.approx(0.2)
    assert float(translation) == pytest.approx(5.0)


def test_batch_equals_loop() -> None:
    a, b, p = normal(3, 2, 3, seed=1), normal(3, 2, 3, seed=2), normal(3, 2, 5, 2, seed=3)
    applied, composed, inverted, apart = se2.apply(a, p), se2.compose(a, b), se2.inverse(a), se2.distance(a, b)
    assert apart[0].shape == apart[1].shape == (3, 2)
    for i, j in np.ndindex(3, 2):
        assert_close(applied[i, j], se2.apply(a[i, j], p[i, j]))
        assert_close(composed[i, j], se2.compose(a[i, j], b[i, j]))
        assert_close(inverted[i, j], se2.inverse(a[i, j]))
        assert_close(torch.stack([d[i, j] for d in apart]), torch.stack(se2.distance(a[i, j], b[i, j])))


def test_motions_broadcast_over_points() -> None:
    motions, points = normal(4, 3), normal(6, 2)
    assert_close(se2.apply(motions, points), torch.stack([se2.apply(motion, points) for motion in motions]))


def test_numpy_equals_torch() -> None:
    a, b, p = normal(5, 3, seed=1), normal(5, 3, seed=2), normal(5, 7, 2)
    assert_close(se2.apply(a, p), se2.apply(a.numpy(), p.numpy()))
    assert_close(se2.compose(a, b), se2.compose(a.numpy(), b.numpy()))
    assert_close(se2.inverse(a), se2.inverse(a.numpy()))
    for of_torch, of_numpy in zip(se2.distance(a, b), se2.distance(a.numpy(), b.numpy()), strict=True):
        assert isinstance(of_numpy, np.ndarray)
        assert_close(of_torch, of_numpy)


def test_gradients() -> None:
    inputs = [normal(2, 3, seed=seed).requires_grad_() for seed in (1, 2)] + [normal(2, 3, 2, seed=3).requires_grad_()]
    assert torch.autograd.gradcheck(lambda a, b, p: se2.apply(se2.compose(a, se2.inverse(b)), p), inputs)
