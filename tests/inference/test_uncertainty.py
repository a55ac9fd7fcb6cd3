"""Covariances against draws, what scenes leave open, finite numbers for anything, and confidences by hand."""

import math
from dataclasses import fields, replace

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from support import assert_close, normal
from torch import Tensor

from torchcrf_scan.geometry import se2
from torchcrf_scan.geometry.kabsch import kabsch
from torchcrf_scan.inference import uncertainty
from torchcrf_scan.inference.directions import surface_tangents
from torchcrf_scan.inference.motion import Support, hard_support, line_fit
from torchcrf_scan.inference.uncertainty import (
    RIDGE,
    Calibration,
    association_log_odds,
    cluster_log_odds,
    left_out,
    log_odds,
    motion_covariance,
)
from torchcrf_scan.prediction import Prediction, Uncertainty

NOISE = 0.01
SCALE = torch.tensor(0.2, dtype=torch.float64)
MOTION = torch.tensor([0.1, -0.4, 0.3], dtype=torch.float64)
METRICS = ("point", "line")


def line(start: tuple[float, float], end: tuple[float, float], n: int) -> Tensor:
    """(n, 2) points from one end to the other."""
    share = torch.linspace(0, 1, n, dtype=torch.float64)[:, None]
    return torch.tensor(start).double() * (1 - share) + torch.tensor(end).double() * share


def corridor() -> Tensor:
    return torch.cat([line((-12, -1.5), (12, -1.5), 200), line((12, 1.5), (-12, 1.5), 200)])


def room() -> Tensor:
    corners = [(3.0, -2.0), (3.0, 2.0), (-4.0, 2.0), (-4.0, -2.0)]
    return torch.cat([line(a, b, 60) for a, b in zip(corners, corners[1:] + corners[:1], strict=True)])


def ring() -> Tensor:
    angle = torch.arange(120, dtype=torch.float64) * 2 * math.pi / 120
    return 3 * torch.stack([angle.cos(), angle.sin()], -1)


def support_of(source: Tensor, partner: Tensor, tangent: Tensor, labels: Tensor | None = None, clusters: int = 1) -> Support:
    """Point i of (B, N, 2) went to row i of `partner`, all of them in cluster 0 unless `labels` say otherwise."""
    everyone = torch.arange(source.shape[1]).expand(source.shape[:2])
    labels = torch.zeros_like(everyone) if labels is None else labels
    return hard_support(source, partner, tangent, everyone, labels, clusters)


def covariance(source: Tensor, support: Support, motions: Tensor, metric: str = "line", noise: float = NOISE) -> Uncertainty:
    noises = source.new_full((len(source),), noise)
    return motion_covariance(source, support, motions, metric=metric, scale=SCALE.to(source), noise=noises)


def see(points: Tensor, seed: int = 0, *, noise: float = NOISE, has_surface: bool = True) -> Uncertainty:
    """What is known of MOTION from noisy points (N, 2) that moved so."""
    moved = se2.apply(MOTION, points)
    partner = moved + noise * normal(*points.shape, seed=seed)
    across = moved.diff(dim=0, append=moved[-1:] if len(points) < 2 else 2 * moved[-1:] - moved[-2:-1])
    tangent = torch.nn.functional.normalize(across, dim=-1) * has_surface
    return covariance(points[None], support_of(points[None], partner[None], tangent[None]), MOTION[None, None])


# What scenes leave open.


def test_a_corridor_leaves_its_own_direction_open() -> None:
    found = see(corridor())
    assert found.degenerate.tolist() == [[[True, False, False]]]
    along = se2.rotate(MOTION[:1], torch.tensor([[1.0, 0.0]]).double())
    assert_close((found.unobserved_shift[0] * along).sum(-1).abs(), [1.0], tolerance=1e-2)
    assert not found.is_turn_unobserved.any()
    shift = found.covariance[0, 0, 1:, 1:]
    reach = corridor().norm(dim=-1).max()
    assert_close((along @ shift @ along.T).sqrt(), reach.view(1, 1), tolerance=0.05)
    across = along.flip(-1) * torch.tensor([-1.0, 1.0])
    assert (across @ shift @ across.T).sqrt() < 0.05  # the direction itself is only known so well
    assert found.covariance[0, 0, 0, 0].sqrt() < 1e-3


def test_a_room_leaves_nothing_open() -> None:
    found = see(room())
    assert not found.degenerate.any()
    assert not found.unobserved_shift.any()
    assert (found.covariance.diagonal(dim1=-2, dim2=-1).sqrt() < 0.005).all()


