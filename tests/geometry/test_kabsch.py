import math

import numpy as np
import oracles
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from support import assert_close, generator, normal
from torch import Tensor

from torchcrf_scan.geometry import se2
from torchcrf_scan.geometry.kabsch import kabsch, kabsch_naive, safe_atan2

SEEDS = st.integers(0, 10_000)
LINE = torch.tensor([[0.0, 0.0], [1.0, 2.0], [3.0, 6.0], [-1.0, -2.0]], dtype=torch.float64)


def ones(n: int) -> Tensor:
    return torch.ones(n, dtype=torch.float64)


def random_weights(*shape: int, seed: int) -> Tensor:
    return 0.1 + torch.rand(*shape, generator=generator(seed), dtype=torch.float64)


@given(st.floats(-3.1, 3.1), st.floats(-10, 10), st.floats(-10, 10), st.integers(2, 8), SEEDS)
def test_it_recovers_a_motion(theta: float, tx: float, ty: float, points: int, seed: int) -> None:
    motion, source = torch.tensor([theta, tx, ty], dtype=torch.float64), normal(points, 2, seed=seed)
    found = kabsch(source, se2.apply(motion, source), random_weights(points, seed=seed))
    assert_close(found, motion, tolerance=1e-10)


@given(st.integers(2, 8), SEEDS)
def test_it_equals_the_naive_twin(points: int, seed: int) -> None:
    source, target = normal(2, points, 2, seed=seed)  # unrelated points: reflections would often fit better
    weights = random_weights(points, seed=seed)
    fast, naive = kabsch(source, target, weights), kabsch_naive(source, target, weights)
    assert_close(se2.apply(fast, source), se2.apply(naive, source), tolerance=1e-8)


@given(st.integers(2, 6), SEEDS)
def test_no_other_motion_fits_better(points: int, seed: int) -> None:
    source, target = normal(2, points, 2, seed=seed)
    weights = random_weights(points, seed=seed)
    best = kabsch(source, target, weights)

    def cost(motion: Tensor) -> float:
        return oracles.fit_cost(motion.tolist(), source.numpy(), target.numpy(), weights.tolist())

    turned = [torch.tensor([theta, 0.0, 0.0]) for theta in np.linspace(-3, 3, 13)]
    shifted = [torch.tensor([0.0, 0.01 * math.cos(a), 0.01 * math.sin(a)]) for a in np.linspace(0, 6, 7)]
    assert all(cost(best) <= cost(best + change) + 1e-12 for change in turned + shifted)


def test_weights_count_points() -> None:
    source, target = normal(2, 4, 2)
    twice = kabsch(torch.cat([source, source[:1]]), torch.cat([target, target[:1]]), ones(5))
    assert_close(kabsch(source, target, torch.tensor([2.0, 1.0, 1.0, 1.0]).double()), twice)
    assert_close(kabsch(source, target, 1e-12 * ones(4)), kabsch(source, target, ones(4)))


def test_a_point_without_weight_has_no_say() -> None:
    source, target = normal(2, 4, 2)
    wild = torch.tensor([[1e4, -1e4]], dtype=torch.float64)
    found = kabsch(torch.cat([source, wild]), torch.cat([target, -wild]), torch.cat([ones(4), torch.zeros(1)]))
    assert_close(found, kabsch(source, target, ones(4)))


def test_batch_equals_loop() -> None:
    source, target, weights = normal(3, 2, 5, 2, seed=1), normal(3, 2, 5, 2, seed=2), random_weights(3, 2, 5, seed=3)
    found, naive = kabsch(source, target, weights), kabsch_naive(source, target, weights)
    assert found.shape == (3, 2, 3)
    for i, j in np.ndindex(3, 2):
        assert_close(found[i, j], kabsch(source[i, j], target[i, j], weights[i, j]))
        assert_close(naive[i, j], kabsch_naive(source[i, j], target[i, j], weights[i, j]))


def test_gradient() -> None:
    inputs = [normal(2, 4, 2, seed=seed).requires_grad_() for seed in (1, 2)] + [random_weights(2, 4, seed=3).requires_grad_()]
    assert torch.autograd.gradcheck(kabsch, inputs)


