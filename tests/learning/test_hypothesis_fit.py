"""The fit of the movers' score: which hypotheses are right, and what is learned of simulated pairs."""

import numpy as np
import torch
from two_movers import DT, EGO, STEPS, in_box, scene, survey_of

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
from torchcrf_scan.loops.jit import Array, Booleans
from torchcrf_scan.search.accept import probabilities_of, score_of
from torchcrf_scan.search.hypotheses import members_of
from torchcrf_scan.search.score import HypothesisScore
from torchcrf_scan.search.survey import Survey, survey_at


def in_units_of(unit: float, motions: Array, members: Booleans, coarser: float = 0.0) -> Survey:
    """The scene with hypotheses, a registration error of `unit` metres, and of so much more at every point."""
    known = survey_of(*scene(), EGO, motions, members)
    source = known.leftover.source
    source = source._replace(units=source.units + coarser)
    return known._replace(leftover=known.leftover._replace(unit=unit, source=source))


def test_labels_of_hypotheses() -> None:
    source, _ = scene()
    car = in_box(source.scan.points, "ahead")
    body = car.astype(np.int64)
    motions = np.stack([EGO, se2.compose(EGO, STEPS["ahead"])])
    members = np.stack([car, car, ~car, ~car])
    survey = in_units_of(0.1, motions[[1, 0, 1, 0]], members)
    assert label_hypotheses(survey, members, body, motions).tolist() == [1, 0, 0, 0]
    lost = motions.copy()
    lost[1] = np.nan
    assert label_hypotheses(survey, members, body, lost).tolist() == [-1, -1, 0, 0]
    body[car] = IGNORED
    assert label_hypotheses(survey, members, body, motions).tolist() == [-1, -1, 0, 0]


def test_far_points_tell_less_of_a_motion() -> None:
    """The same error is right on coarse surface and wrong on fine."""
    source, _ = scene()
    car = in_box(source.scan.points, "ahead")
    body = car.astype(np.int64)
    motions = np.stack([EGO, se2.compose(EGO, STEPS["ahead"])])
    off = motions[1:] + np.array([0.0, 0.25, 0.0])
    surveys = (in_units_of(0.1, off, car[None]), in_units_of(0.1, off, car[None], 0.3))  # of 0.6 m more spacing
    assert [label_hypotheses(survey, car[None], body, motions).item() for survey in surveys] == [0, 1]


def test_the_mixture_gives_a_score() -> None:
    score = fit_mixture(5, seed=3)
    assert all(value.isfinite().all() for value in score.buffers())
    assert not torch.equal(score.weight, HypothesisScore().weight)


def test_the_fit_keeps_the_default_without_movers() -> None:
    still = simulate_pairs(SimulatorConfig(beams=91, movers_min=0, movers_max=0), 1, 1, 0)[0]
    seen = view_pair(still, seed=0, views=1)
    assert len(seen[0].survey.features) > 0
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
    known = survey_at(source, target, EGO, DT)
    known = known._replace(leftover=known.leftover._replace(unit=0.1))
    points = source.scan.points
    body = in_box(points, "ahead") + 2 * in_box(points, "across")
    motions = np.stack([EGO, *(se2.compose(EGO, step) for step in STEPS.values())])
    members = members_of(known.hypotheses, np.arange(len(known.features)), len(points))
    label = label_hypotheses(known, members, body, motions)
    probabilities = probabilities_of(score_of(one), known.features)
    assert np.median(probabilities[label == 1]) > np.quantile(probabilities[label == 0], 0.9)


def test_the_mixture_has_every_kind_of_scene() -> None:
    pairs = simulate_mixture(5, seed=3)
    assert len(pairs) >= 5
    assert all(pair.annotation is not None for pair in pairs)
    assert {pair.source.is_closed for pair in pairs} == {False, True}
