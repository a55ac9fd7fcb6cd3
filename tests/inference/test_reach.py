"""How far a point is from the segment that a mover was found by, and what soft, hard and off make of it."""

import json
import math
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from scenes import MOTIONS, make_start, scene
from support import assert_close, generator, make_points
from torch import Tensor

from torchcrf_scan import JointScanCRF
from torchcrf_scan.batch import ScanPairBatch
from torchcrf_scan.config import FeatureConfig, InferenceConfig, ModelConfig
from torchcrf_scan.features.potentials import PairView
from torchcrf_scan.inference.joint import first_state
from torchcrf_scan.inference.selection import evidence
from torchcrf_scan.inference.start import FARTHEST, REACH_EXTENT, REACH_UNITS, Start, beyond_reach
from torchcrf_scan.prediction import Prediction

C = len(MOTIONS)
VARIANTS = ("sweep", "flooding", "lattice")


def by_loops(points: list[list[float]], members: list[int], unit: float) -> list[float]:
    """Of every point, the distance to the nearest member in reaches, less one."""
    if not members:
        return [FARTHEST] * len(points)
    xs, ys = zip(*(points[j] for j in members), strict=True)
    reach = REACH_EXTENT * math.hypot(max(xs) - min(xs), max(ys) - min(ys)) + REACH_UNITS * unit
    nearest = [min(math.dist(p, points[j]) for j in members) for p in points]
    return [min(max(distance / reach - 1, 0.0), FARTHEST) for distance in nearest]


@pytest.mark.parametrize("seed", range(4))
def test_it_is_the_distance_in_reaches_beyond_the_first(seed: int) -> None:
    points = torch.stack([make_points(40, seed), make_points(40, seed + 50)])
    members = torch.rand(2, C, 40, generator=generator(seed)) < 0.1
    members[1, 2] = False
    unit = torch.tensor([0.01, 0.1]).double()
    found = beyond_reach(points, members, unit)
    assert (found[..., 0] == 0).all()
    for b in range(2):
        for c in range(1, C):
            expected = by_loops(points[b].tolist(), members[b, c].nonzero()[:, 0].tolist(), float(unit[b]))
            assert_close(found[b, :, c], expected, tolerance=1e-6)
    assert ((found > 0) & (found < FARTHEST)).any()


def test_a_point_without_extent_reaches_itself_alone() -> None:
    points = make_points(5, 1)[None]
    members = torch.arange(5) == torch.tensor([[0], [3]])
    found = beyond_reach(points, members[None], torch.zeros(1).double())
    assert found[0, :, 1].tolist() == [FARTHEST, FARTHEST, FARTHEST, 0.0, FARTHEST]


def test_it_has_a_gradient_in_the_points() -> None:
    points = make_points(12, 3)[None].requires_grad_()
    members = torch.stack([torch.arange(12) < 0, (torch.arange(12) > 2) & (torch.arange(12) < 7)])[None]
    unit = torch.full((1,), 0.05).double()
    assert ((beyond_reach(points, members, unit) > 0.1) & (beyond_reach(points, members, unit) < 2.9)).any()
    assert torch.autograd.gradcheck(lambda of: beyond_reach(of, members, unit), (points,))


# --- in the model -------------------------------------------------------------------------------------------------------------


def begun() -> tuple[ScanPairBatch, Start, Tensor]:
    """A scene, its start with reaches of all sizes, and them."""
    batch, _ = scene(40)
    reach = (4 * torch.rand(1, 40, C, generator=generator(2), dtype=torch.float64) - 2).clamp(min=0)
    reach[..., 0] = 0
    return batch, replace(make_start(batch, MOTIONS), reach=reach), reach


def layer(mode: str, weight: float = 0.0, variant: str = "sweep") -> JointScanCRF:
    """An unfitted model; weight: of the feature that soft reaches have."""
    coupling, schedule = ("lattice", "sweep") if variant == "lattice" else ("motions", variant)
    inference = InferenceConfig(clusters=C + 1, iterations=2, stop_early=False, backend="eager", schedule=schedule)
    config = ModelConfig(features=FeatureConfig(reach=mode), inference=inference, coupling=coupling)
    model = JointScanCRF(config).double().requires_grad_(False)
    if mode == "soft":
        model.clustering_weights["reach"].fill_(weight)
    return model


def answer(mode: str, weight: float = 0.0, variant: str = "sweep", *, blind: bool = False) -> Prediction:
    batch, start, _ = begun()
    return layer(mode, weight, variant)(batch, replace(start, reach=None) if blind else start)


