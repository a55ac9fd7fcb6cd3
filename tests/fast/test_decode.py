"""The rounds of one pair in loops against the same in tensors."""

from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from support import all_real, generator, make_points, normal
from torch import Tensor

from torchcrf_scan import JointScanCRF
from torchcrf_scan.batch import ScanPairBatch
from torchcrf_scan.data.pair_file import read_pair
from torchcrf_scan.data.simulate import simulate_pairs
from torchcrf_scan.data.worlds import SimulatorConfig
from torchcrf_scan.fast import arrays, decode
from torchcrf_scan.inference.start import FARTHEST, Start
from torchcrf_scan.loops.pair import pair_of
from torchcrf_scan.prediction import Prediction
from torchcrf_scan.search.pairs import start_arrays

EVERY = 9  # real pair
TIE = 1e-6  # nats between two labels that are equally likely
CONFIGS: dict[str, dict[str, Any]] = {
    "point": {"motion_metric": "point"},
    "given": {"motion_metric": "given", "iterations": 3},
    "threshold": {"movers": "threshold"},
    "dense": {"candidates": 0, "iterations": 2},
    "two candidates": {"candidates": 2},
    "all rounds": {"stop_early": False, "iterations": 4},
    "one round": {"iterations": 1},
    "no rounds": {"iterations": 0},
    "two clusters": {"clusters": 2},
    "limit": {"outlier_distance": 0.12},
    "tight limit": {"outlier_distance": 0.03},
}


@cache
def layer() -> JointScanCRF:
    return JointScanCRF.from_pretrained("simulated", backend="eager").double().requires_grad_(False)


def with_config(**inference: Any) -> JointScanCRF:
    model = JointScanCRF.from_pretrained("simulated", backend="eager", **inference)
    return model.double().requires_grad_(False)


@cache
def simulated(seed: int, fov: float = 180.0) -> ScanPairBatch:
    pair = simulate_pairs(SimulatorConfig(beams=121, fov=fov, movers_min=2), 1, 1, seed)[0]
    return ScanPairBatch.collate([pair], torch.float64).without_truth()


def compiled(model: JointScanCRF, batch: ScanPairBatch, start: Start) -> arrays.Decoded:
    pair = pair_of(batch, 0)
    none = np.zeros(len(pair.source))
    return decode.decode_pair(
        pair, start_arrays(start, 0, pair), none, none, arrays.fitted_of(model.fitted), arrays.settings_of(model.config)
    )


@cache
def both(seed: int, fov: float) -> tuple[decode.Decoded, Prediction]:
    """The answers of loops and of tensors from the same start."""
    batch = simulated(seed, fov)
    start = layer().initialise(batch)
    return compiled(layer(), batch, start), layer()(batch, start)


def lead_over(log_beliefs: np.ndarray, best: np.ndarray, other: np.ndarray) -> np.ndarray:
    """(N,) how much likelier one state (N,) is than another (N,), in nats; infinite where the other is impossible."""
    rows = np.arange(len(log_beliefs))
    return np.where(other < 0, np.inf, log_beliefs[rows, best] - log_beliefs[rows, other])


def place_of(labels: np.ndarray, candidates: np.ndarray) -> np.ndarray:
    """(N,) column of target points (N,) among the candidates (N, K), K for outliers, -1 for what is no candidate."""
    is_there = np.concatenate([candidates == labels[:, None], labels[:, None] == -1], axis=1)
    return np.where(is_there.any(1), is_there.argmax(1), -1)


def assert_same_labels(found: arrays.Decoded, expected: Prediction) -> np.ndarray:
    """Labels may differ where two are equally likely to rounding; returns (N,) where both chains' are the same."""
    candidates, outlier = expected.candidates[0].numpy(), expected.log_cluster.shape[-1] - 1
    association, cluster = expected.association[0].numpy(), expected.cluster[0].numpy()
    leads = {
        "association": lead_over(
            expected.log_association[0].numpy(), place_of(association, candidates), place_of(found.association, candidates)
        ),
        "cluster": lead_over(expected.log_cluster[0].numpy(), *(np.where(of < 0, outlier, of) for of in (cluster, found.cluster))),
    }
    agree = np.ones(len(association), np.bool_)
    for (name, lead), labels in zip(leads.items(), (association, cluster), strict=True):
        differ = getattr(found, name) != labels
        wrong = np.flatnonzero(differ & ~(lead < TIE))
        told = [f"point {i}: {getattr(found, name)[i]}, expected {labels[i]}, likelier by {lead[i]:.2g} nats" for i in wrong]
        assert not told, f"{name} of {len(wrong)} of {len(differ)} points: {'; '.join(told[:5])}"
        agree &= ~differ
    assert agree.mean() >= 0.999, f"{(~agree).sum()} of {len(agree)} labels are ties that were broken otherwise"
    return agree


