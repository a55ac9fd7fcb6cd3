"""The convex part: the optimum of a conditional logit, whatever the units of its features."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
import torch
from support import assert_close, generator, normal
from torch import Tensor

from torchcrf_scan.inference.pseudo_likelihood import Chain, Design
from torchcrf_scan.learning.settings import LearningConfig
from torchcrf_scan.learning.weights_fit import fit_chain, fit_weights, flatten

EXACT = LearningConfig(tolerance=1e-9, max_steps=500)


def make_design(nodes: int = 400, states: int = 5, features: int = 4, seed: int = 0) -> tuple[Design, Tensor]:
    """A conditional logit whose labels are drawn from known weights; a tenth of the states is impossible."""
    values = normal(1, nodes, states, features, seed=seed) * torch.tensor([1.0, 5.0, 0.2, 1.0]).double()[:features]
    mask = torch.rand(1, nodes, states, generator=generator(seed)) > 0.1
    mask[..., 0] = True
    weights = normal(features, seed=seed + 1)
    log_probability = torch.log_softmax((values @ weights).masked_fill(~mask, -torch.inf), -1)
    label = torch.multinomial(log_probability.exp()[0], 1, generator=generator(seed + 2))[None, :, 0]
    return Design(values, mask, label, torch.ones(1, nodes, dtype=torch.bool)), weights


def newton(design: Design, prior: float, spread: np.ndarray) -> np.ndarray:
    """Minimum of -log likelihood + sum_f (w_f spread_f)^2 / (2 prior^2), step by step in numpy."""
    values, mask = design.features[0].numpy(), design.mask[0].numpy()
    chosen = values[np.arange(len(values)), design.label[0].numpy()]
    shrink = spread**2 / prior**2
    weights = np.zeros(values.shape[-1])
    for _ in range(50):
        score = np.where(mask, values @ weights, -np.inf)
        probability = np.exp(score - score.max(1, keepdims=True))
        probability /= probability.sum(1, keepdims=True)
        mean = (probability[..., None] * values).sum(1)
        centred = values - mean[:, None]
        gradient = (mean - chosen).sum(0) + shrink * weights
        hessian = np.einsum("ns,nsf,nsg->fg", probability, centred, centred) + np.diag(shrink)
        weights = weights - np.linalg.solve(hessian, gradient)
    return weights


def spread_of(design: Design) -> np.ndarray:
    return design.features[design.mask].std(dim=0).numpy()


@pytest.mark.parametrize("prior", [0.3, 10.0])
def test_the_optimum_is_newtons(prior: float) -> None:
    design, _ = make_design()
    found = fit_weights(design, LearningConfig(prior=prior, tolerance=1e-9, max_steps=500))
    assert_close(found, newton(design, prior, spread_of(design)), tolerance=1e-5)


def test_the_weights_that_made_the_labels_are_found() -> None:
    design, weights = make_design(nodes=6000)
    found = fit_weights(design, EXACT)
    scale = torch.from_numpy(spread_of(design))
    assert_close(found * scale, weights * scale, tolerance=0.15)


def test_the_units_of_the_features_do_not_matter() -> None:
    design, _ = make_design()
    units = torch.tensor([1e3, 1e-2, 7.0, 0.3]).double()
    rescaled = Design(design.features * units, design.mask, design.label, design.known)
    one, other = fit_weights(design, EXACT), fit_weights(rescaled, EXACT)
    assert_close(other * units, one, tolerance=1e-5)


def test_a_constant_feature_has_no_weight() -> None:
    design, _ = make_design()
    features = torch.cat([design.features, torch.full_like(design.features[..., :1], 3.0)], dim=-1)
    found = fit_weights(Design(features, design.mask, design.label, design.known), EXACT)
    assert abs(float(found[-1])) < 1e-6
    assert_close(found[:-1], fit_weights(design, EXACT), tolerance=1e-5)


def test_dead_weights_stay_at_zero() -> None:
    design, _ = make_design()
    live = torch.tensor([1.0, 0.0, 1.0, 1.0]).double()
    found = fit_weights(design, EXACT, live=live)
    without = Design(design.features[..., [0, 2, 3]], design.mask, design.label, design.known)
    assert float(found[1]) == 0
    assert_close(found[[0, 2, 3]], fit_weights(without, EXACT), tolerance=1e-5)


def test_another_start_leads_to_the_same_place() -> None:
    design, _ = make_design()
    assert_close(fit_weights(design, EXACT, start=normal(4, seed=9)), fit_weights(design, EXACT), tolerance=1e-5)


def test_separable_labels_stay_finite() -> None:
    design, _ = make_design(nodes=20, states=2, features=1)
    best = design.features[..., 0].masked_fill(~design.mask, -torch.inf).argmax(-1)
    found = fit_weights(Design(design.features, design.mask, best, design.known), LearningConfig())
    assert found.isfinite().all()
    assert float(found[0]) > 0


def test_the_watch_sees_the_objective_fall() -> None:
    design, _ = make_design()
    seen: list[tuple[int, float, float, Tensor]] = []
    found = fit_weights(design, LearningConfig(), lambda *step: seen.append(step))
    steps, losses, slopes, weights = zip(*seen, strict=True)
    assert list(steps) == list(range(1, len(seen) + 1))
    assert all(later < earlier for earlier, later in pairwise(losses))
    assert slopes[-1] <= LearningConfig().tolerance
    assert_close(weights[-1], found)
    at_end = -float(design.log_likelihood(found).mean())
    assert abs(losses[-1] - at_end) < 1e-3


def test_few_steps_are_few() -> None:
    design, _ = make_design()
    seen: list[int] = []
    fit_weights(design, LearningConfig(max_steps=2), lambda step, *_: seen.append(step))
    assert seen == [1, 2]


def test_flatten_keeps_known_nodes_and_the_outlier_last() -> None:
    narrow, wide = normal(1, 3, 3, 2, seed=1), normal(2, 2, 5, 2, seed=2)
    designs = [
        Design(narrow, torch.ones(1, 3, 3, dtype=torch.bool), torch.tensor([[0, 2, 1]]), torch.tensor([[True, True, False]])),
        Design(
            wide, torch.ones(2, 2, 5, dtype=torch.bool), torch.tensor([[4, 0], [2, 3]]), torch.tensor([[True, False], [True, True]])
        ),
    ]
    flat = flatten(designs)
    assert flat.features.shape == (1, 5, 5, 2)
    assert flat.features.dtype == torch.float64
    assert flat.label.tolist() == [[0, 4, 4, 2, 3]]
    assert flat.mask[0, 0].tolist() == [True, True, False, False, True]
    assert_close(flat.features[0, 1, [0, 1, 4]], narrow[0, 1])
    weights = normal(2)
    expected = torch.cat([design.log_likelihood(weights)[design.known] for design in designs])
    assert_close(flat.log_likelihood(weights)[0], expected)


def test_a_prior_around_weights_leaves_them_where_nothing_is_told() -> None:
    """A narrow prior keeps its mean, a wide one finds what no mean finds; dead weights stay at the mean."""
    design, truth = make_design()
    around = truth + 1.0
    narrow = fit_weights(design, replace(EXACT, prior=1e-4), around=around)
    assert_close(narrow, around, tolerance=1e-3)
    wide = fit_weights(design, replace(EXACT, prior=100.0), around=around)
    assert_close(wide, fit_weights(design, replace(EXACT, prior=100.0)), tolerance=1e-3)
    live = torch.tensor([1.0, 0.0, 1.0, 1.0]).double()
    assert fit_weights(design, replace(EXACT, prior=100.0), live=live, around=around)[1] == around[1]


def test_the_prior_pulls_towards_its_mean_as_newton_says() -> None:
    """In units of the features' spread: the same optimum as of weights less the mean, with the mean's score as extra potentials."""
    design, truth = make_design()
    shifted = Design(design.features, design.mask, design.label, design.known, design.features @ truth)
    config = replace(EXACT, prior=0.05)
    assert_close(fit_weights(design, config, around=truth), truth + fit_weights(shifted, config), tolerance=1e-5)


def test_flatten_keeps_extra_potentials_beside_their_states() -> None:
    """Of batches with other numbers of states, the outlier last; 0 where there are none."""
    wide, _ = make_design(nodes=3, states=5)
    narrow, _ = make_design(nodes=2, states=3, seed=1)
    extra = normal(1, 2, 3, seed=2)
    both = flatten([wide, replace(narrow, extra=extra)])
    assert both.extra is not None
    assert (both.extra[0, :3] == 0).all()
    assert_close(both.extra[0, 3:][:, [0, 1, 4]], extra[0])
    assert (both.extra[0, 3:, 2:4] == 0).all()


def test_a_pair_that_counts_twice_is_as_two_and_one_that_counts_nothing_as_none() -> None:
    (one, _), (other, _) = make_design(120, seed=0), make_design(80, seed=5)
    twice, weighed = flatten([one, one]), flatten([one, other], [torch.tensor([2.0]), torch.tensor([0.0])])
    weights = torch.tensor([0.3, -0.2, 0.5, 0.1]).double()
    assert_close(weighed.log_likelihood(weights).sum(), twice.log_likelihood(weights).sum(), tolerance=1e-9)
    live = torch.ones(4).double()
    spread = lambda d: d.features[d.mask].std(dim=0)  # noqa: E731
    config = replace(EXACT, prior=1e6)  # so weak that the unit of the prior, the spread of all states, does not matter
    alone = fit_chain([one], live, config)
    found = fit_chain([one, other], live, config, counts=[torch.tensor([2.0]), torch.tensor([0.0])])
    assert_close(found * spread(one), alone * spread(one), tolerance=1e-5)


def test_counts_weigh_the_exact_likelihood_of_pairs() -> None:
    """As a chain that is there twice, so one that counts twice; and one that counts nothing is not there."""

    def chain(seed: int) -> Chain:
        label = torch.randint(0, 3, (1, 6), generator=generator(seed))
        return Chain(
            normal(1, 6, 3, 2, seed=seed), normal(1, 5, 3, 3, 2, seed=seed + 1), torch.ones(1, 6, 3).bool(), label, label > -1
        )

    one, other = chain(3), chain(8)
    config, live = replace(EXACT, objective="likelihood", prior=1e3), torch.ones(4).double()
    twice = fit_chain([one, one, other], live, config)
    weighed = fit_chain([one, other], live, config, counts=[torch.tensor([2.0]), torch.tensor([1.0])])
    assert_close(weighed, twice, tolerance=2e-3)
