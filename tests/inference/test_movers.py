import math
from dataclasses import fields, replace

import numpy as np
import pytest
import torch
from torch import Tensor
from torchcrf_scan.inference.hypotheses import Hypotheses, hypothesise
from torchcrf_scan.inference.hypothesis_features import hypothesis_features
from torchcrf_scan.inference.movers import Movers, select
from torchcrf_scan.inference.surface import Surface

from torchcrf_scan.data.simulate import simulate_pairs
from torchcrf_scan.data.worlds import SimulatorConfig
from torchcrf_scan.geometry import se2
from torchcrf_scan.learning.hypothesis_fit import (
    IGNORED,
    fit_hypothesis_score,
    fit_mixture,
    label_hypotheses,
    simulate_mixture,
    view_pair,
)
from torchcrf_scan.scan import ScanPair
from torchcrf_scan.search.score import FEATURES, PRODUCTS, HypothesisScore

NOISE = torch.tensor(0.01)
DT = 0.2
PER_POINT = ("points", "ranges", "bearings", "spacing", "tangent", "length", "segment")
WALLS = [(-2.0, -8.0, 25.0, -8.0), (25.0, -8.0, 25.0, 8.0), (25.0, 8.0, -2.0, 8.0), (6.0, -8.0, 6.0, -6.0), (14.0, 8.0, 14.0, 6.5)]
EGO = torch.tensor([0.03, -0.6, 0.05])  # T_target_source of what stands still
STEPS = {"ahead": torch.tensor([0.0, 1.1, 0.1]), "across": torch.tensor([0.02, -0.2, -0.8])}  # movers, in the source frame


def box(x: float, y: float, long: float, wide: float) -> list[tuple[float, float, float, float]]:
    a, b, c, d = x - long / 2, y - wide / 2, x + long / 2, y + wide / 2
    return [(a, b, c, b), (c, b, c, d), (c, d, a, d), (a, d, a, b)]


BOXES = {"ahead": box(9.0, 3.0, 4.0, 1.8), "across": box(11.0, -3.0, 1.8, 1.8)}


def carried(segments: list[tuple[float, float, float, float]], motion: Tensor) -> list[tuple[float, ...]]:
    ends = se2.apply(motion, torch.tensor(segments).view(-1, 2)).view(-1, 4)
    return [tuple(row) for row in ends.tolist()]


def cast(segments: list[tuple[float, ...]], seed: int) -> Tensor:
    """(P, 2) nearest hits of 361 beams over 180 degrees, a little noisy."""
    table = np.array(segments)
    a, edge = table[:, :2], table[:, 2:] - table[:, :2]
    bearing = np.linspace(-math.pi / 2, math.pi / 2, 361)[:, None]
    dx, dy = np.cos(bearing), np.sin(bearing)
    det = dx * edge[:, 1] - dy * edge[:, 0] + 1e-12
    r = (a[:, 0] * edge[:, 1] - a[:, 1] * edge[:, 0]) / det
    along = (a[:, 0] * dy - a[:, 1] * dx) / det
    r = np.where((r > 0) & (along >= 0) & (along <= 1), r, np.inf).min(1)
    r = r + np.random.default_rng(seed).normal(0, 0.01, len(r))
    hit = np.isfinite(r)
    return torch.from_numpy(np.c_[r * dx[:, 0], r * dy[:, 0]][hit]).float()


def movers_of(source: Surface, target: Surface, background: Tensor, dt: float, score: HypothesisScore) -> Movers:
    hypotheses = hypothesise(source, target, background, dt)
    probabilities = score(hypothesis_features(hypotheses, source, target, background))
    return select(hypotheses, probabilities, source, target, threshold=float(score.threshold), most=6)


def scene(moving: tuple[str, ...] = ("ahead", "across"), steps: dict[str, Tensor] = STEPS) -> tuple[Surface, Surface]:
    source, target = list(WALLS), carried(WALLS, EGO)
    for name, segments in BOXES.items():
        step = steps[name] if name in moving else torch.zeros(3)
        source += segments
        target += carried(segments, se2.compose(EGO, step))
    return Surface.of(cast(source, 1), NOISE, False), Surface.of(cast(target, 2), NOISE, False)


