"""ComputeRT: the closed forms, the rules for small clusters, and gradients that stay finite when nothing can be told."""

from collections.abc import Callable

import pytest
import torch
from support import assert_close, generator, make_points, normal
from torch import Tensor

from torchcrf_scan.geometry import se2
from torchcrf_scan.geometry.kabsch import kabsch
from torchcrf_scan.inference.motion import (
    PATIENCE,
    Motions,
    RunningSums,
    Support,
    estimate,
    hard_support,
    largest_spread,
    retire_empty,
    soft_support,
    trim,
)

METRICS = ("point", "line")
SCALE = torch.tensor(0.2, dtype=torch.float64)
TRUE = torch.tensor([[0.1, -0.5, 0.2], [-0.3, 1.0, 0.4], [0.7, 0.0, -2.0]], dtype=torch.float64)
HERE = torch.tensor([1.0, 2.0], dtype=torch.float64)
CLOUDS: dict[str, Callable[[int], Tensor]] = {
    "spread": lambda n: make_points(n, 3),
    "identical": lambda n: HERE.expand(n, 2).clone(),
    "collinear": lambda n: HERE + torch.arange(n, dtype=torch.float64)[:, None] * HERE.flip(0) / 4,
    "collinear through the sensor": lambda n: HERE * torch.arange(1, n + 1, dtype=torch.float64)[:, None],
}


def one_hot(labels: Tensor, clusters: int) -> Tensor:
    """(B, N, clusters + 1) certain log-beliefs; label -1 is the last state."""
    states = torch.where(labels >= 0, labels, clusters)
    return torch.nn.functional.one_hot(states, clusters + 1).double().log()


def started(values: Tensor) -> Motions:
    return Motions.start(values, torch.ones(values.shape[:-1], dtype=torch.bool))


def given_support(source: Tensor, partner: Tensor, labels: Tensor, clusters: int) -> Support:
    """Every source point i goes to row i of `partner`; tangents are arbitrary unit vectors."""
    tangents = torch.nn.functional.normalize(normal(*partner.shape, seed=9), dim=-1)
    everyone = torch.arange(source.shape[1]).expand(labels.shape)
    return hard_support(source, partner, tangents, everyone, labels, clusters)


def refit(source: Tensor, support: Support, previous: Motions, metric: str, *, times: int = 1, min_extent: float = 0.1) -> Motions:
    for _ in range(times):
        fitted = estimate(source, support, previous, metric=metric, scale=SCALE, min_extent=min_extent)
        previous = retire_empty(fitted, support.count)
    return previous


def three_clusters(n: int = 30) -> tuple[Tensor, Tensor, Tensor]:
    """Source, target and labels of three clusters that move exactly as `TRUE` says; point i becomes point i."""
    source = make_points(n, 1)[None]
    labels = (torch.arange(n) % 3)[None]
    target = se2.apply(TRUE[labels[0]], source[0, :, None])[None, :, 0]
    return source, target, labels


def test_point_metric_recovers_known_motions() -> None:
    source, target, labels = three_clusters()
    found = refit(source, given_support(source, target, labels, 3), started(torch.zeros(1, 3, 3).double()), "point")
    assert_close(found.value[0], TRUE)
    assert found.active.all()


def test_line_metric_reaches_known_motions_in_a_few_steps() -> None:
    source, target, labels = three_clusters()
    near = started(TRUE[None] + 0.05 * normal(1, 3, 3))
    found = refit(source, given_support(source, target, labels, 3), near, "line", times=60)
    assert_close(found.value[0], TRUE, tolerance=1e-6)


@pytest.mark.parametrize("metric", METRICS)
def test_outliers_and_points_without_association_say_nothing(metric: str) -> None:
    source, target, labels = three_clusters()
    tangents = torch.nn.functional.normalize(normal(*target.shape, seed=9), dim=-1)
    everyone = torch.arange(30)[None]
    previous = started(TRUE[None] + 0.01)
    expected = refit(
        source[:, 6:], hard_support(source[:, 6:], target, tangents, everyone[:, 6:], labels[:, 6:], 3), previous, metric
    )
    association, cluster = everyone.clone(), labels.clone()
    association[:, :3], cluster[:, 3:6] = -1, -1
    found = refit(source, hard_support(source, target, tangents, association, cluster, 3), previous, metric)
    assert_close(found.value, expected.value)