def assert_same_answer(found: arrays.Decoded, expected: Prediction) -> None:
    """Labels but for ties; everything else of the points whose labels agree, and of the clusters that lose and gain none."""
    agree = assert_same_labels(found, expected)
    touched = np.concatenate([found.cluster[~agree], expected.cluster[0].numpy()[~agree]])
    same = ~np.isin(np.arange(len(found.motions)), touched)
    close = {"rtol": 1e-6, "atol": 1e-6}
    for name in ("log_association", "log_cluster", "association_confidence", "cluster_confidence"):
        np.testing.assert_allclose(getattr(found, name)[agree], getattr(expected, name)[0][agree], err_msg=name, **close)
    np.testing.assert_allclose(found.motions[same], expected.motions[0][same], err_msg="motions", **close)
    np.testing.assert_array_equal(found.candidates[agree], expected.candidates[0][agree], err_msg="candidates")
    for name in ("active", "converged", "iterations"):
        np.testing.assert_array_equal(getattr(found, name), getattr(expected, name)[0], err_msg=name)
    assert expected.uncertainty is not None
    spread = expected.uncertainty.covariance[0].diagonal(dim1=-2, dim2=-1).sqrt().numpy()
    unit = spread[:, :, None] * spread[:, None, :]
    covariance = expected.uncertainty.covariance[0].numpy()
    np.testing.assert_allclose((found.covariance / unit)[same], (covariance / unit)[same], **close)
    np.testing.assert_allclose(found.information[same], expected.uncertainty.information[0][same], **close)


@pytest.mark.parametrize(("seed", "fov"), [(0, 180.0), (1, 180.0), (2, 360.0), (3, 360.0)])
def test_simulated_pairs_are_decoded_alike(seed: int, fov: float) -> None:
    assert_same_answer(*both(seed, fov))


@pytest.mark.parametrize("name", CONFIGS)
def test_every_setting_is_decoded_alike(name: str) -> None:
    model, batch = with_config(**CONFIGS[name]), simulated(1)
    start = model.initialise(batch)
    assert_same_answer(compiled(model, batch, start), model(batch, start))


def test_metres_and_starts_without_odds_are_decoded_alike() -> None:
    model, batch = with_config(), simulated(0)
    model.config = replace(model.config, features=replace(model.config.features, length_unit="metre", wrap_closed=False))
    start = replace(model.initialise(batch), reach=None, log_odds=None)
    assert_same_answer(compiled(model, batch, start), model(batch, start))


@pytest.mark.parametrize(("reach", "weight"), [("soft", 0.0), ("soft", 0.3), ("soft", 3.0), ("off", 0.0)])
@pytest.mark.parametrize("seed", [0, 2])
def test_reaches_are_decoded_alike(reach: str, weight: float, seed: int) -> None:
    model, batch = JointScanCRF.from_pretrained("simulated", backend="eager", features={"reach": reach}).double(), simulated(seed)
    model.requires_grad_(False)
    if reach == "soft":
        assert model.clustering_weights["reach"] == 0
        model.clustering_weights["reach"].fill_(weight)
    start = model.initialise(batch)
    assert ((start.reach > 0) & (start.reach < FARTHEST)).any()  # something in between
    expected = model(batch, start)
    assert_same_answer(compiled(model, batch, start), expected)
    if weight == 0:
        blind = layer()(batch, replace(start, reach=None))
        np.testing.assert_array_equal(expected.cluster, blind.cluster)


def test_real_pairs_are_decoded_alike(real_pairs_dir: Path) -> None:
    for file in sorted(real_pairs_dir.glob("*.npz"))[::EVERY]:
        batch = ScanPairBatch.collate([read_pair(file)], torch.float64).without_truth()
        start = layer().initialise(batch)
        assert_same_answer(compiled(layer(), batch, start), layer()(batch, start))


def made(source: Tensor, target: Tensor, initial: Tensor) -> ScanPairBatch:
    one, closed = torch.ones(1, dtype=torch.float64), torch.tensor([False])
    masks = all_real(source[None]), all_real(target[None])
    return ScanPairBatch(source[None], target[None], *masks, closed, closed, one / 10, one / 50, initial[None])