def surfaces(pair: ScanPair) -> tuple[Surface, Surface]:
    noise = torch.tensor(pair.source.range_noise)
    scans = (pair.source, pair.target)
    source, target = (Surface.of(torch.from_numpy(scan.points).float(), noise, scan.is_closed) for scan in scans)
    return source, target


def empty(surface: Surface) -> Surface:
    none = {f.name: getattr(surface, f.name)[:0] for f in fields(Surface) if f.name in PER_POINT}
    return replace(surface, **none)


def in_box(points: Tensor, name: str) -> Tensor:
    ends = torch.tensor(BOXES[name]).view(-1, 2)
    return ((points > ends.amin(0) - 0.1) & (points < ends.amax(0) + 0.1)).all(-1)


def assert_found(motions: Tensor, source: Surface, expected: dict[str, Tensor], tolerance: float) -> None:
    for name, motion in expected.items():
        points = source.points[in_box(source.points, name)]
        error = torch.linalg.vector_norm(se2.apply(motions, points) - se2.apply(motion, points), dim=-1).mean(-1)
        assert error.min() < tolerance, name


def test_the_pool_holds_both_movers() -> None:
    source, target = scene()
    pool = hypothesise(source, target, EGO, DT)
    assert_found(pool.motions, source, {name: se2.compose(EGO, step) for name, step in STEPS.items()}, 0.08)
    assert (pool.members.sum(-1) >= 3).all()


def test_two_objects_are_found_and_nothing_else() -> None:
    source, target = scene()
    movers = movers_of(source, target, EGO, DT, HypothesisScore())
    assert len(movers.motions) == 2
    assert_found(movers.motions, source, {name: se2.compose(EGO, step) for name, step in STEPS.items()}, 0.1)
    assert (movers.probabilities.diff() <= 0).all()


def test_two_objects_of_one_motion_far_apart_are_two() -> None:
    alike = dict.fromkeys(BOXES, torch.tensor([0.0, 1.1, 0.1]))
    source, target = scene(steps=alike)
    movers = movers_of(source, target, EGO, DT, HypothesisScore())
    assert_found(movers.motions, source, {name: se2.compose(EGO, step) for name, step in alike.items()}, 0.1)
    for name in BOXES:
        assert (movers.members & in_box(source.points, name)).any(-1).sum() == 1, name


def test_one_motion_of_two_parts_of_an_object_is_accepted_once() -> None:
    source, target = scene()
    motion = se2.compose(EGO, STEPS["ahead"])
    car = in_box(source.points, "ahead").nonzero()[:, 0]
    members = torch.zeros(2, len(source), dtype=torch.bool)
    members[0, car[::2]] = members[1, car[1::2]] = True
    movers = select(Hypotheses(motion.expand(2, 3), members), torch.tensor([0.8, 0.9]), source, target, threshold=0.5, most=6)
    assert torch.equal(movers.members, members[1:])


def test_what_stands_still_is_no_mover() -> None:
    movers = movers_of(*scene(moving=()), EGO, DT, HypothesisScore())
    assert len(movers.motions) == 0


def test_most_scenes_without_movers_give_none() -> None:
    pairs = simulate_pairs(SimulatorConfig(movers_min=0, movers_max=0, beams=181), 8, 8, 5)
    found = [
        len(movers_of(*surfaces(p), torch.tensor(p.annotation.motions[0]).float(), p.dt, HypothesisScore()).motions) for p in pairs
    ]
    assert sum(count == 0 for count in found) >= 6


def test_simulated_movers_are_found() -> None:
    pairs = simulate_pairs(SimulatorConfig(movers_min=2, movers_max=3), 8, 8, 11)
    right = accepted = 0
    for pair in pairs:
        source, target = surfaces(pair)
        motions = torch.from_numpy(pair.annotation.motions).float()
        movers = movers_of(source, target, motions[0], pair.dt, HypothesisScore())
        body = torch.from_numpy(pair.annotation.body)
        label = label_hypotheses(Hypotheses(movers.motions, movers.members), source, body, motions, torch.tensor(0.1))
        right, accepted = right + int((label == 1).sum()), accepted + len(label)
    assert accepted >= 8
    assert right / accepted > 0.6