def test_support_counts_and_spread() -> None:
    source, target, labels = three_clusters(9)
    support = given_support(source, target, labels, 4)
    assert support.count.tolist() == [[3.0, 3.0, 3.0, 0.0]]
    for k in range(3):
        eigenvalues = torch.linalg.eigvalsh(torch.cov(source[0, labels[0] == k].T, correction=0))
        assert_close(support.spread[0, k], eigenvalues[-1].sqrt())
    assert float(support.spread[0, 3]) == 0


@pytest.mark.parametrize("metric", METRICS)
def test_certain_beliefs_speak_like_labels(metric: str) -> None:
    source, target, labels = three_clusters()
    target = target + 0.02 * normal(*target.shape)
    labels[:, 5:8] = -1
    association = torch.randint(-1, 30, (1, 30), generator=generator(2))
    candidates = torch.arange(30).expand(1, 30, 30)
    tangents = torch.nn.functional.normalize(normal(1, 30, 2), dim=-1)
    hard = hard_support(source, target, tangents, association, labels, 3)
    soft = soft_support(source, target, tangents, hard, candidates, one_hot(association, 30), one_hot(labels, 3))
    assert_close(soft.weights, hard.weights)
    speaks = hard.weights.sum(1) > 0
    assert_close(soft.partner[speaks], hard.partner[speaks])
    assert_close(soft.tangent[speaks], hard.tangent[speaks])
    previous = started(TRUE[None] + 0.01)
    assert_close(refit(source, soft, previous, metric).value, refit(source, hard, previous, metric).value)


def test_soft_support_is_the_mean_of_what_is_believed() -> None:
    source, target = make_points(2, 0)[None], make_points(3, 1)[None]
    labels = torch.zeros(1, 2, dtype=torch.int64)
    hard = hard_support(source, target, torch.zeros_like(target), labels, labels, 2)
    believed = torch.tensor([[[0.3, 0.1, 0.6], [0.0, 0.5, 0.5]]], dtype=torch.float64)  # two candidates, outlier
    clusters = torch.tensor([[[0.5, 0.25, 0.25], [0.1, 0.9, 0.0]]], dtype=torch.float64)
    candidates = torch.tensor([[[0, 2], [1, 2]]])
    soft = soft_support(source, target, torch.zeros_like(target), hard, candidates, believed.log(), clusters.log())
    assert_close(soft.weights[0], torch.tensor([[0.2, 0.05], [0.1, 0.45]], dtype=torch.float64))
    assert_close(soft.partner[0], torch.stack([0.75 * target[0, 0] + 0.25 * target[0, 2], target[0, 2]]))


def small_cluster(n: int, kind: str = "spread") -> tuple[Tensor, Support, Motions]:
    """Ten background points that move exactly, and n points of mover 1 that move as they like."""
    source = torch.cat([make_points(10, 1), CLOUDS[kind](n)])[None]
    labels = torch.tensor([[0] * 10 + [1] * n])
    target = torch.cat([se2.apply(TRUE[0], source[0, :10]), se2.apply(TRUE[1], source[0, 10:])])[None]
    return source, given_support(source, target, labels, 2), started(TRUE[None, [0, 2]])


@pytest.mark.parametrize("metric", METRICS)
@pytest.mark.parametrize("n", [1, 2])
def test_one_or_two_points_take_the_backgrounds_rotation(n: int, metric: str) -> None:
    source, support, previous = small_cluster(n)
    found = refit(source, support, previous, metric)
    assert_close(found.value[0, 0], TRUE[0])
    assert_close(found.value[0, 1, 0], TRUE[0, 0])
    landed = se2.apply(found.value[0, 1], source[0, 10:]).mean(0)
    assert_close(landed, support.partner[0, 10:].mean(0))


@pytest.mark.parametrize("metric", METRICS)
@pytest.mark.parametrize(("extent", "is_full"), [(0.099, True), (0.101, False)])
def test_the_extent_decides_from_three_points_on(extent: float, is_full: bool, metric: str) -> None:
    source, _, previous = small_cluster(3)
    source[0, 10:] = torch.tensor([[2.0, 1.0], [2.0, 1.0], [2.0, 1.0 + 0.3 / 2**0.5]], dtype=torch.float64)  # spread 0.1
    target = torch.cat([se2.apply(TRUE[0], source[0, :10]), se2.apply(TRUE[1], source[0, 10:])])[None]
    support = given_support(source, target, torch.tensor([[0] * 10 + [1] * 3]), 2)
    assert_close(support.spread[0, 1], 0.1)
    found = refit(source, support, previous, metric, min_extent=extent)
    if not is_full:
        assert_close(found.value[0, 1, 0], TRUE[0, 0])
    elif metric == "point":
        assert_close(found.value[0, 1], TRUE[1])
    else:
        assert abs(float(found.value[0, 1, 0] - TRUE[0, 0])) > 1e-3


