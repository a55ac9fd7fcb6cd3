import oracles
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from support import all_real, assert_close, generator, make_points, normal, pad
from torch import Tensor

from torchcrf_scan.features.clustering import Correspondence, correspond, local_features, pairwise_features
from torchcrf_scan.features.scales import Scales
from torchcrf_scan.geometry import se2

SEEDS = st.integers(0, 10_000)
LENGTHS = st.integers(1, 7)
MOTIONS = st.integers(1, 4)


def make_scales(factor: float = 1.0) -> Scales:
    scales = Scales().double()
    for name, value in (
        ("cluster_distance", 0.8),
        ("outlier_threshold", 1.3),
        ("neighbour_weight", 2.5),
        ("neighbour_distance", 1.7),
    ):
        getattr(scales, name).fill_(factor * value)
    return scales


def make_case(n: int, m: int, C: int, seed: int) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Source, target, motions, associations (some outliers) and which clusters exist, of one pair."""
    source, target, motions = make_points(n, seed)[None], make_points(m, seed + 1)[None], 0.5 * normal(1, C, 3, seed=seed)
    association = torch.randint(-1, m, (1, n), generator=generator(seed))
    return source, target, motions, association, normal(1, C, seed=seed + 2) > -0.5


def meet(source: Tensor, target: Tensor, motions: Tensor, association: Tensor, target_mask: Tensor | None = None) -> Correspondence:
    mask = all_real(target) if target_mask is None else target_mask
    moved = se2.apply(motions, source[:, None])
    apart = torch.cdist(moved.detach().transpose(1, 2), target.detach()[:, None]).masked_fill(~mask[:, None, None], torch.inf)
    nearest = apart.argmin(-1)  # (B, N, C)
    return correspond(source, target, motions, nearest, association)


@given(LENGTHS, LENGTHS, MOTIONS, SEEDS)
def test_local_channels_equal_the_loops(n: int, m: int, C: int, seed: int) -> None:
    source, target, motions, association, active = make_case(n, m, C, seed)
    scales = make_scales()
    expected = oracles.local_clustering(
        source[0].numpy(),
        target[0].numpy(),
        motions[0].numpy(),
        active[0].tolist(),
        association[0].tolist(),
        float(scales.cluster_distance),
        float(scales.outlier_threshold),
    )
    assert_close(local_features(meet(source, target, motions, association), active, scales)[0], expected)


@given(LENGTHS, LENGTHS, MOTIONS, SEEDS)
def test_pairwise_channels_equal_the_loops(n: int, m: int, C: int, seed: int) -> None:
    source, target, motions, association, _ = make_case(n, m, C, seed)
    scales = make_scales()
    expected = oracles.pairwise_clustering(
        source[0].numpy(),
        target[0].numpy(),
        motions[0].numpy(),
        association[0].tolist(),
        float(scales.neighbour_weight),
        float(scales.neighbour_distance),
    )
    found = pairwise_features(source, meet(source, target, motions, association), scales)
    assert found.shape == (1, n - 1, C + 1, C + 1, 8)
    assert_close(found[0], expected)


def test_correspondence() -> None:
    source, target, motions, association, _ = make_case(6, 5, 3, 4)
    association[0, :2] = torch.tensor([-1, 3])
    at = meet(source, target, motions, association)
    assert at.is_inlier[0, :2].tolist() == [False, True]
    assert_close(at.moved[0, 1, 2], se2.apply(motions[0, 2], source[0, 1:2])[0])
    assert_close(at.partner[0, 1], target[0, 3])
    assert_close(at.residual[0, 1], torch.linalg.vector_norm(at.moved[0, 1] - target[0, 3], dim=-1))
    assert_close(at.residual[0, 0], torch.cdist(at.moved[0, 0], target[0]).amin(-1))


def test_no_cluster_at_all_leaves_every_point_unexplained() -> None:
    source, target, motions, association, _ = make_case(4, 4, 2, 0)
    features = local_features(meet(source, target, motions, association), torch.zeros(1, 2, dtype=torch.bool), make_scales())
    assert features.isfinite().all()
    assert features[0, :, -1, 1].tolist() == [1.0] * 4


def test_true_motion_and_association_are_a_perfect_fit() -> None:
    source = make_points(8)[None]
    motion = torch.tensor([[[0.2, 0.4, -0.1]]], dtype=torch.float64)
    target = se2.apply(motion[:, 0], source)
    at = meet(source, target, motion, torch.arange(8)[None])
    assert_close(local_features(at, torch.ones(1, 1, dtype=torch.bool), make_scales())[0, :, 0, 0], torch.zeros(8))
    edges = pairwise_features(source, at, make_scales())[0, :, 0, 0]
    assert_close(edges[:, 3], torch.ones(7))  # as stiff as can be
    assert_close(edges[:, 5], torch.zeros(7))


def test_the_order_of_movers_does_not_matter() -> None:
    source, target, motions, association, active = make_case(7, 6, 4, 1)
    order = torch.tensor([0, 3, 1, 2])
    states = torch.cat([order, torch.tensor([4])])
    at, permuted = meet(source, target, motions, association), meet(source, target, motions[:, order], association)
    scales = make_scales()
    assert_close(local_features(permuted, active[:, order], scales), local_features(at, active, scales)[:, :, states])
    expected = pairwise_features(source, at, scales)[:, :, states][:, :, :, states]
    assert_close(pairwise_features(source, permuted, scales), expected)


@given(LENGTHS, LENGTHS, st.integers(0, 4), SEEDS)
def test_padding_and_other_pairs_are_invisible(n: int, m: int, extra: int, seed: int) -> None:
    mine, other = make_case(n, m, 3, seed), make_case(7, 7, 3, seed + 5)
    size, scales = 7 + extra, make_scales()
    source = torch.cat([pad(case[0], size - case[0].shape[1])[0] for case in (mine, other)])
    targets = [pad(case[1], size - case[1].shape[1]) for case in (mine, other)]
    association = torch.cat([torch.nn.functional.pad(case[3], (0, size - case[3].shape[1]), value=-1) for case in (mine, other)])
    motions, active = (torch.cat([mine[field], other[field]]) for field in (2, 4))
    at = meet(source, torch.cat([t for t, _ in targets]), motions, association, torch.cat([mask for _, mask in targets]))
    local, edges = local_features(at, active, scales), pairwise_features(source, at, scales)
    for b, (case, length) in enumerate(((mine, n), (other, 7))):
        alone = meet(case[0], case[1], case[2], case[3])
        assert_close(local[b, :length], local_features(alone, case[4], scales)[0])
        assert_close(edges[b, : length - 1], pairwise_features(case[0], alone, scales)[0])
    assert local.isfinite().all()
    assert edges.isfinite().all()


def test_gradients() -> None:
    source, target, motions, association, active = make_case(4, 4, 2, 3)
    association[0, 1] = -1
    nearest = torch.randint(4, (1, 4, 2), generator=generator(0))
    scales = make_scales(20.0)

    def features(p: Tensor, q: Tensor, g: Tensor) -> tuple[Tensor, Tensor]:
        at = correspond(p, q, g, nearest, association)
        return local_features(at, active, scales), pairwise_features(p, at, scales)

    assert torch.autograd.gradcheck(features, [tensor.requires_grad_() for tensor in (source, target, motions)])


@pytest.mark.parametrize("what", ["residual", "edge"])
def test_gradients_of_a_perfect_fit_are_finite(what: str) -> None:
    source = make_points(5)[None].requires_grad_()
    motions = torch.zeros(1, 2, 3, dtype=torch.float64, requires_grad=True)
    at = meet(source, source.detach(), motions, torch.arange(5)[None])
    value = at.residual if what == "residual" else pairwise_features(source, at, make_scales())
    for gradient in torch.autograd.grad(value.sum(), (source, motions)):
        assert gradient.isfinite().all()
