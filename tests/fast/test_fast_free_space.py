"""What beams say of points, against the eager functions."""

from typing import Any

import numpy as np
import pytest
import torch
from support import all_real, make_points, normal
from torch import Tensor

from torchcrf_scan.fast.free_space import look, sweep_of
from torchcrf_scan.features import free_space as eager

HERE = torch.tensor([1.0, 2.0], dtype=torch.float64)
SCANS = {
    "open": (make_points(60, 1), False),
    "closed": (make_points(60, 2, closed=True), True),
    "one point": (make_points(1, 3), False),
    "one point, closed": (make_points(1, 3), True),
    "two points": (make_points(2, 4), False),
    "three points, closed": (make_points(3, 5, closed=True), True),
    "one spot": (HERE.expand(9, 2).clone(), False),
    "duplicates": (make_points(20, 6).repeat_interleave(2, 0), False),
    "collinear": (HERE + torch.arange(12, dtype=torch.float64)[:, None] * torch.tensor([-0.3, 0.1]), False),
    "at the sensor": (torch.zeros(3, 2, dtype=torch.float64), False),
}


def both(points: Tensor, is_closed: bool, origin: Tensor) -> tuple[Any, eager.Sweep]:
    noise = torch.tensor([0.02], dtype=torch.float64)
    reference = eager.Sweep.of(points[None], all_real(points[None]), torch.tensor([is_closed]), noise, origin[None])
    return sweep_of(points.numpy(), 0.02, is_closed, origin.numpy()), reference


@pytest.mark.parametrize("name", SCANS)
@pytest.mark.parametrize("shift", [0.0, 0.7])
def test_looks_agree_with_the_eager_ones(name: str, shift: float) -> None:
    points, is_closed = SCANS[name]
    origin = torch.tensor([shift, -shift / 2], dtype=torch.float64)
    sweep, reference = both(points, is_closed, origin)
    np.testing.assert_allclose(sweep.bearings, reference.bearings[0], atol=1e-12)
    np.testing.assert_allclose(sweep.ranges, reference.ranges[0], atol=1e-12)
    assert sweep.step == pytest.approx(float(reference.step), abs=1e-12)
    anywhere = 4 * normal(400, 2, seed=7)
    expected = eager.look(reference, anywhere[None])
    seen_through, hidden = np.array([look(sweep, x, y) for x, y in anywhere.numpy()]).T
    np.testing.assert_allclose(seen_through, expected.seen_through[0], atol=1e-9)
    np.testing.assert_allclose(hidden, expected.hidden[0], atol=1e-9)


def test_a_scan_without_points_says_nothing() -> None:
    sweep = sweep_of(np.empty((0, 2)), 0.02, False, np.zeros(2))
    assert look(sweep, 1.0, 1.0) == (0.0, 0.0)
