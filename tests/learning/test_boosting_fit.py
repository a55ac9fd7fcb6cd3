"""Boosters: scikit-learn's ensemble as tables, and examples that are what they claim to be."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from sklearn.ensemble import AdaBoostClassifier
from sklearn.tree import DecisionTreeClassifier
from support import generator, make_points

from torchcrf_scan.batch import ScanPairBatch
from torchcrf_scan.config import InferenceConfig
from torchcrf_scan.data.simulate import simulate_pairs
from torchcrf_scan.data.worlds import SimulatorConfig
from torchcrf_scan.features.boosting import StumpEnsemble
from torchcrf_scan.features.potentials import OUTLIER_INPUTS, Boosters, PairView
from torchcrf_scan.features.scales import Scales
from torchcrf_scan.inference.pseudo_likelihood import true_plugins
from torchcrf_scan.learning import boosting_fit
from torchcrf_scan.learning.boosting_fit import data_examples, fit_boosters, fit_stumps, outlier_examples, sample_targets
from torchcrf_scan.names import LOCAL_CHANNELS


def toy(count: int = 400, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Float32 inputs, some of them rounded so that many are equal, and noisy labels, a quarter of them positive."""
    draw = np.random.default_rng(seed)
    inputs = draw.normal(size=(count, 5)).astype(np.float32)
    inputs[:, 3] = np.round(inputs[:, 3])
    score = inputs[:, 0] + np.abs(inputs[:, 1]) + inputs[:, 3] + draw.normal(size=count)
    return inputs, score > np.quantile(score, 0.75)


@pytest.mark.parametrize("stumps", [1, 7, 50])
def test_the_tables_are_scikit_learns_decision_function(stumps: int) -> None:
    inputs, positive = toy()
    found = fit_stumps(inputs, positive, stumps)(torch.from_numpy(inputs)).double().numpy()
    balance = np.where(positive, 0.5 / positive.sum(), 0.5 / (~positive).sum())
    reference = AdaBoostClassifier(DecisionTreeClassifier(max_depth=1), n_estimators=stumps, random_state=0)
    reference.fit(inputs, positive, sample_weight=balance)
    expected = reference.decision_function(inputs) * reference.estimator_weights_.sum() / 4
    assert np.abs(found - expected).max() < 1e-6 * max(1.0, np.abs(expected).max())
    assert ((found > 0) == reference.predict(inputs))[np.abs(expected) > 1e-6].all()


def test_the_margin_is_the_sum_of_alphas_and_signs() -> None:
    inputs, positive = toy()
    reference = AdaBoostClassifier(DecisionTreeClassifier(max_depth=1), n_estimators=9, random_state=0)
    reference.fit(inputs, positive, sample_weight=np.where(positive, 0.5 / positive.sum(), 0.5 / (~positive).sum()))
    margin = np.zeros(len(inputs))
    for tree, error in zip(reference.estimators_, reference.estimator_errors_, strict=True):
        margin += 0.5 * np.log((1 - error) / error) * np.where(tree.predict(inputs), 1.0, -1.0)
    assert np.allclose(fit_stumps(inputs, positive, 9)(torch.from_numpy(inputs)).numpy(), margin, atol=1e-5)


def test_a_perfect_split_stops_early_and_stays_finite() -> None:
    inputs = np.linspace(-1, 1, 40, dtype=np.float32)[:, None]
    ensemble = fit_stumps(inputs, inputs[:, 0] > 0.25, 10)
    margins = ensemble(torch.from_numpy(inputs)).numpy()
    assert np.isfinite(margins).all()
    assert ((margins > 0) == (inputs[:, 0] > 0.25)).all()


@pytest.mark.parametrize("label", [True, False])
def test_one_class_alone_teaches_nothing(label: bool) -> None:
    inputs, _ = toy(20)
    ensemble = fit_stumps(inputs, np.full(20, label), 5)
    assert (ensemble(torch.from_numpy(inputs)) == 0).all()
    assert ensemble.thresholds.shape == (5, 5)


def test_inputs_that_tell_nothing_are_no_error() -> None:
    ensemble = fit_stumps(np.zeros((30, 2), dtype=np.float32), np.arange(30) < 10, 4)
    assert ensemble(torch.zeros(3, 2)).isfinite().all()


