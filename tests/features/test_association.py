import math

import oracles
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from support import all_real, assert_close, make_points, normal, pad
from torch import Tensor

from torchcrf_scan.features.association import (
    outlier_inputs,
    pairwise_features,
    position_features,
    registered_feature,
    shape_features,
)
from torchcrf_scan.features.candidates import by_motion, every_target
from torchcrf_scan.features.scales import Scales, robust_square
from torchcrf_scan.features.shape import describe
from torchcrf_scan.geometry import se2
from torchcrf_scan.names import SHAPE_CHANNELS

SEEDS = st.integers(0, 10_000)
LENGTHS = st.integers(1, 7)
MOTION = torch.tensor([[0.4, -0.3, 0.6]], dtype=torch.float64)  # of all points, at L12
INITIAL = torch.tensor([[0.1, 0.5, -0.2]], dtype=torch.float64)
OPEN = torch.tensor([False])


def make_scales(factor: float = 1.0) -> Scales:
    """float64, every scale different; with a large factor nothing is capped."""
    scales = Scales().double()
    scales.local.copy_(factor * torch.linspace(0.3, 1.4, 12))
    scales.pairwise.copy_(factor * torch.tensor([0.7, 1.1]))
    scales.pairwise_outlier.copy_(torch.tensor([-0.6, -0.8]))
    return scales


def local_features(
    source: Tensor,
    target: Tensor,
    candidates: Tensor,
    scales: Scales,
    *,
    masks: tuple[Tensor, Tensor] | None = None,
    closed: tuple[Tensor, Tensor] = (OPEN, OPEN),
    motion: Tensor = MOTION,
    initial: Tensor = INITIAL,
) -> Tensor:
    """L1..L12: (B, N, K, 12)."""
    of_source, of_target = masks or (all_real(source), all_real(target))
    shapes = describe(source, of_source, closed[0]), describe(target, of_target, closed[1])
    return torch.cat(
        [
            shape_features(*shapes, candidates, scales),
            position_features(source, target, candidates, initial, scales),
            registered_feature(se2.apply(motion, source), target, candidates, scales)[..., None],
        ],
        dim=-1,
    )


def dense(source: Tensor, target: Tensor) -> Tensor:
    return every_target(source, all_real(target))[0]


@given(LENGTHS, LENGTHS, st.booleans(), st.booleans(), SEEDS)
@settings(max_examples=25)
def test_local_channels_equal_the_loops(n: int, m: int, source_closed: bool, target_closed: bool, seed: int) -> None:
    source, target = make_points(n, seed, closed=source_closed), make_points(m, seed + 1, closed=target_closed)
    scales = make_scales()
    closed = torch.tensor([source_closed]), torch.tensor([target_closed])
    found = local_features(source[None], target[None], dense(source[None], target[None]), scales, closed=closed)
    moved = se2.apply(MOTION[0], source).numpy()
    expected = oracles.local_association(
        source.numpy(), target.numpy(), scales.local.tolist(), INITIAL[0].tolist(), moved, source_closed, target_closed
    )
    assert_close(found[0], expected)


@given(LENGTHS, LENGTHS, SEEDS)
def test_pairwise_channels_equal_the_loops(n: int, m: int, seed: int) -> None:
    source, target, scales = make_points(n, seed), make_points(m, seed + 1), make_scales()
    found = pairwise_features(source[None], target[None], dense(source[None], target[None]), scales)
    assert found.shape == (1, n - 1, m + 1, m + 1, 4)
    expected = oracles.pairwise_association(
        source.numpy(), target.numpy(), scales.pairwise.tolist(), scales.pairwise_outlier.tolist()
    )
    assert_close(found[0], expected)


@given(LENGTHS, LENGTHS, st.integers(1, 5), SEEDS)
@settings(max_examples=25)
def test_candidates_select_from_the_dense_features(n: int, m: int, K: int, seed: int) -> None:
    source, target, scales = make_points(n, seed)[None], make_points(m, seed + 1)[None], make_scales()
    candidates = torch.randint(m, (1, n, K), generator=torch.Generator().manual_seed(seed))
    every = local_features(source, target, dense(source, target), scales)
    assert_close(local_features(source, target, candidates, scales), every.gather(2, candidates[..., None].expand(-1, -1, -1, 12)))
    edges = pairwise_features(source, target, dense(source, target), scales)[0]
    states = torch.cat([candidates[0], torch.full((n, 1), m)], dim=1)
    of_candidates = pairwise_features(source, target, candidates, scales)[0]
    for i in range(n - 1):
        assert_close(of_candidates[i], edges[i][states[i]][:, states[i + 1]])


@given(LENGTHS, LENGTHS, st.integers(0, 3), SEEDS)
def test_all_targets_as_candidates_are_the_dense_model(n: int, m: int, extra: int, seed: int) -> None:
    source, scales = make_points(n, seed)[None], make_scales()
    target, mask = pad(make_points(m, seed + 1)[None], extra)
    found = by_motion(source, target, mask, MOTION[:, None], torch.ones(1, 1, dtype=torch.bool), count=m)
    assert found.mask[..., :m].all()
    assert not found.mask[..., m:].any()
    real = target[:, :m]
    features = local_features(source, target, found.index, scales, masks=(all_real(source), mask))
    assert_close(features[:, :, :m], local_features(source, real, dense(source, real), scales))