def test_collinear_points_have_a_rotation() -> None:
    motion = torch.tensor([2.0, -1.0, 0.5], dtype=torch.float64)
    assert_close(kabsch(LINE, se2.apply(motion, LINE), ones(4)), motion)


def test_one_point_is_a_shift() -> None:
    assert_close(kabsch(torch.tensor([[1.0, 2.0]]), torch.tensor([[4.0, 6.0]]), torch.ones(1)), [0.0, 3.0, 4.0])


SPREAD = normal(4, 2)
SAME = SPREAD[:1].expand(4, 2)
TENTHS = torch.tensor([[0.1, 0.7]], dtype=torch.float64).expand(4, 2)  # their weighted mean is not exactly (0.1, 0.7)
DEGENERATE = {
    "no points": (SPREAD[:0], SPREAD[:0], ones(0)),
    "no weight": (SPREAD, SPREAD.flip(0), 0 * ones(4)),
    "one point": (SPREAD[:1], SPREAD[1:2], ones(1)),
    "one weight": (SPREAD, SPREAD.flip(0), torch.eye(4, dtype=torch.float64)[1]),
    "two points": (SPREAD[:2], SPREAD[2:], ones(2)),
    "identical points": (SAME, SAME + 1, ones(4)),
    "identical points, uneven weights": (TENTHS, TENTHS + torch.tensor([1.1, 0.3]), torch.tensor([0.3, 0.5, 0.9, 0.1])),
    "identical source points": (SAME, SPREAD, ones(4)),
    "identical target points": (SPREAD, SAME, ones(4)),
    "collinear points": (LINE, LINE.flip(0), ones(4)),
    "mirrored points": (
        torch.tensor([[1, 0], [0, 1], [-1, 0], [0, -1]]),
        torch.tensor([[1, 0], [0, -1], [-1, 0], [0, 1]]),
        ones(4),
    ),
    "all but one weight vanishing": (SPREAD, SPREAD.flip(0), torch.tensor([1, 1e-23, 1e-23, 1e-30])),
}
UNDETERMINED = [name for name in DEGENERATE if name.startswith(("no weight", "one", "identical"))]


def fit_degenerate(name: str, dtype: torch.dtype) -> tuple[Tensor, list[Tensor]]:
    inputs = [tensor.to(dtype).clone().requires_grad_() for tensor in DEGENERATE[name]]
    return kabsch(*inputs), inputs


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64], ids=str)
@pytest.mark.parametrize("name", DEGENERATE)
def test_degenerate_input_has_finite_values_and_gradients(name: str, dtype: torch.dtype) -> None:
    motion, inputs = fit_degenerate(name, dtype)
    assert motion.isfinite().all()
    for gradient in torch.autograd.grad(motion.sum(), inputs):
        assert gradient.isfinite().all()


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64], ids=str)
@pytest.mark.parametrize("name", UNDETERMINED)
def test_an_undetermined_rotation_is_0_and_has_gradient_0(name: str, dtype: torch.dtype) -> None:
    motion, inputs = fit_degenerate(name, dtype)
    assert motion[0].item() == 0
    for gradient in torch.autograd.grad(motion[0], inputs):
        assert not gradient.any()


def test_nothing_to_fit_is_the_identity() -> None:
    for name in ("no points", "no weight"):
        assert_close(fit_degenerate(name, torch.float64)[0], [0.0, 0.0, 0.0])


def test_the_naive_twin_without_weight_is_the_identity() -> None:
    assert_close(kabsch_naive(SPREAD, SPREAD.flip(0), 0 * ones(4)), [0.0, 0.0, 0.0])


def test_safe_atan2() -> None:
    y, x = normal(2, 10)
    assert_close(safe_atan2(y, x), torch.atan2(y, x))
    assert torch.autograd.gradcheck(safe_atan2, (y.requires_grad_(), x.requires_grad_()))


def test_safe_atan2_at_the_origin() -> None:
    y, x = torch.zeros(2, 1, requires_grad=True).unbind()
    angle = safe_atan2(y, x)
    assert angle.item() == 0
    assert [gradient.item() for gradient in torch.autograd.grad(angle, (y, x))] == [0.0, 0.0]