@pytest.mark.parametrize("count", [1, 2, 4, 10])
def test_wrong_targets_are_never_the_true_one_or_its_neighbour(count: int) -> None:
    B, N, M = 3, 30, 25
    truth = torch.randint(-1, M - 5, (B, N), generator=generator(1))
    moved, target = torch.stack([make_points(N, k) for k in range(B)]), torch.stack([make_points(M, 9 + k) for k in range(B)])
    target_mask = torch.arange(M) < torch.tensor([25, 22, 20])[:, None]
    for seed in range(20):
        index, usable = sample_targets(truth, moved, target, target_mask, count, generator(seed))
        assert index.shape == usable.shape == (B, N, count)
        apart = (index - truth[..., None]).abs()
        assert (apart[usable & (truth >= 0)[..., None]] > 1).all()
        assert ((index >= 0) & (index < M)).all()
        assert target_mask.gather(1, index.flatten(1)).view(index.shape)[usable].all()
        assert usable[truth < 0].any()
    assert usable.float().mean() > 0.6


def test_wrong_targets_of_an_inlier_are_anywhere_near_in_space_and_near_in_index() -> None:
    """Five, three and two of ten (spec 2.2)."""
    N, M = 400, 60
    moved, target = make_points(N)[None], make_points(M, 9)[None]
    truth = torch.randint(12, M - 12, (1, N), generator=generator(1))
    index, _ = sample_targets(truth, moved, target, torch.ones(1, M, dtype=torch.bool), 10, generator(0))
    nearest = torch.cdist(moved[0], target[0]).argsort(-1)[:, :15]
    is_near = (index[0, :, :, None] == nearest[:, None]).any(-1)
    assert is_near[:, 5:8].all()
    assert is_near[:, :5].float().mean() < 0.4  # a quarter of the targets is near
    apart = (index - truth[..., None]).abs()[0, :, 8:]
    assert ((apart >= 2) & (apart <= 10)).all()
    assert torch.bincount(index[..., :5].flatten(), minlength=M).min() > 10


def test_wrong_targets_of_an_outlier_are_anywhere_and_the_nearest() -> None:
    N, M, count = 400, 60, 10
    moved, target = make_points(N)[None], make_points(M, 9)[None]
    target_mask = torch.arange(M)[None] < 50
    index, usable = sample_targets(torch.full((1, N), -1), moved, target, target_mask, count, generator(0))
    assert usable.all()
    assert torch.bincount(index[..., :5].flatten(), minlength=50).min() > 10  # of 40 expected
    nearest = torch.cdist(moved[0], target[0, :50]).argsort(-1)[:, :5]
    assert torch.equal(index[0, :, 5:].sort(-1).values, nearest.sort(-1).values)