@given(st.integers(2, 7), LENGTHS, st.floats(-3, 3), st.floats(-5, 5), st.booleans(), SEEDS)
def test_shape_channels_do_not_change_when_a_scan_moves(n: int, m: int, theta: float, shift: float, first: bool, seed: int) -> None:
    source, target, scales = make_points(n, seed)[None], make_points(m, seed + 1)[None], make_scales()
    motion = torch.tensor([[theta, shift, 1.0]], dtype=torch.float64)
    before = local_features(source, target, dense(source, target), scales)[..., :SHAPE_CHANNELS]
    if first:
        source = se2.apply(motion, source)
    else:
        target = se2.apply(motion, target)
    assert_close(local_features(source, target, dense(source, target), scales)[..., :SHAPE_CHANNELS], before, tolerance=1e-9)


@pytest.mark.parametrize("side", ["source", "target"])
def test_radius_and_translation_do_change(side: str) -> None:
    scans, scales = {"source": make_points(6, 1)[None], "target": make_points(5, 2)[None]}, make_scales(100.0)
    before = local_features(**scans, candidates=dense(**scans), scales=scales)
    scans[side] = se2.apply(MOTION, scans[side])
    change = (local_features(**scans, candidates=dense(**scans), scales=scales) - before).abs().amax((0, 1, 2))
    assert (change[:9] < 1e-9).all()
    assert (change[9:11] > 1e-4).all()


@given(st.integers(2, 8), SEEDS)
def test_identical_scans_fit_on_the_diagonal(n: int, seed: int) -> None:
    points, scales = make_points(n, seed)[None], make_scales()
    still = torch.zeros(1, 3, dtype=torch.float64)
    local = local_features(points, points, dense(points, points), scales, motion=still, initial=still)[0]
    diagonal = local[range(n), range(n)]
    assert_close(diagonal, torch.zeros(n, 12), tolerance=1e-12)
    assert (local <= diagonal[:, None] + 1e-12).all()
    path = pairwise_features(points, points, dense(points, points), scales)[0][range(n - 1), range(n - 1), range(1, n)]
    assert_close(path, torch.tensor([1.0, 0.0, 0.0, 0.0]).expand(n - 1, 4), tolerance=1e-12)


def test_one_scale_in_every_channel() -> None:
    source, target = make_points(6, 1)[None], make_points(6, 2)[None]
    wide, wider = (local_features(source, target, dense(source, target), make_scales(factor)) for factor in (100.0, 200.0))
    assert_close(wide, 4 * wider)
    tight = local_features(source, target, dense(source, target), make_scales(1e-9))
    assert float(tight.min()) == -9


@given(LENGTHS, LENGTHS, st.integers(0, 4), st.booleans(), SEEDS)
@settings(max_examples=25)
def test_padding_and_other_pairs_are_invisible(n: int, m: int, extra: int, closed: bool, seed: int) -> None:
    alone, others = (make_points(n, seed)[None], make_points(m, seed + 1)[None]), (make_points(7, 8)[None], make_points(7, 9)[None])
    scales = make_scales()
    padded, masks = [], []
    for mine, other in zip(alone, others, strict=True):
        size = 7 + extra
        both = [pad(mine, size - mine.shape[1]), pad(other, size - 7)]
        padded.append(torch.cat([points for points, _ in both]))
        masks.append(torch.cat([mask for _, mask in both]))
    is_closed = torch.tensor([closed, not closed])
    found = local_features(
        *padded,
        every_target(padded[0], masks[1])[0],
        scales,
        closed=(is_closed, is_closed),
        masks=(masks[0], masks[1]),
        motion=MOTION.repeat(2, 1),
        initial=INITIAL.repeat(2, 1),
    )
    single = local_features(*alone, dense(*alone), scales, closed=(is_closed[:1], is_closed[:1]))
    assert found.isfinite().all()
    assert_close(found[0, :n, :m], single[0])
    edges = pairwise_features(padded[0], padded[1], every_target(padded[0], masks[1])[0], scales)
    states = [*range(m), padded[1].shape[1]]
    assert_close(edges[0, : n - 1][:, states][:, :, states], pairwise_features(*alone, dense(*alone), scales)[0])


