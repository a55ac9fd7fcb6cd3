import math

import numpy as np
import torch
from hypothesis import given
from hypothesis import strategies as st
from support import all_real, assert_close, make_points, normal, pad

from torchcrf_scan.features.candidates import by_motion, by_score, every_target, squared_distances
from torchcrf_scan.geometry import se2

SEEDS = st.integers(0, 10_000)
LENGTHS = st.integers(1, 7)


@given(LENGTHS, LENGTHS, st.integers(1, 3), st.integers(1, 7), st.integers(0, 3), SEEDS)
def test_the_nearest_under_any_active_motion(n: int, m: int, C: int, K: int, extra: int, seed: int) -> None:
    source, real = make_points(n, seed)[None], make_points(m, seed + 1)
    target, mask = pad(real[None], extra, value=0.0)
    motions, active = normal(1, C, 3, seed=seed), normal(1, C, seed=seed + 1) > 0
    active[0, 0] = True
    found = by_motion(source, target, mask, motions, active, K)
    for i in range(n):
        moved = [se2.apply(motion, source[0, i : i + 1])[0].tolist() for motion in motions[0]]
        apart = [[math.dist(p, q) for q in real.tolist()] for p in moved]
        best = [min(apart[k][j] for k in range(C) if active[0, k]) for j in range(m)]
        expected = sorted(sorted(range(m), key=best.__getitem__)[:K])
        assert found.index[0, i][found.mask[0, i]].tolist() == expected
        assert found.nearest[0, i][active[0]].tolist() == [apart[k].index(min(apart[k])) for k in range(C) if active[0, k]]


def test_real_candidates_come_first_and_rise() -> None:
    target, mask = pad(make_points(3)[None], 4)
    found = by_motion(make_points(5, 1)[None], target, mask, torch.zeros(1, 1, 3).double(), torch.ones(1, 1, dtype=torch.bool), 5)
    assert found.index.shape == (1, 5, 5)
    assert found.index[0, :, :3].tolist() == [[0, 1, 2]] * 5
    assert found.mask[0].tolist() == [[True] * 3 + [False] * 2] * 5
    assert (found.index < 7).all()


def test_dense() -> None:
    source, (target, mask) = make_points(3)[None], pad(make_points(4)[None], 2)
    for count in (0, 6, 100):
        found = by_motion(source, target, mask, torch.zeros(1, 2, 3).double(), torch.ones(1, 2, dtype=torch.bool), count)
        assert found.index.tolist() == [[[0, 1, 2, 3, 4, 5]] * 3]
        assert found.mask.tolist() == [[[True] * 4 + [False] * 2] * 3]
        assert found.nearest.shape == (1, 3, 2)


def test_an_inactive_motion_proposes_nothing() -> None:
    points = make_points(9)[None]
    shift = points[0, 5] - points[0, 0]  # brings point 0 to point 5
    motions = torch.stack([torch.zeros(3), torch.tensor([0.0, *shift.tolist()])])[None].double()
    for is_active, expected in ((True, {0, 5}), (False, {0})):
        found = by_motion(points, points, all_real(points), motions, torch.tensor([[True, is_active]]), 2)
        assert expected <= set(found.index[0, 0].tolist())
        assert (5 in found.index[0, 0].tolist()) is is_active
        assert found.nearest[0, 0, : 1 + is_active].tolist() == [0, 5][: 1 + is_active]


def test_an_empty_target_has_no_candidates() -> None:
    found = by_motion(
        make_points(3)[None],
        torch.zeros(1, 6, 2).double(),
        torch.zeros(1, 6, dtype=torch.bool),
        torch.zeros(1, 1, 3).double(),
        torch.ones(1, 1, dtype=torch.bool),
        4,
    )
    assert not found.mask.any()
    assert ((found.index >= 0) & (found.index < 6)).all()
    assert ((found.nearest >= 0) & (found.nearest < 6)).all()


def test_batch_equals_loop() -> None:
    source, target = (torch.stack([make_points(6, seed + b) for b in range(3)]) for seed in (0, 10))
    mask = torch.arange(6) < torch.tensor([[6], [4], [1]])
    motions, active = normal(3, 2, 3), torch.tensor([[True, True], [True, False], [True, True]])
    together = by_motion(source, target, mask, motions, active, 3)
    for b in range(3):
        alone = by_motion(source[b : b + 1], target[b : b + 1], mask[b : b + 1], motions[b : b + 1], active[b : b + 1], 3)
        assert torch.equal(together.mask[b], alone.mask[0])
        assert torch.equal(together.index[b][together.mask[b]], alone.index[0][alone.mask[0]])
        assert torch.equal(together.nearest[b], alone.nearest[0])


def test_choosing_has_no_gradient() -> None:
    source, motions = make_points(3)[None].requires_grad_(), torch.zeros(1, 1, 3).double().requires_grad_()
    found = by_motion(source, source, all_real(source), motions, torch.ones(1, 1, dtype=torch.bool), 2)
    assert not found.index.requires_grad


@given(LENGTHS, LENGTHS, st.integers(1, 9), SEEDS)
def test_the_best_by_score(n: int, m: int, K: int, seed: int) -> None:
    score, real = normal(2, n, m, seed=seed), [m, m // 2]
    mask = torch.arange(m) < torch.tensor(real)[:, None]
    index, found_mask = by_score(score, mask, K)
    assert index.shape == found_mask.shape == (2, n, min(K, m))
    for b, i in np.ndindex(2, n):
        ranked = sorted(range(real[b]), key=(-score[b, i]).tolist().__getitem__)
        assert index[b, i][found_mask[b, i]].tolist() == sorted(ranked[:K])


@given(LENGTHS, LENGTHS)
def test_squared_distances(n: int, m: int) -> None:
    moved, target = normal(2, n, 2, seed=1), normal(2, m, 2, seed=2)
    mask = torch.arange(m) < torch.tensor([[m], [m - 1]])
    found = squared_distances(moved, target, mask)
    assert_close(found[0], torch.cdist(moved[0], target[0]) ** 2)
    assert found[1, :, m - 1].tolist() == [math.inf] * n


def test_squared_distances_under_many_motions() -> None:
    moved, target, mask = normal(2, 3, 4, 2, seed=1), normal(2, 5, 2, seed=2), torch.ones(2, 5, dtype=torch.bool)
    assert_close(squared_distances(moved, target, mask), torch.cdist(moved, target[:, None]) ** 2)


def test_every_target() -> None:
    mask = torch.tensor([[True, True, False]])
    index, found = every_target(torch.zeros(1, 2, 2), mask)
    assert index.tolist() == [[[0, 1, 2]] * 2]
    assert found.tolist() == [[[True, True, False]] * 2]