def test_a_car_seen_along_one_side_may_have_slid() -> None:
    found = see(line((6, -2), (6, 2), 30))
    assert found.degenerate.tolist() == [[[True, False, False]]]
    side = se2.rotate(MOTION[:1], torch.tensor([[0.0, 1.0]]).double())
    assert_close((found.unobserved_shift[0] * side).sum(-1).abs(), [1.0], tolerance=1e-2)


def test_a_ring_may_have_turned() -> None:
    found = see(ring())
    assert found.degenerate.tolist() == [[[True, False, False]]]
    assert found.is_turn_unobserved.all()
    assert not found.unobserved_shift.any()
    assert_close(found.covariance[0, 0, 0, 0].sqrt(), math.pi / math.sqrt(3), tolerance=1e-2)


@pytest.mark.parametrize(
    ("points", "has_surface", "expected"),
    [
        ([[4.0, 1.0]], False, [True, False, False]),  # a pole
        ([[4.0, 1.0], [4.0, 1.5]], True, [True, False, False]),  # a bit of wall
        ([[4.0, 1.0], [4.0, 1.5]], False, [False, False, False]),  # two poles
        ([[4.0, 1.0]] * 3, False, [True, False, False]),
    ],
)
def test_very_few_points(points: list[list[float]], has_surface: bool, expected: list[bool]) -> None:
    found = see(torch.tensor(points, dtype=torch.float64).view(-1, 2), has_surface=has_surface)
    assert found.degenerate[0, 0].tolist() == expected
    assert found.covariance.isfinite().all()


def test_a_cluster_without_points_has_the_prior() -> None:
    source = room()[None]
    support = support_of(source, se2.apply(MOTION, source), torch.zeros_like(source), clusters=2)
    found = covariance(source, support, torch.stack([MOTION, torch.zeros(3).double()])[None])
    reach = source.norm(dim=-1).max()
    assert_close(found.covariance[0, 1], torch.stack([torch.tensor(math.pi**2 / 3), reach**2, reach**2]).diag(), tolerance=1e-7)
    assert found.degenerate[0].sum(-1).tolist() == [0, 3]


@pytest.mark.parametrize("n", [300, 1000])
def test_noise_of_tangents_does_not_hold_a_corridor(n: int) -> None:
    """Neighbours a noise or less apart make tangents of any direction; taken at their word they would hold the motion along it."""
    points = torch.cat([line((0, -1), (3, -1), n), line((3, 1), (0, 1), n)])
    noisy = points + NOISE * normal(2 * n, 2, seed=3)
    tangent = torch.nn.functional.normalize(noisy.roll(-1, 0) - noisy.roll(1, 0), dim=-1)
    assert (tangent[:, 1] ** 2).mean() > 0.2
    source = points[None] + NOISE * normal(1, 2 * n, 2, seed=4)
    found = covariance(source, support_of(source, noisy[None], tangent[None]), torch.zeros(1, 1, 3).double())
    assert found.degenerate.tolist() == [[[True, False, False]]]