@pytest.mark.parametrize("variant", VARIANTS)
def test_hard_rules_out_what_is_beyond_and_nothing_else(variant: str) -> None:
    _, _, reach = begun()
    found = answer("hard", variant=variant)
    is_ruled_out = found.log_cluster[..., :C] == -torch.inf
    assert found.active[0, 1:].any()
    assert is_ruled_out[reach > 0].all()
    assert not is_ruled_out[(reach == 0) & found.active[:, None]].any()


def test_off_and_a_weight_of_nothing_are_blind() -> None:
    expected = answer("hard", blind=True)
    for found in (answer("off"), answer("soft"), answer("soft", 5.0, blind=True)):
        assert torch.equal(found.log_cluster, expected.log_cluster)
        assert torch.equal(found.log_association, expected.log_association)


def test_soft_is_hard_in_the_limit() -> None:
    hard, soft = answer("hard"), answer("soft", 1e9)
    assert torch.equal(soft.cluster, hard.cluster)
    assert (soft.log_cluster > -torch.inf).all()
    assert not torch.equal(answer("off").cluster, hard.cluster)


def is_beyond(cluster: Tensor, reach: Tensor) -> Tensor:
    """(B, N) points that are beyond the reach of their own cluster; an outlier is not, as the background reaches everything."""
    return reach.gather(-1, cluster.clamp(min=0)[..., None])[..., 0] > 0


@pytest.mark.parametrize("variant", VARIANTS)
def test_a_point_beyond_a_movers_reach_is_not_given_to_it(variant: str) -> None:
    _, _, reach = begun()
    assert is_beyond(answer("off", variant=variant).cluster, reach).any()
    for found in (answer("hard", variant=variant), answer("soft", 1e9, variant)):
        assert not is_beyond(found.cluster, reach).any()
        assert (found.cluster > 0).any()


def test_no_point_begins_in_a_mover_beyond_its_reach() -> None:
    batch, start, reach = begun()
    model = layer("hard")
    hard, off = (first_state(PairView.of(batch, reach=mode), start, model.config.inference) for mode in ("hard", "off"))
    assert is_beyond(off.cluster, reach).any()
    assert not is_beyond(hard.cluster, reach).any()
    is_within = ~is_beyond(off.cluster, reach)
    assert torch.equal(hard.cluster[is_within], off.cluster[is_within])
    assert torch.equal(hard.log_cluster.argmax(-1), hard.cluster % (C + 1))  # -1, the outlier, is the last state


@pytest.mark.parametrize("backend", ["eager", "auto"])
def test_a_mover_beyond_whose_reach_all_points_are_explains_none(backend: str) -> None:
    """By its motion alone it would explain many. The evidence decides which movers the rounds begin with."""
    batch, start, _ = begun()
    reach = torch.zeros(1, 40, C, dtype=torch.float64)
    reach[..., 2] = FARTHEST
    start = replace(start, reach=reach, log_odds=torch.tensor([[torch.inf, 0.0, 0.0]], dtype=torch.float64))

    def explained(mode: str, weight: float = 0.0) -> list[float]:
        model, view = layer(mode, weight), PairView.of(batch, reach=mode)
        config = replace(model.config.inference, backend=backend)
        state = first_state(view, start, config)
        return [float(of) for of in evidence(view, start, state, model.fitted, config)[0]]

    hard, soft, off = explained("hard"), explained("soft", 1e9), explained("off")
    assert hard[1] > 1
    assert hard[2] == 0
    assert off[2] > 1
    assert soft == pytest.approx(hard, abs=1e-6)


def test_a_saved_model_without_the_setting_is_hard(tmp_path: Path) -> None:
    JointScanCRF(ModelConfig(features=FeatureConfig(reach="hard"))).save_pretrained(tmp_path)
    file = tmp_path / "config.json"
    values = json.loads(file.read_text())
    assert values["features"].pop("reach") == "hard"
    file.write_text(json.dumps(values))
    model = JointScanCRF.from_pretrained(tmp_path)
    assert model.config.features.reach == "hard"
    assert "reach" not in model.clustering_weights
    soft = JointScanCRF.from_pretrained(tmp_path, features={"reach": "soft"})
    assert soft.clustering_weights["reach"] == 0
    assert torch.equal(soft.weight_vectors[1], model.weight_vectors[1])