@pytest.mark.parametrize("metric", METRICS)
def test_an_empty_cluster_keeps_its_motion_and_is_then_removed(metric: str) -> None:
    source, support, previous = small_cluster(0)
    for rounds in range(1, PATIENCE + 3):
        previous = refit(source, support, previous, metric)
        assert_close(previous.value[0, 1], TRUE[2])
        assert previous.active.tolist() == [[True, rounds < PATIENCE]]
    back = refit(*small_cluster(5)[:2], previous, metric)
    assert back.active.tolist() == [[True, False]]
    assert_close(back.value[0, 1], TRUE[2])


@pytest.mark.parametrize("metric", METRICS)
def test_a_point_in_time_saves_a_cluster(metric: str) -> None:
    source, support, previous = small_cluster(0)
    previous = refit(source, support, previous, metric)
    previous = refit(*small_cluster(1)[:2], previous, metric)
    previous = refit(source, support, previous, metric)
    assert previous.active.all()
    assert previous.empty_for.tolist() == [[0, 1]]


@pytest.mark.parametrize("metric", METRICS)
def test_the_background_is_never_removed(metric: str) -> None:
    source, target = make_points(5, 1)[None], make_points(5, 2)[None]
    support = given_support(source, target, torch.full((1, 5), -1), 2)
    found = refit(source, support, started(TRUE[None, :2]), metric, times=PATIENCE + 2)
    assert_close(found.value[0], TRUE[:2])
    assert found.active.tolist() == [[True, False]]


@pytest.mark.parametrize("metric", METRICS)
@pytest.mark.parametrize("kind", list(CLOUDS))
@pytest.mark.parametrize("n", [0, 1, 2, 3, 6])
def test_gradients_are_finite_whatever_the_points(n: int, kind: str, metric: str) -> None:
    points = torch.cat([make_points(4, 1), CLOUDS[kind](n)])[None].requires_grad_()
    labels = torch.tensor([[0] * 4 + [1] * n])
    partner = torch.cat([se2.apply(TRUE[0], points[0, :4]), CLOUDS[kind](n)]).detach()[None].requires_grad_()
    support = given_support(points, partner, labels, 3)  # the third cluster is empty
    weights = support.weights.clone().requires_grad_()
    support = Support(weights, support.partner, support.tangent, support.count, support.spread)
    found = estimate(points, support, started(TRUE[None]), metric=metric, scale=SCALE, min_extent=0.0)
    assert found.value.isfinite().all()
    for gradient in torch.autograd.grad(found.value.sum(), (points, partner, weights)):
        assert gradient.isfinite().all()


def loose(metric: str) -> Callable[[Tensor, Tensor, Tensor], Tensor]:
    """`estimate` of two clusters as a function of points, partners and weights."""
    shape = given_support(make_points(8, 1)[None], make_points(8, 2)[None], (torch.arange(8) % 2)[None], 2)

    def function(points: Tensor, partner: Tensor, weights: Tensor) -> Tensor:
        support = Support(weights, partner, shape.tangent, shape.count, shape.spread)
        return estimate(points, support, started(TRUE[None, :2]), metric=metric, scale=SCALE, min_extent=0.1).value

    return function


def noisy_case() -> tuple[Tensor, Tensor, Tensor]:
    points = make_points(8, 1)[None]
    partner = se2.apply(TRUE[torch.arange(8) % 2], points[0, :, None])[None, :, 0] + 0.05 * normal(1, 8, 2)
    return points, partner, 0.2 + torch.rand(1, 2, 8, generator=generator(4), dtype=torch.float64)


@pytest.mark.parametrize("metric", METRICS)
@pytest.mark.parametrize("wanted", ["points", "partner", "weights"])
def test_gradcheck(wanted: str, metric: str) -> None:
    inputs = noisy_case()
    place = ("points", "partner", "weights").index(wanted)
    inputs[place].requires_grad_()
    assert torch.autograd.gradcheck(loose(metric), inputs)


def test_spread_of_one_point_is_zero() -> None:
    spread = largest_spread(1e3 * make_points(3)[None], torch.eye(3, dtype=torch.float64)[None])
    assert_close(spread, torch.zeros(1, 3).double(), tolerance=1e-4)


