"""Covariances and confidences, against the eager functions."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
import torch
from support import generator, make_points, normal
from torch import Tensor

from torchcrf_scan.fast import uncertainty
from torchcrf_scan.fast.motion import METRICS
from torchcrf_scan.geometry import se2
from torchcrf_scan.inference import uncertainty as eager
from torchcrf_scan.inference.motion import hard_support

SCALE, C = 0.2, 4
HERE = torch.tensor([1.0, 2.0], dtype=torch.float64)
CLOUDS: dict[str, Callable[[int], Tensor]] = {
    "spread": lambda n: make_points(n, 3),
    "identical": lambda n: HERE.expand(n, 2).clone(),
    "corridor": lambda n: torch.stack([torch.arange(n) / 8, (torch.arange(n) % 2) * 2.0], -1).double(),
    "collinear": lambda n: HERE + torch.arange(n, dtype=torch.float64)[:, None] * HERE.flip(0) / 40,
}


@dataclass
class Answer:
    association: Tensor
    cluster: Tensor
    candidates: Tensor
    log_association: Tensor
    log_cluster: Tensor


def array(values: Tensor) -> Any:
    return np.ascontiguousarray(values.numpy())


@pytest.mark.parametrize("metric", METRICS)
@pytest.mark.parametrize("cloud", CLOUDS)
@pytest.mark.parametrize("n", [120, 1, 2, 3])
@pytest.mark.parametrize("noise", [0.02, 0.0])
def test_covariances_agree_with_the_eager_ones(metric: str, cloud: str, n: int, noise: float) -> None:
    source = CLOUDS[cloud](n)
    motions = 0.3 * normal(1, C, 3, seed=2)
    cluster = torch.randint(-1, C - 1, (n,), generator=generator(1))  # the last one has no points
    target = se2.apply(motions[0, cluster.clamp(min=0)], source[:, None])[:, 0] + 0.05 * normal(n, 2, seed=4)
    tangents = torch.nn.functional.normalize(normal(n, 2, seed=9), dim=-1)
    tangents[::5] = 0
    association = torch.arange(n).masked_fill(torch.rand(n, generator=generator(3)) < 0.2, -1)
    support = hard_support(source[None], target[None], tangents[None], association[None], cluster[None], C)
    scale = torch.tensor(SCALE, dtype=torch.float64)
    of_return = torch.tensor([noise], dtype=torch.float64)
    expected = eager.motion_covariance(source[None], support, motions, metric=metric, scale=scale, noise=of_return)
    scans, labels = (array(source), array(target), array(tangents)), (array(association), array(cluster))
    covariance, information, directions = uncertainty.motion_covariance(
        *scans, *labels, array(motions[0]), METRICS.index(metric), SCALE, noise
    )
    spread = expected.covariance[0].diagonal(dim1=-2, dim2=-1).sqrt().numpy()
    unit = spread[:, :, None] * spread[:, None, :]
    np.testing.assert_allclose(covariance / unit, expected.covariance[0].numpy() / unit, atol=1e-6)
    np.testing.assert_allclose(information, expected.information[0], atol=1e-9)
    along = np.abs((directions * expected.directions[0].numpy()).sum(-1))
    is_apart = np.diff(information, axis=1).min(-1) > 1e-3  # else any directions in a plane are as good
    np.testing.assert_allclose(along[is_apart], 1, atol=1e-6)
    np.testing.assert_allclose(directions @ directions.swapaxes(1, 2), np.broadcast_to(np.eye(3), (C, 3, 3)), atol=1e-12)


def test_confidences_agree_with_the_eager_ones() -> None:
    N, K, D = 50, 6, 4
    log_association = torch.log_softmax(20 * normal(1, N, K + 1, seed=1), -1)
    log_association[0, ::3, 2] = -torch.inf
    log_cluster = torch.log_softmax(20 * normal(1, N, D, seed=2), -1)
    log_cluster[0, :, 1] = -torch.inf
    candidates = torch.randint(0, 12, (1, N, K), generator=generator(3)).sort(-1).values
    place, state = log_association.argmax(-1), log_cluster.argmax(-1)
    chosen = torch.cat([candidates, torch.full((1, N, 1), -1)], -1).gather(-1, place[..., None])[..., 0]
    answer = Answer(chosen, torch.where(state == D - 1, -1, state), candidates, log_association, log_cluster)
    calibration = eager.Calibration().double()
    calibration.association.copy_(torch.tensor([0.7, 0.5]))
    calibration.cluster.copy_(torch.tensor([0.5, -0.2]))
    expected = calibration(answer)
    found = (
        uncertainty.association_confidence(
            array(log_association[0]), array(candidates[0]), array(chosen[0]), array(calibration.association)
        ),
        uncertainty.cluster_confidence(array(log_cluster[0]), array(answer.cluster[0]), array(calibration.cluster)),
    )
    for ours, theirs in zip(found, expected, strict=True):
        np.testing.assert_allclose(ours, theirs[0], atol=1e-12)