@pytest.mark.parametrize("count", [10, 40])
def test_wrong_targets_of_an_outlier_in_a_short_scan(count: int) -> None:
    target_mask = torch.tensor([[True, True, True, False]])
    index, usable = sample_targets(
        torch.full((1, 6), -1), make_points(6)[None], make_points(4, 1)[None], target_mask, count, generator(0)
    )
    assert (index[usable] < 3).all()
    near = index[0, :, count // 2 :][usable[0, :, count // 2 :]].view(6, 3)
    assert near.sort(-1).values.tolist() == [[0, 1, 2]] * 6


def test_wrong_targets_of_a_tiny_scan() -> None:
    truth = torch.zeros(1, 3, dtype=torch.int64)
    index, usable = sample_targets(
        truth, make_points(3)[None], make_points(2)[None], torch.ones(1, 2, dtype=torch.bool), 6, generator(0)
    )
    assert not usable.any()  # the only other point is the neighbour
    assert ((index >= 0) & (index < 2)).all()


@pytest.fixture(scope="module")
def batch() -> ScanPairBatch:
    """Three annotated pairs of different sizes."""
    return ScanPairBatch.collate([simulate_pairs(SimulatorConfig(beams=b), 1, 1, b)[0] for b in (61, 91, 51)])


def test_data_examples_are_one_true_pair_a_point_and_some_wrong_ones(batch: ScanPairBatch) -> None:
    assert batch.truth is not None
    view, plugins = PairView.of(batch), true_plugins(batch, 7)
    inputs, positive = data_examples(view, plugins, Scales(), 4, generator(0))
    inliers = int(((batch.truth.association >= 0) & batch.truth.known & plugins.known).sum())
    nodes = int((batch.truth.known & plugins.known).sum())
    assert inputs.shape == (len(positive), 12)
    assert int(positive.sum()) == inliers
    assert 2 * nodes < int((~positive).sum()) <= 4 * nodes
    registered = inputs[:, -1]
    assert registered[positive].mean() > registered[~positive].mean() + 1


def test_ignored_points_are_no_examples(batch: ScanPairBatch) -> None:
    assert batch.truth is not None
    known = batch.truth.known.clone()
    known[:, ::2] = False
    half = replace(batch, truth=replace(batch.truth, known=known))
    plugins = true_plugins(half, 7)
    nodes = int((known & plugins.known).sum())
    inputs, positive = outlier_examples(PairView.of(half), plugins, Scales(), Boosters(3).data, InferenceConfig())
    assert inputs.shape == (nodes, OUTLIER_INPUTS)
    assert int(positive.sum()) == int((known & plugins.known & (batch.truth.association < 0)).sum())
    assert int(data_examples(PairView.of(half), plugins, Scales(), 4, generator(0))[1].sum()) == nodes - int(positive.sum())


def test_boosters_tell_right_from_wrong(batch: ScanPairBatch) -> None:
    views, plugins = [PairView.of(batch)], [true_plugins(batch, 7)]
    settings = {"stumps": 20, "negatives": 4, "inference": InferenceConfig(), "most": 0, "hidden": ()}
    boosters = fit_boosters(views, plugins, Scales(), **settings, generator=generator(0))
    inputs, positive = data_examples(views[0], plugins[0], Scales(), 4, generator(5))
    assert ((boosters.data(inputs) > 0) == positive).float().mean() > 0.85
    inputs, positive = outlier_examples(views[0], plugins[0], Scales(), boosters.data, InferenceConfig())
    assert ((boosters.outlier(inputs) > 0) == positive).float().mean() > 0.8
    again = fit_boosters(views, plugins, Scales(), **settings, generator=generator(0))
    for name, value in boosters.state_dict().items():
        assert torch.equal(again.state_dict()[name], value), name


def boosters_of(batch: ScanPairBatch, *, most: int = 0, hidden: tuple[int, ...] = (), seed: int = 0) -> Boosters:
    return fit_boosters(
        [PairView.of(batch)],
        [true_plugins(batch, 7)],
        Scales(),
        stumps=20,
        negatives=4,
        inference=InferenceConfig(),
        most=most,
        hidden=hidden,
        generator=generator(seed),
    )


@pytest.mark.parametrize("hidden", [(0,), (11, 3, 9)])
def test_no_stump_looks_at_a_hidden_channel(batch: ScanPairBatch, hidden: tuple[int, ...]) -> None:
    boosters, seeing = boosters_of(batch, hidden=hidden), boosters_of(batch)
    for name, width in (("data", len(LOCAL_CHANNELS)), ("outlier", OUTLIER_INPUTS)):
        inputs = -9 * torch.rand(200, width, generator=generator(3))
        changed = inputs.clone()
        changed[:, list(hidden)] = -9 * torch.rand(200, len(hidden), generator=generator(4))
        blind = getattr(boosters, name)
        assert torch.equal(blind(inputs), blind(changed)), name
        assert blind(inputs).unique().numel() > 2, name
    assert not torch.equal(seeing.data(inputs[:, :12]), seeing.data(changed[:, :12])) or hidden == (0,)


def test_more_examples_than_there_are_is_all_of_them(batch: ScanPairBatch) -> None:
    everything, enough = boosters_of(batch), boosters_of(batch, most=100_000)
    for name, value in everything.state_dict().items():
        assert torch.equal(enough.state_dict()[name], value), name


def test_few_examples_are_drawn_at_random(batch: ScanPairBatch, monkeypatch: pytest.MonkeyPatch) -> None:
    seen: list[tuple[np.ndarray, np.ndarray]] = []

    def watch(inputs: np.ndarray, positive: np.ndarray, stumps: int) -> StumpEnsemble:
        seen.append((inputs, positive))
        return fit_stumps(inputs, positive, stumps)

    monkeypatch.setattr(boosting_fit, "fit_stumps", watch)
    for most, seed in ((0, 0), (60, 0), (60, 0), (60, 1)):
        boosters_of(batch, most=most, seed=seed)
    every, one, same, other = (seen[k][0] for k in (0, 2, 4, 6))
    assert len(every) > len(one) == len(other) == len(seen[3][0]) == 60
    assert np.array_equal(one, same)
    assert not np.array_equal(one, other)
    rows = {row.tobytes() for row in every}
    assert all(row.tobytes() in rows for row in one)
    assert 0 < seen[2][1].sum() < 60


def test_few_examples_still_tell_right_from_wrong(batch: ScanPairBatch) -> None:
    inputs, positive = data_examples(PairView.of(batch), true_plugins(batch, 7), Scales(), 4, generator(5))
    found = boosters_of(batch, most=300).data(inputs) > 0
    assert (found == positive).float().mean() > 0.8
