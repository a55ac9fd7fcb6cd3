"""Motions of labels and of beliefs, against the eager functions."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from support import generator, make_points, normal
from torch import Tensor

from torchcrf_scan.fast import motion
from torchcrf_scan.geometry import se2
from torchcrf_scan.inference import motion as eager

SCALE, MIN_EXTENT, C = 0.2, 0.1, 4
NO_BELIEFS = motion.Partners(np.zeros(0), np.zeros((0, 2)), np.zeros((0, 2))), np.zeros((0, 0))
HERE = torch.tensor([1.0, 2.0], dtype=torch.float64)
CLOUDS: dict[str, Callable[[int], Tensor]] = {
    "spread": lambda n: make_points(n, 3),
    "identical": lambda n: HERE.expand(n, 2).clone(),
    "collinear": lambda n: HERE + torch.arange(n, dtype=torch.float64)[:, None] * HERE.flip(0) / 4,
}


def array(values: Tensor) -> Any:
    return np.ascontiguousarray(values.numpy())


@pytest.mark.parametrize("metric", ["point", "line", "given"])
@pytest.mark.parametrize("cloud", CLOUDS)
@pytest.mark.parametrize(("n", "m"), [(40, 30), (1, 1), (2, 3), (3, 3), (9, 4)])
def test_motions_agree_with_the_eager_ones(metric: str, cloud: str, n: int, m: int) -> None:
    source, target = CLOUDS[cloud](n), CLOUDS[cloud](m)
    tangents = torch.nn.functional.normalize(normal(m, 2, seed=9), dim=-1)
    tangents[0] = 0
    for seed in range(4):
        association = torch.randint(-1, m, (n,), generator=generator(seed))
        cluster = torch.randint(-1, C - 1, (n,), generator=generator(seed + 9))  # the last one has no points
        start = eager.Motions.start(normal(1, C, 3, seed=seed), torch.tensor([[True, True, seed % 2 == 0, True]]))
        support = eager.hard_support(source[None], target[None], tangents[None], association[None], cluster[None], C)
        expected = start.value
        if metric != "given":
            scale = torch.tensor(SCALE, dtype=torch.float64)
            expected = eager.estimate(source[None], support, start, metric=metric, scale=scale, min_extent=MIN_EXTENT).value
        labels, motions, active = (array(association), array(cluster)), array(start.value[0]), array(start.active[0])
        scans = array(source), array(target), array(tangents)
        found = motion.estimate(*scans, *labels, *NO_BELIEFS, motions, active, motion.METRICS.index(metric), SCALE, MIN_EXTENT)
        difference = found - expected[0].numpy()
        difference[:, 0] = se2.wrap(difference[:, 0])  # half a turn is one either way
        np.testing.assert_allclose(difference, 0, atol=1e-9)
        np.testing.assert_array_equal(motions, start.value[0])
        count = motion.count_points(*labels, C)
        np.testing.assert_array_equal(count, support.count[0])
        empty_for = np.zeros(C, np.int64)
        for _ in range(3):
            motion.retire_empty(active, empty_for, count)
            start = eager.retire_empty(start, support.count)
            np.testing.assert_array_equal(active, start.active[0])
            np.testing.assert_array_equal(empty_for, start.empty_for[0])


@pytest.mark.parametrize("metric", ["point", "line"])
@pytest.mark.parametrize(("n", "m"), [(40, 30), (1, 1), (2, 3), (9, 4)])
def test_motions_of_beliefs_agree_with_the_eager_ones(metric: str, n: int, m: int) -> None:
    source, target, K = make_points(n, 3), make_points(m, 4), min(3, m)
    source[0] = 0  # as padding, it has no weight
    tangents = torch.nn.functional.normalize(normal(m, 2, seed=9), dim=-1)
    for seed in range(4):
        candidates = torch.rand(n, m, generator=generator(seed)).topk(K).indices.sort(-1).values
        log_association, log_cluster = (torch.log_softmax(3 * normal(n, S, seed=seed + S), -1) for S in (K + 1, C + 1))
        log_cluster[:, 2] = -torch.inf
        best = log_association.argmax(-1)
        association = torch.cat([candidates, torch.full((n, 1), -1)], 1).gather(1, best[:, None])[:, 0]
        cluster = log_cluster.argmax(-1)
        cluster[cluster == C] = -1
        start = eager.Motions.start(normal(1, C, 3, seed=seed) / 9, torch.tensor([[True, True, False, True]]))
        geometry = source[None], target[None], tangents[None]
        hard = eager.hard_support(*geometry, association[None], cluster[None], C)
        soft = eager.soft_support(*geometry, hard, candidates[None], log_association[None], log_cluster[None])
        scale = torch.tensor(SCALE, dtype=torch.float64)
        expected = eager.estimate(source[None], soft, start, metric=metric, scale=scale, min_extent=MIN_EXTENT).value[0]
        labels, scans = (array(association), array(cluster)), (array(source), array(target), array(tangents))
        partners = motion.soft_partners(*scans, labels[0], array(candidates), array(log_association))
        given = array(start.value[0]), array(start.active[0]), motion.METRICS.index(metric), SCALE, MIN_EXTENT
        found = motion.estimate(*scans, *labels, partners, array(log_cluster), *given)
        np.testing.assert_allclose(found, expected.numpy(), atol=1e-9)


def test_no_points_leave_the_motions() -> None:
    nobody, motions = np.full(5, -1), array(normal(C, 3))
    scans = array(make_points(5)), array(make_points(4)), np.zeros((4, 2))
    found = motion.estimate(*scans, nobody, nobody, *NO_BELIEFS, motions, np.ones(C, np.bool_), motion.LINE, SCALE, MIN_EXTENT)
    np.testing.assert_array_equal(found, motions)