def test_running_sums_survive_a_thousand_flips() -> None:
    B, N, M, C = 2, 25, 20, 4
    source, target = torch.stack([make_points(N, 1), make_points(N, 2)]), torch.stack([make_points(M, 3), make_points(M, 4)])
    draw = generator(5)
    association, cluster = torch.randint(-1, M, (B, N), generator=draw), torch.randint(-1, C, (B, N), generator=draw)
    rows = torch.arange(B)

    def partner(of: Tensor) -> Tensor:
        return target.gather(1, of.clamp(min=0)[..., None].expand(-1, -1, 2))

    def votes() -> Tensor:
        speaks = (association >= 0) & (cluster >= 0)
        return ((cluster[:, None] == torch.arange(C)[:, None]) & speaks[:, None]).double()

    sums = RunningSums.of(source, partner(association), votes())
    for _ in range(1000):
        i = int(torch.randint(N, (), generator=draw))
        before = partner(association)[:, i], votes()[..., i]
        association[rows, i] = torch.randint(-1, M, (B,), generator=draw)
        cluster[rows, i] = torch.randint(-1, C, (B,), generator=draw)
        sums.change(source[:, i], *before, partner(association)[:, i], votes()[..., i])
    weights = votes()
    assert_close(sums.value, RunningSums.of(source, partner(association), weights).value)
    assert (weights.sum(-1) >= 3).all()
    each = partner(association)[:, None].expand(-1, C, -1, -1)
    expected = kabsch(source[:, None].expand_as(each), each, weights)
    assert_close(sums.motions(started(torch.zeros(B, C, 3).double()), 0.1), expected)


@pytest.mark.parametrize("n", [0, 1, 2, 3, 6])
@pytest.mark.parametrize("kind", list(CLOUDS))
def test_running_sums_keep_the_rules_for_small_clusters(kind: str, n: int) -> None:
    source, support, previous = small_cluster(n, kind)
    sums = RunningSums.of(source, support.partner, support.weights)
    expected = refit(source, support, previous, "point").value
    assert_close(sums.motions(previous, 0.1), expected)


def test_running_sums_recover_known_motions() -> None:
    source, target, labels = three_clusters()
    support = given_support(source, target, labels, 3)
    found = RunningSums.of(source, target, support.weights).motions(started(torch.zeros(1, 3, 3).double()), 0.1)
    assert_close(found[0], TRUE)


# --- trimmed fits -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(5))
def test_trimming_recovers_a_motion_with_gross_outliers(seed: int) -> None:
    n, wrong = 60, 9  # 15 %
    source = make_points(n, seed)[None]
    partner = se2.apply(TRUE[:1], source) + 1e-4 * normal(1, n, 2, seed=seed + 50)
    partner[0, :: n // wrong][:wrong] += torch.tensor([4.0, -3.0]).double() + 0.5 * normal(wrong, 2, seed=seed)
    support = given_support(source, partner, torch.zeros(1, n, dtype=torch.int64), 1)
    kept = trim(source, support)
    assert_close(kabsch(source, partner, kept.weights[:, 0]), TRUE[:1], tolerance=5e-4)
    assert float(torch.linalg.vector_norm(kabsch(source, partner, support.weights[:, 0]) - TRUE[0])) > 0.2
    assert int((kept.weights > 0).sum()) == 48
    assert (kept.weights[0, 0, :: n // wrong][:wrong] == 0).all()


def test_trimming_is_by_cluster_and_keeps_the_counts() -> None:
    source, partner, labels = make_points(40, 1)[None], make_points(40, 2)[None], torch.arange(40)[None] % 4 - 1
    support = given_support(source, partner, labels, 4)  # the last cluster has no point
    kept = trim(source, support)
    assert kept.weights.sum(-1).tolist() == [[8.0, 8.0, 8.0, 0.0]]
    assert ((kept.weights == 0) | (kept.weights == support.weights)).all()
    for name in ("partner", "tangent", "count", "spread"):
        assert torch.equal(getattr(kept, name), getattr(support, name)), name
    alone = given_support(source, partner, labels.masked_fill(labels != 1, -1), 4)
    assert torch.equal(trim(source, alone).weights[:, 1], kept.weights[:, 1])


@pytest.mark.parametrize("points", range(4))
def test_trimming_very_few_points_leaves_some(points: int) -> None:
    source = make_points(5, 1)[None]
    labels = torch.where(torch.arange(5) < points, 0, -1)[None]
    kept = trim(source, given_support(source, make_points(5, 2)[None], labels, 1))
    assert kept.weights.isfinite().all()
    assert int((kept.weights > 0).sum()) >= min(points, 1)
    assert int((kept.weights > 0).sum()) == -(-4 * points // 5)