def test_turning_the_target_frame_turns_the_motions() -> None:
    """Within the view of a target sensor that looks elsewhere from the same place."""
    source, target = scene()
    turn = torch.tensor([0.4, 0.0, 0.0])
    turned = Surface.of(se2.apply(turn, target.points), NOISE, False)
    here = movers_of(source, target, EGO, DT, HypothesisScore())
    there = movers_of(source, turned, se2.compose(turn, EGO), DT, HypothesisScore())
    assert len(here.motions) == len(there.motions)
    torch.testing.assert_close(there.motions, se2.compose(turn.expand_as(here.motions), here.motions), atol=5e-3, rtol=0)


def test_scaling_the_world_scales_the_features() -> None:
    """All features are in local units: a world ten times smaller, seen by a sensor ten times as exact, looks the same."""
    source, target = scene()
    small_source, small_target = (Surface.of(s.points / 10, NOISE / 10, False) for s in (source, target))
    shrink = torch.tensor([1.0, 0.1, 0.1])
    pool = hypothesise(source, target, EGO, DT)
    here = hypothesis_features(pool, source, target, EGO)
    there = hypothesis_features(Hypotheses(pool.motions * shrink, pool.members), small_source, small_target, EGO * shrink)
    assert here.shape == (len(pool), len(FEATURES))
    torch.testing.assert_close(there, here, atol=0.1, rtol=0)
    torch.testing.assert_close(there.median(0).values, here.median(0).values, atol=0.02, rtol=0)


def test_the_order_of_the_hypotheses_does_not_matter() -> None:
    source, target = scene()
    pool = hypothesise(source, target, EGO, DT)
    features = hypothesis_features(pool, source, target, EGO)
    order = torch.randperm(len(pool))
    shuffled = Hypotheses(pool.motions[order], pool.members[order])
    mixed = hypothesis_features(shuffled, source, target, EGO)
    torch.testing.assert_close(mixed, features[order], atol=1e-4, rtol=1e-4)
    one, other = (
        select(p, HypothesisScore()(f), source, target, threshold=0.3, most=6) for p, f in ((pool, features), (shuffled, mixed))
    )
    torch.testing.assert_close(other.motions, one.motions, atol=1e-3, rtol=0)


def test_at_most_so_many_are_accepted() -> None:
    source, target = scene()
    pool = hypothesise(source, target, EGO, DT)
    certain = torch.ones(len(pool))
    for most in (0, 1, 3):
        assert len(select(pool, certain, source, target, threshold=0.5, most=most).motions) <= most
    assert len(select(pool, 0 * certain, source, target, threshold=0.5, most=6).motions) == 0


@pytest.mark.parametrize("count", [0, 1, 2])
@pytest.mark.parametrize("is_source", [True, False])
def test_hardly_any_points_give_no_movers(count: int, is_source: bool) -> None:
    source, target = scene()
    few = Surface.of((source if is_source else target).points[: max(count, 1)], NOISE, False)
    few = few if count else empty(few)
    pair = (few, target) if is_source else (source, few)
    movers = movers_of(*pair, EGO, DT, HypothesisScore())
    assert movers.motions.shape == (0, 3)
    assert movers.probabilities.shape == (0,)
    assert movers.members.shape == (0, len(pair[0]))


def test_a_perfect_background_leaves_no_hypotheses() -> None:
    source, _ = scene()
    still = torch.zeros(3)
    pool = hypothesise(source, source, still, DT)
    assert len(pool) == 0
    assert hypothesis_features(pool, source, source, still).shape == (0, len(FEATURES))
    assert len(movers_of(source, source, still, DT, HypothesisScore()).motions) == 0