def test_few_points_in_one_place_hold_a_direction_less_than_as_many_in_several() -> None:
    """A fit follows the errors of those points, whose residuals tell nothing then; it stays without one of several such places."""
    lengths = []
    for places in ((0,), (-6, -2, 2, 6)):
        wall, n = [], 24 // len(places)
        for x in (*places, 12):
            wall += [line((x - 3, 1.5), (x, 1.5), 200 // (len(places) + 1)), line((x, 1.5), (x, 1.2), n)] if x < 12 else []
        source = torch.cat([line((-12, -1.5), (12, -1.5), 200), *wall[::-1]])[None]
        support = support_of(source, source, torch.zeros_like(source))
        tangent = torch.where(
            (source[..., :1].diff(dim=1, append=source[:, -1:, :1]).abs() < 1e-9), torch.eye(2)[1], torch.eye(2)[0]
        )
        support = replace(support, tangent=tangent.double())
        found = covariance(source, support, torch.zeros(1, 1, 3).double())
        lengths.append(found.covariance[0, 0, 1, 1].sqrt())
    assert lengths[0] > 3 * lengths[1]


# The covariance against draws.


def draws(points: Tensor, metric: str, times: int = 600) -> tuple[Tensor, Tensor]:
    """Covariance of the motions fitted to `times` noisy targets, and the mean of what each of the fits says of itself."""
    source = points.expand(times, -1, -1)
    moved = se2.apply(MOTION, points)
    partner = moved + math.sqrt(2) * NOISE * normal(times, *points.shape, seed=1)
    tangent = torch.nn.functional.normalize(moved.roll(-1, 0) - moved.roll(1, 0), dim=-1).expand_as(partner)
    support = support_of(source, partner, tangent)
    motions = kabsch(source, partner, support.weights[:, 0])[:, None]
    if metric == "line":
        for _ in range(5):
            motions = line_fit(source[:, None], partner[:, None], support, motions, torch.tensor(1.0).double())
    noises = source.new_full((times,), NOISE)
    said = motion_covariance(source, support, motions, metric=metric, scale=torch.tensor(1.0).double(), noise=noises)
    return motions[:, 0].T.cov(), said.covariance[:, 0].mean(0)


@pytest.mark.parametrize(
    ("metric", "n", "low", "high"),
    [("point", 10, 1.5, 4.5), ("point", 150, 1.5, 3.5), ("line", 150, 1.5, 5.5)],  # runs of two walls are few: more than needed
)
def test_covariance_against_draws(metric: str, n: int, low: float, high: float, monkeypatch: pytest.MonkeyPatch) -> None:
    """In every direction the variance is that of the draws, far from the origin, where a turn moves t most.

    Without the error that all points share: partners drawn at their true places leave more residual than nearest ones.
    """
    monkeypatch.setattr(uncertainty, "SHARED", 0.0)
    points = torch.cat([line((9, -2), (9, 6), n), line((8.9, 6), (3, 5), n)])
    drawn, said = draws(points, metric)
    ratio = torch.linalg.eigvals(torch.linalg.solve(drawn, said)).real
    assert low < ratio.min()
    assert ratio.max() < high


def test_errors_that_neighbours_share_are_larger() -> None:
    source = room()[None]
    jolts = 0.02 * normal(1, 6, 2, seed=2).repeat_interleave(40, 1)
    alone = 0.02 * normal(1, 240, 2, seed=2)
    spread = []
    for errors in (jolts, alone):
        partner = source + errors
        motions = kabsch(source, partner, torch.ones(1, 240).double())[:, None]
        found = covariance(source, support_of(source, partner, torch.zeros_like(source)), motions, "point")
        spread.append(found.covariance[0, 0, 1:, 1:].trace())
    assert spread[0] > 3 * spread[1]


def test_a_step_not_made_counts() -> None:
    source = room()[None]
    support = support_of(source, source, torch.zeros_like(source))
    off = torch.tensor([[[0.0, 0.05, 0.0]]]).double()
    assert_close(covariance(source, support, off, "point").covariance[0, 0, 1, 1].sqrt(), 0.05, tolerance=0.05)


def test_left_out_by_hand() -> None:
    """Every run of two neighbours, also the ones that reach beyond the ends, with the fit to all others."""
    score, weights = normal(2, 3, 7, 3).double(), torch.rand(2, 3, 7).double()
    rows = normal(2, 3, 7, 2, 3, seed=1).double()
    each = weights[..., None, None] * rows.mT @ rows
    whole = each.sum(2) + RIDGE * weights.sum(-1)[..., None, None] * torch.eye(3).double()
    together = apart = torch.zeros(2, 3, 3, 3).double()
    for i in range(8):
        run = slice(max(0, i - 1), i + 1)
        change = whole @ torch.linalg.inv(whole - each[:, :, run].sum(2))
        moved = change @ score[:, :, run].sum(2)[..., None]
        together = together + moved @ moved.mT / 2
        apart = apart + change @ (weights[..., None, None] * each)[:, :, run].sum(2) @ change.mT / 2
    found = left_out(score, each, weights, torch.full((2, 3), 2))
    assert_close(found[0], together)
    assert_close(found[1], apart)


def test_surface_tangents() -> None:
    wall = torch.cat([line((2, 0), (2, 1), 9), torch.tensor([[9.0, 9.0]]).double()])[None]
    mask = torch.arange(10)[None] < 9
    tangent, is_found = surface_tangents(wall, mask, torch.tensor([0.01]).double())
    assert is_found.tolist() == mask.tolist()
    assert_close(tangent[0, :9, 1].abs(), torch.ones(9))


# Properties.


def test_other_units_scale_it() -> None:
    points, factor = room()[None], torch.tensor([3.0]).double()
    partner = se2.apply(MOTION, points) + NOISE * normal(1, 240, 2)
    tangent = torch.nn.functional.normalize(normal(1, 240, 2, seed=5), dim=-1)
    support = support_of(points, partner, tangent)
    found = covariance(points, support, MOTION[None, None])
    large = support_of(3 * points, 3 * partner, tangent)
    motion = MOTION * torch.tensor([1.0, 3.0, 3.0])
    there = motion_covariance(
        3 * points, large, motion[None, None], metric="line", scale=3 * SCALE, noise=3 * points.new_full((1,), NOISE)
    )
    assert_close(found.scaled(factor).covariance, there.covariance, tolerance=1e-6)
    assert_close(found.information, there.information)
    assert_close(found.inflated(torch.tensor(2.0)).covariance, 2 * found.covariance)


@pytest.mark.parametrize("metric", METRICS)
def test_batch_is_a_loop_and_padding_invisible(metric: str) -> None:
    scenes = [room()[:200], corridor()[:150], ring()]
    alone = []
    longest = 210
    source, partner, tangent = (torch.zeros(3, longest, 2).double() for _ in range(3))
    labels = torch.full((3, longest), -1)
    for b, points in enumerate(scenes):
        n = len(points)
        source[b, :n], labels[b, :n] = points, torch.arange(n) % 2
        partner[b, :n] = se2.apply(MOTION, points) + NOISE * normal(n, 2, seed=b)
        tangent[b, :n] = torch.nn.functional.normalize(normal(n, 2, seed=b), dim=-1)
        part = (source[b : b + 1, :n], partner[b : b + 1, :n], tangent[b : b + 1, :n])
        alone.append(covariance(part[0], support_of(*part, labels[b : b + 1, :n], 2), MOTION.expand(1, 2, 3), metric))
    together = covariance(source, support_of(source, partner, tangent, labels, 2), MOTION.expand(3, 2, 3), metric)
    for b, found in enumerate(alone):
        assert_close(together.covariance[b], found.covariance[0], tolerance=1e-7)
        assert_close(together.information[b], found.information[0], tolerance=1e-7)


@given(
    n=st.integers(1, 4),
    empty=st.booleans(),
    shape=st.sampled_from(["spread", "identical", "collinear"]),
    metric=st.sampled_from(METRICS),
    noise=st.sampled_from([0.0, NOISE]),
    dtype=st.sampled_from([torch.float32, torch.float64]),
    has_surface=st.booleans(),
)
def test_always_finite(n: int, empty: bool, shape: str, metric: str, noise: float, dtype: torch.dtype, has_surface: bool) -> None:
    here = torch.tensor([3.0, -2.0]).double()
    steps = torch.arange(n).double()[:, None]
    source = {"spread": here + normal(n, 2, seed=n), "identical": here.expand(n, 2), "collinear": here * (1 + steps)}[shape]
    source = source[None].to(dtype).clone().requires_grad_()
    partner = (source.detach() + 0.1).requires_grad_()
    tangent = torch.tensor([1.0, 0.0]).to(dtype).expand_as(source) * has_surface
    motions = torch.zeros(1, 2, 3, dtype=dtype, requires_grad=True)
    labels = torch.full((1, n), -1 if empty else 0)
    found = covariance(source, support_of(source, partner, tangent, labels, 2), motions, metric, noise)
    assert all(getattr(found, f.name).isfinite().all() for f in fields(found))
    assert (torch.linalg.eigvalsh(found.covariance.double()) > -1e-5 * found.covariance.abs().amax()).all()
    assert found.unobserved_shift.isfinite().all()
    found.covariance.sum().backward()
    for value in (source, partner, motions):
        assert value.grad is not None
        assert value.grad.isfinite().all()


@pytest.mark.parametrize("metric", METRICS)
def test_gradients(metric: str) -> None:
    source = room()[::16][None]
    tangent = torch.nn.functional.normalize(normal(*source.shape, seed=7), dim=-1)
    partner = se2.apply(MOTION, source) + 0.05 * normal(*source.shape, seed=8)

    def known(source: Tensor, partner: Tensor, motions: Tensor, weights: Tensor) -> Tensor:
        support = replace(support_of(source, partner, tangent), weights=weights, partner=partner)
        found = covariance(source, support, motions, metric)
        assert not found.degenerate.any()
        return found.covariance

    inputs = (source + 0.05 * normal(*source.shape, seed=9), partner, MOTION[None, None], 0.5 + normal(1, 1, 15, seed=3).abs())
    assert torch.autograd.gradcheck(known, [value.clone().requires_grad_() for value in inputs])


def test_single_precision() -> None:
    for points in (room(), corridor()):
        partner = se2.apply(MOTION, points) + NOISE * normal(*points.shape)
        tangent = torch.nn.functional.normalize(points.roll(-1, 0) - points, dim=-1)
        found = [
            covariance(
                points[None].to(dtype),
                support_of(*(v[None].to(dtype) for v in (points, partner, tangent))),
                MOTION[None, None].to(dtype),
            )
            for dtype in (torch.float64, torch.float32)
        ]
        assert found[1].covariance.dtype == torch.float32
        sizes = [one.covariance[0, 0].diagonal().double().sqrt() for one in found]
        assert_close(sizes[1] / sizes[0], torch.ones(3), tolerance=1e-2)


# Confidences.


def prediction(
    log_association: Tensor, log_cluster: Tensor, association: Tensor, cluster: Tensor, candidates: Tensor
) -> Prediction:
    B = len(association)
    return Prediction(
        association=association,
        cluster=cluster,
        motions=torch.zeros(B, 2, 3).double(),
        active=torch.ones(B, 2, dtype=torch.bool),
        candidates=candidates,
        log_association=log_association,
        log_cluster=log_cluster,
        converged=torch.ones(B, dtype=torch.bool),
        iterations=torch.ones(B, dtype=torch.int64),
    )


def small_prediction() -> Prediction:
    """Three points: on target 5, an outlier, padding of which nothing is known."""
    beliefs = torch.tensor([[[0.1, 0.5, 0.2, 0.2], [0.1, 0.1, 0.2, 0.6], [0.25] * 4]], dtype=torch.float64)
    clusters = torch.tensor([[[0.9, 0.1, 0.0], [0.0, 0.2, 0.8], [0.0, 0.0, 0.0]]], dtype=torch.float64)
    candidates = torch.tensor([[[2, 5, 7]] * 3])
    return prediction(beliefs.log(), clusters.log(), torch.tensor([[5, -1, -1]]), torch.tensor([[0, -1, -1]]), candidates)


def test_log_odds_by_hand() -> None:
    found = small_prediction()
    assert_close(association_log_odds(found)[0, :2], [math.log(0.7 / 0.3), math.log(0.6 / 0.4)])
    assert_close(cluster_log_odds(found)[0, :2], [math.log(9.0), math.log(4.0)])


def test_calibration_maps_the_log_odds() -> None:
    found, calibration = small_prediction(), Calibration()
    association, cluster = calibration(found)
    assert_close(association[0, :2], [0.7, 0.6])
    assert_close(cluster[0, :2], [0.9, 0.8])
    calibration.cluster.copy_(torch.tensor([0.5, -1.0]))
    assert_close(calibration(found)[1][0, 0], 1 / (1 + math.exp(1 - 0.5 * math.log(9))))
    assert set(calibration.state_dict()) == {"association", "cluster", "covariance_factor"}


@given(st.integers(0, 1000))
def test_log_odds_are_finite(seed: int) -> None:
    """Also of certain, impossible and absent beliefs, with their gradients."""
    raw = 40 * normal(2, 5, 6, seed=seed)
    raw = raw.masked_fill(normal(2, 5, 6, seed=seed + 1) > 1, -torch.inf)
    beliefs = raw.clone().requires_grad_()
    chosen = torch.nn.functional.one_hot(raw.argmax(-1), 6).bool()
    odds = log_odds(torch.log_softmax(beliefs.clamp(min=-1e3), -1), chosen)
    assert odds.isfinite().all()
    odds.sum().backward()
    assert beliefs.grad is not None
    assert beliefs.grad.isfinite().all()
    assert log_odds(torch.full((1, 3), -torch.inf), torch.tensor([[True, False, False]])).isfinite().all()


def test_confidence_gradients() -> None:
    found = small_prediction()

    def confidences(association: Tensor, cluster: Tensor) -> tuple[Tensor, ...]:
        logs = {"log_association": association.log_softmax(-1), "log_cluster": cluster.log_softmax(-1)}
        return Calibration().double()(replace(found, **logs))

    assert torch.autograd.gradcheck(confidences, [normal(1, 3, 4).requires_grad_(), normal(1, 3, 3).requires_grad_()])