def test_batch_equals_loop() -> None:
    source, target = (torch.stack([make_points(6, seed + b) for b in range(3)]) for seed in (0, 10))
    motion, initial, scales = normal(3, 3, seed=1), normal(3, 3, seed=2), make_scales()
    closed = torch.tensor([False, True, False])
    candidates = torch.randint(6, (3, 6, 4), generator=torch.Generator().manual_seed(0))
    together = local_features(source, target, candidates, scales, closed=(closed, closed), motion=motion, initial=initial)
    edges = pairwise_features(source, target, candidates, scales)
    for b in range(3):
        one = slice(b, b + 1)
        alone = local_features(
            source[one],
            target[one],
            candidates[one],
            scales,
            closed=(closed[one], closed[one]),
            motion=motion[one],
            initial=initial[one],
        )
        assert_close(together[one], alone)
        assert_close(edges[one], pairwise_features(source[one], target[one], candidates[one], scales))


def test_gradients() -> None:
    scales = make_scales(20.0)
    source, target = make_points(4, 1)[None].requires_grad_(), make_points(3, 2)[None].requires_grad_()
    candidates = dense(source, target)[:, :, 1:]
    motions = [MOTION.clone().requires_grad_(), INITIAL.clone().requires_grad_()]
    assert torch.autograd.gradcheck(
        lambda p, q, g, h: local_features(p, q, candidates, scales, motion=g, initial=h), (source, target, *motions)
    )
    assert torch.autograd.gradcheck(lambda p, q: pairwise_features(p, q, candidates, scales), (source, target))


def test_gradients_where_scans_coincide_are_finite() -> None:
    points, still = make_points(6)[None].requires_grad_(), torch.zeros(1, 3, dtype=torch.float64)
    candidates = dense(points, points)
    local = local_features(points, points.detach(), candidates, make_scales(), motion=still, initial=still)
    edges = pairwise_features(points, points.detach(), candidates, make_scales())
    (gradient,) = torch.autograd.grad(local.sum() + edges.sum(), points)
    assert gradient.isfinite().all()


@given(st.floats(-100, 100), st.floats(0.01, 10))
def test_robust_square(error: float, scale: float) -> None:
    found = robust_square(torch.tensor(error, dtype=torch.float64), torch.tensor(scale, dtype=torch.float64))
    assert float(found) == pytest.approx(oracles.robust(error, scale))


# The outlier booster's inputs.


def test_outlier_inputs_by_hand() -> None:
    local = normal(1, 2, 4, 12)
    margin = torch.tensor([[[1.0, 5.0, 4.0, 2.0], [3.0, 1.0, 9.0, 2.0]]], dtype=torch.float64)
    candidates = torch.tensor([[[0, 4, 6, 7], [0, 1, 2, 3]]])
    mask = torch.tensor([[[True] * 4, [True, True, False, True]]])
    found = outlier_inputs(local, margin, candidates, mask)
    assert found.shape == (1, 2, 14)
    assert_close(found[0, 0, :12], local[0, 0].amax(0))
    assert_close(found[0, 1, :12], local[0, 1, [0, 1, 3]].amax(0))
    assert found[0, 0, 12:].tolist() == [5.0, 3.0]  # 5 at place 4; 4 is only 2 away, so the rival is 2 at place 7
    assert found[0, 1, 12:].tolist() == [3.0, 1.0]  # 3 at place 0; the rival is 2 at place 3


def test_outlier_inputs_without_candidate_or_rival() -> None:
    local, margin = normal(1, 2, 3, 12), normal(1, 2, 3)
    mask = torch.tensor([[[False] * 3, [True] * 3]])
    found = outlier_inputs(local, margin, torch.tensor([[[0, 1, 2], [0, 1, 2]]]), mask)
    assert found[0, 0].tolist() == [-9.0] * 12 + [0.0, 0.0]
    assert float(found[0, 1, 13]) == 0  # no place is 3 away
    assert_close(found[0, 1, 12], margin[0, 1].max())


@given(LENGTHS, st.integers(1, 8), SEEDS)
def test_outlier_inputs_equal_the_loops(n: int, m: int, seed: int) -> None:
    local, margin = normal(1, n, m, 12, seed=seed), normal(1, n, m, seed=seed + 1)
    mask = normal(1, n, m, seed=seed + 2) > 0
    found = outlier_inputs(local, margin, torch.arange(m).expand(1, n, m), mask)
    for i in range(n):
        places = [j for j in range(m) if mask[0, i, j]]
        best = max(places, key=lambda j: float(margin[0, i, j]), default=-1)
        rivals = [float(margin[0, i, j]) for j in places if abs(j - best) >= 3]
        top = float(margin[0, i, best]) if places else 0.0
        expected = [max((float(local[0, i, j, f]) for j in places), default=-9.0) for f in range(12)]
        assert_close(found[0, i], [*expected, top, top - max(rivals) if rivals else 0.0])


def test_outlier_inputs_have_finite_gradients() -> None:
    local, margin = normal(1, 2, 3, 12).requires_grad_(), normal(1, 2, 3).requires_grad_()
    mask = torch.tensor([[[False] * 3, [True] * 3]])
    found = outlier_inputs(local, margin, torch.arange(3).expand(1, 2, 3), mask)
    for gradient in torch.autograd.grad(found.sum(), (local, margin)):
        assert gradient.isfinite().all()
        assert not gradient[0, 0].any()
    assert math.isfinite(float(found.detach().sum()))