def test_labels_of_hypotheses() -> None:
    source, _ = scene()
    body = torch.zeros(len(source), dtype=torch.int64)
    car = in_box(source.points, "ahead")
    body[car] = 1
    motions = torch.stack([EGO, se2.compose(EGO, STEPS["ahead"])])
    members = torch.stack([car, car, ~car, ~car])
    pool = Hypotheses(motions[[1, 0, 1, 0]], members)
    assert label_hypotheses(pool, source, body, motions, torch.tensor(0.1)).tolist() == [1, 0, 0, 0]
    lost = motions.clone()
    lost[1] = torch.nan
    assert label_hypotheses(pool, source, body, lost, torch.tensor(0.1)).tolist() == [-1, -1, 0, 0]
    body[car] = IGNORED
    assert label_hypotheses(pool, source, body, motions, torch.tensor(0.1)).tolist() == [-1, -1, 0, 0]


def test_far_points_tell_less_of_a_motion() -> None:
    """The same error is right on coarse surface and wrong on fine."""
    source, _ = scene()
    car = in_box(source.points, "ahead")
    body = car.long()
    motions = torch.stack([EGO, se2.compose(EGO, STEPS["ahead"])])
    off = motions[1:] + torch.tensor([0.0, 0.25, 0.0])
    coarse = replace(source, spacing=source.spacing + 0.6)
    labels = [label_hypotheses(Hypotheses(off, car[None]), s, body, motions, torch.tensor(0.1)).item() for s in (source, coarse)]
    assert labels == [0, 1]


def test_the_mixture_gives_a_score() -> None:
    score = fit_mixture(5, seed=3)
    assert all(value.isfinite().all() for value in score.buffers())
    assert not torch.equal(score.weight, HypothesisScore().weight)


def test_products_are_terms_of_the_score() -> None:
    score = HypothesisScore()
    features = torch.randn(5, len(FEATURES))
    terms = score.terms(features)
    assert terms.shape == (5, 2 * len(FEATURES) + len(PRODUCTS)) == (5, len(score.weight))
    one, other = (FEATURES.index(name) for name in next(iter(PRODUCTS)))
    torch.testing.assert_close(terms[:, 2 * len(FEATURES)], terms[:, one] * terms[:, other])


def test_the_fit_keeps_the_default_without_movers() -> None:
    still = simulate_pairs(SimulatorConfig(beams=91, movers_min=0, movers_max=0), 1, 1, 0)[0]
    seen = view_pair(still, seed=0, views=1)
    assert len(seen[0].features) > 0
    for views in ([], seen):
        score = fit_hypothesis_score(views)
        assert all(torch.equal(a, b) for a, b in zip(score.buffers(), HypothesisScore().buffers(), strict=True))


def test_a_small_fit_ranks_unseen_hypotheses_and_repeats_itself() -> None:
    room = SimulatorConfig(scene="indoor", beams=120, range_max=10.0, movers_min=2)
    pairs = simulate_pairs(room, 3, 3, 3)
    views = [view_pair(pair, 4 + k) for k, pair in enumerate(pairs)]
    again = [view_pair(pairs[0], 4), *views[1:]]
    one, other = (fit_hypothesis_score([view for of_pair in seen for view in of_pair]) for seen in (views, again))
    torch.testing.assert_close(one.weight, other.weight, rtol=0, atol=0)
    assert one.threshold == other.threshold
    source, target = scene()
    pool = hypothesise(source, target, EGO, DT)
    body = in_box(source.points, "ahead") + 2 * in_box(source.points, "across")
    motions = torch.stack([EGO, *(se2.compose(EGO, step) for step in STEPS.values())])
    label = label_hypotheses(pool, source, body, motions, torch.tensor(0.1))
    probabilities = one(hypothesis_features(pool, source, target, EGO))
    assert probabilities[label == 1].median() > probabilities[label == 0].quantile(0.9)


def test_the_mixture_has_every_kind_of_scene() -> None:
    pairs = simulate_mixture(5, seed=3)
    assert len(pairs) >= 5
    assert all(pair.annotation is not None for pair in pairs)
    assert {pair.source.is_closed for pair in pairs} == {False, True}


def test_the_score_is_saved_with_its_module() -> None:
    fitted = HypothesisScore()
    fitted.weight.mul_(2)
    loaded = HypothesisScore()
    loaded.load_state_dict(fitted.state_dict())
    features = torch.randn(3, len(FEATURES))
    torch.testing.assert_close(loaded(features), fitted(features))
    assert ((loaded(features) >= 0) & (loaded(features) <= 1)).all()