def begin(batch: ScanPairBatch, seed: int) -> Start:
    n, m = batch.source.shape[1], batch.target.shape[1]
    association = torch.randint(-1, m, (1, n), generator=generator(seed))
    tangents = torch.nn.functional.normalize(normal(1, m, 2, seed=seed), dim=-1)
    active = torch.tensor([[True, True, False]])
    log_odds = torch.tensor([[torch.inf, 1.0, -torch.inf]], dtype=torch.float64)
    reach = normal(1, n, 3, seed=seed + 1).clamp(min=0) * torch.tensor([0.0, 1.0, 1.0])
    return Start(0.1 * normal(1, 3, 3, seed=seed), active, association, tangents, reach, log_odds)


@pytest.mark.parametrize(("n", "m"), [(1, 1), (2, 2), (3, 1), (1, 4), (12, 9)])
def test_tiny_scans_are_decoded_alike(n: int, m: int) -> None:
    model = with_config(clusters=4)
    batch = made(make_points(n, 1), make_points(m, 2), 0.1 * normal(3, seed=3))
    start = begin(batch, n + m)
    assert_same_answer(compiled(model, batch, start), model(batch, start))


def test_points_on_one_spot_give_numbers() -> None:
    model = with_config(clusters=4)
    spot = torch.tensor([[1.0, 2.0]], dtype=torch.float64).repeat(7, 1)
    batch = made(spot, spot, torch.zeros(3, dtype=torch.float64))
    found = compiled(model, batch, begin(batch, 1))
    for values in (found.motions, found.covariance, found.information, found.directions, found.association_confidence):
        assert np.isfinite(values).all()
    assert not np.isnan(found.log_association).any()
    assert not np.isnan(found.log_cluster).any()


def test_nothing_that_is_given_changes() -> None:
    batch = simulated(0)
    pair, start = pair_of(batch, 0), layer().initialise(batch)
    first, extra = start_arrays(start, 0, pair), (0.1 * normal(2, len(pair.source), seed=1)).numpy()
    given = [np.copy(values) for values in (*first, *extra, pair.source, pair.target)]
    learned, settings = arrays.fitted_of(layer().fitted), arrays.settings_of(layer().config)
    once, twice = (decode.decode_pair(pair, first, *extra, learned, settings) for _ in range(2))
    for before, after in zip(given, (*first, *extra, pair.source, pair.target), strict=True):
        np.testing.assert_array_equal(before, after)
    for a, b in zip(once, twice, strict=True):
        np.testing.assert_array_equal(a, b)


def altered(decoded: arrays.Decoded, **values: Any) -> arrays.Decoded:
    """A copy that differs at point 0, or of cluster 0."""
    for name, value in values.items():
        changed = getattr(decoded, name).copy()
        changed[0] = value
        decoded = decoded._replace(**{name: changed})
    return decoded


def test_the_comparison_sees_every_difference() -> None:
    found, expected = both(0, 180.0)
    assert_same_answer(found, expected)
    other = (found.cluster[0] + 1) % 3
    with pytest.raises(AssertionError, match=rf"cluster of 1 of \d+ points: point 0: {other}, expected {found.cluster[0]}"):
        assert_same_answer(altered(found, cluster=other), expected)
    with pytest.raises(AssertionError, match=r"association of 1 of \d+ points: point 0: -5"):
        assert_same_answer(altered(found, association=-5), expected)
    for name in ("log_cluster", "log_association", "association_confidence", "cluster_confidence", "motions", "candidates"):
        with pytest.raises(AssertionError, match=name):
            assert_same_answer(altered(found, **{name: 77}), expected)


def test_a_tie_may_be_broken_either_way() -> None:
    found, expected = both(0, 180.0)
    tied = expected.log_cluster.clone()
    tied[0, 0] = -1.0  # all clusters of point 0 are equally likely
    found = altered(found, cluster=(found.cluster[0] + 1) % 3)
    many = 1000 // len(found.cluster) + 1  # of more than a thousand points, one may
    with pytest.raises(AssertionError, match=r"1 of \d+ labels are ties"):
        assert_same_labels(found, replace(expected, log_cluster=tied))
    several = found._replace(**{name: np.concatenate([getattr(found, name)] * many) for name in ("association", "cluster")})
    several = several._replace(cluster=np.concatenate([found.cluster, *[expected.cluster[0].numpy()] * (many - 1)]))
    repeated = {
        name: getattr(expected, name).repeat(1, many, *[1] * (getattr(expected, name).dim() - 2))
        for name in ("association", "cluster", "candidates", "log_association")
    }
    whole = replace(expected, log_cluster=torch.cat([tied, *[expected.log_cluster] * (many - 1)], 1), **repeated)
    assert np.flatnonzero(~assert_same_labels(several, whole)).tolist() == [0]
