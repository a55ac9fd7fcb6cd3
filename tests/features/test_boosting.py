import numpy as np
import oracles
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from sklearn.ensemble import AdaBoostClassifier
from sklearn.tree import DecisionTreeClassifier
from support import assert_close, generator, normal
from torch import Tensor

from torchcrf_scan.features.boosting import StumpEnsemble

SEEDS = st.integers(0, 10_000)
STUMPS = 12


def make_stumps(F: int, T: int, seed: int) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Feature, threshold, left, right; thresholds on a coarse grid, so that some are equal and some hit the inputs exactly."""
    feature = torch.randint(F, (T,), generator=generator(seed))
    threshold = torch.randint(-4, 5, (T,), generator=generator(seed + 1)) / 4
    left, right = normal(2, T, seed=seed)
    return feature, threshold, left, right


def make_ensemble(F: int, T: int, seed: int) -> StumpEnsemble:
    ensemble = StumpEnsemble(F, stumps=STUMPS)
    ensemble.set_stumps(*make_stumps(F, T, seed))
    return ensemble


def make_inputs(*shape: int, seed: int = 0) -> Tensor:
    return torch.randint(-6, 7, shape, generator=generator(seed)) / 4


@given(st.integers(1, 5), st.integers(0, STUMPS), st.integers(0, 9), SEEDS)
def test_tables_equal_the_loop(F: int, T: int, examples: int, seed: int) -> None:
    phi = make_inputs(examples, F, seed=seed)
    expected = [oracles.stump_sum(row, *(column.tolist() for column in make_stumps(F, T, seed))) for row in phi.tolist()]
    assert_close(make_ensemble(F, T, seed)(phi), torch.tensor(expected))


@given(st.integers(2, 6), st.integers(1, 5), SEEDS)
def test_margins_of_some_channels_add_up(F: int, cut: int, seed: int) -> None:
    cut = min(cut, F - 1)
    ensemble, phi = make_ensemble(F, STUMPS, seed), make_inputs(3, 4, F, seed=seed)
    split = ensemble.margins(phi[..., :cut]) + ensemble.margins(phi[..., cut:], first=cut)
    assert_close(split, ensemble(phi))


def test_the_static_margin_keeps_when_the_registered_channel_changes() -> None:
    ensemble, phi = make_ensemble(12, STUMPS, 3), make_inputs(2, 5, 12)
    static = ensemble.margins(phi[..., :11])
    moved = torch.cat([phi[..., :11], make_inputs(2, 5, 1, seed=9)], dim=-1)
    assert_close(static + ensemble.margins(moved[..., 11:], first=11), ensemble(moved))


@pytest.mark.parametrize("shape", [(), (0,), (4,), (2, 3), (2, 3, 4)], ids=str)
def test_any_leading_shape(shape: tuple[int, ...]) -> None:
    ensemble, phi = make_ensemble(3, STUMPS, 0), make_inputs(*shape, 3)
    margin = ensemble(phi)
    assert margin.shape == shape
    assert_close(margin.flatten(), ensemble(phi.reshape(-1, 3)))


def test_an_input_at_the_threshold_goes_left() -> None:
    ensemble = StumpEnsemble(1, stumps=2)
    ensemble.set_stumps(torch.tensor([0]), torch.tensor([0.5]), torch.tensor([-1.0]), torch.tensor([1.0]))
    assert ensemble(torch.tensor([[0.5], [0.5000001], [-torch.inf], [torch.inf]])).tolist() == [-1.0, 1.0, -1.0, 1.0]


def test_zero_until_fitted() -> None:
    assert not StumpEnsemble(3)(normal(5, 3)).any()


def test_refitting_forgets() -> None:
    ensemble = make_ensemble(3, STUMPS, 0)
    ensemble.set_stumps(*make_stumps(3, 2, 5))
    assert_close(ensemble(make_inputs(7, 3)), make_ensemble(3, 2, 5)(make_inputs(7, 3)))


def test_wrong_number_of_features() -> None:
    with pytest.raises(ValueError, match="phi: expected 3 features, got 4"):
        StumpEnsemble(3)(torch.zeros(2, 4))


def test_state_and_repr() -> None:
    ensemble, other = make_ensemble(3, STUMPS, 0), StumpEnsemble(3, stumps=STUMPS)
    other.load_state_dict(ensemble.state_dict())
    assert_close(other(make_inputs(7, 3)), ensemble(make_inputs(7, 3)))
    assert "features=3, stumps=12" in repr(ensemble)


# Against scikit-learn.


def not_above(threshold: float) -> float:
    """The largest float32 that is not above the threshold: the same inputs stay left of it."""
    rounded = np.float32(threshold)
    return float(rounded if rounded <= threshold else np.nextafter(rounded, np.float32(-np.inf)))


def stumps_of(fitted: AdaBoostClassifier) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    rows = []
    for estimator, alpha in zip(fitted.estimators_, fitted.estimator_weights_, strict=False):
        tree = estimator.tree_
        leaves = (0, 0) if tree.node_count == 1 else (tree.children_left[0], tree.children_right[0])
        left, right = (alpha * (2 * estimator.classes_[tree.value[leaf, 0].argmax()] - 1) for leaf in leaves)
        rows.append((max(tree.feature[0], 0), not_above(tree.threshold[0]), left, right))
    feature, threshold, left, right = zip(*rows, strict=True)
    return torch.tensor(feature), torch.tensor(threshold), torch.tensor(left).double(), torch.tensor(right).double()


@pytest.mark.parametrize("grid", [None, 2.0**-2, 2.0**-22], ids=["continuous", "coarse", "neighbouring floats"])
@pytest.mark.parametrize("stumps", [1, 10, 50])
def test_margins_equal_scikit_learn(stumps: int, grid: float | None) -> None:
    rng = np.random.default_rng(stumps)
    inputs = rng.standard_normal((600, 5)) if grid is None else 2 + grid * rng.integers(0, 8, (600, 5))
    inputs = inputs.astype(np.float32)
    ranks = inputs.argsort(0).argsort(0) / 600
    labels = (ranks[:, 0] + ranks[:, 1] ** 2 + 0.3 * rng.standard_normal(600) > 0.8).astype(int)
    booster = AdaBoostClassifier(DecisionTreeClassifier(max_depth=1), n_estimators=stumps, random_state=0).fit(inputs, labels)
    ensemble = StumpEnsemble(5, stumps=50)
    ensemble.set_stumps(*stumps_of(booster))
    expected = booster.decision_function(inputs) * booster.estimator_weights_.sum() / 2
    margin = ensemble(torch.from_numpy(inputs))
    assert_close(margin, expected, tolerance=1e-6)
    assert np.unique(expected).size > 1


def test_a_perfect_split_stops_early() -> None:
    inputs = np.linspace(-1, 1, 40, dtype=np.float32)[:, None]
    labels = (inputs[:, 0] > 0).astype(int)
    booster = AdaBoostClassifier(DecisionTreeClassifier(max_depth=1), n_estimators=50).fit(inputs, labels)
    ensemble = StumpEnsemble(1, stumps=50)
    ensemble.set_stumps(*stumps_of(booster))
    assert len(booster.estimators_) == 1
    assert ((ensemble(torch.from_numpy(inputs)) > 0).numpy() == labels).all()
