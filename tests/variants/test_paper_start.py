"""The starts without a search, from the association chain alone (`paper`, `points`): what they find, also where there is little."""

from collections.abc import Callable
from dataclasses import replace

import pytest
import torch
from scenes import CASES, assert_sane, poor_scene
from support import assert_close, make_points, normal

from torchcrf_scan.batch import ScanPairBatch
from torchcrf_scan.config import InferenceConfig, ModelConfig
from torchcrf_scan.data.simulate import simulate_pairs
from torchcrf_scan.data.worlds import SimulatorConfig
from torchcrf_scan.features.potentials import PairView
from torchcrf_scan.geometry import se2
from torchcrf_scan.inference.start import FARTHEST, Start
from torchcrf_scan.model import JointScanCRF
from torchcrf_scan.names import LOCAL_CHANNELS, SHAPE_CHANNELS
from torchcrf_scan.variants.paper_start import EXPLAINED, agreed_motion, match_cold, paper_start
from torchcrf_scan.variants.points_start import cluster_by_point, points_start

CONFIG = InferenceConfig(clusters=5)
Look = Callable[..., Start]
LOOKS: dict[str, Look] = {"paper": paper_start, "points": points_start}
TRUE = torch.tensor([[0.06, -0.7, 0.2], [-0.04, 0.5, -0.3]], dtype=torch.float64)


@pytest.fixture(scope="module")
def batch() -> ScanPairBatch:
    """Two simulated scans, and what the same points look like after the sensor has moved."""
    pairs = simulate_pairs(SimulatorConfig(beams=91, clutter=0.0), 2, 2, 5)
    batch = ScanPairBatch.collate(pairs, torch.float64).without_truth()
    target = se2.apply(TRUE, batch.source) + 0.003 * normal(*batch.source.shape)
    return replace(batch, target=target * batch.source_mask[..., None], target_mask=batch.source_mask)


@pytest.fixture(scope="module")
def model() -> JointScanCRF:
    """A model that looks at shapes, as fitted ones do."""
    model = JointScanCRF(ModelConfig(inference=CONFIG)).double()
    with torch.no_grad():
        for name in LOCAL_CHANNELS[:SHAPE_CHANNELS]:
            model.association_weights[name].fill_(0.5)
    return model


def nothing_known(batch: ScanPairBatch, clusters: int = 4) -> Start:
    """A start whose motions are nonsense: it is only looked at for its size and tangents."""
    B, N = batch.source.shape[:2]
    motions = torch.full((B, clusters, 3), 77.0).to(batch.source)
    active = torch.ones(B, clusters, dtype=torch.bool)
    return Start(motions, active, torch.zeros(B, N, dtype=torch.int64), torch.zeros_like(batch.target))


@pytest.fixture(scope="module", params=list(LOOKS))
def found(request: pytest.FixtureRequest, batch: ScanPairBatch, model: JointScanCRF) -> Start:
    return LOOKS[request.param](PairView.of(batch), nothing_known(batch), model.fitted, CONFIG)


def test_the_background_is_found_without_a_motion_to_begin_with(found: Start, batch: ScanPairBatch) -> None:
    turn, shift = se2.distance(found.motions[:, 0], TRUE)
    assert (turn < 0.002).all()
    assert (shift < 0.02).all()
    partner = torch.arange(batch.source.shape[1]).expand(2, -1)
    right = (found.association == partner) & batch.source_mask
    assert (right.sum(-1) / batch.source_mask.sum(-1) > 0.9).all()


def test_the_start_is_what_decoding_needs(found: Start, batch: ScanPairBatch) -> None:
    assert found.motions.shape == (2, 4, 3)
    assert found.motions.isfinite().all()
    assert found.active[:, 0].all()
    assert (found.association[~batch.source_mask] == -1).all()
    assert found.reach is not None
    assert (found.reach[..., 0] == 0).all()
    assert (found.reach.amin(1)[~found.active] == FARTHEST).all()  # empty slots, which are nowhere


@pytest.mark.parametrize("look", list(LOOKS.values()), ids=list(LOOKS))
def test_a_pair_is_started_as_if_alone(look: Look, batch: ScanPairBatch, model: JointScanCRF) -> None:
    together = look(PairView.of(batch), nothing_known(batch), model.fitted, CONFIG)
    for b in (0, 1):
        one = batch.select(torch.tensor([b]))
        alone = look(PairView.of(one), nothing_known(one), model.fitted, CONFIG)
        assert torch.equal(alone.association[0], together.association[b, : one.source.shape[1]])
        assert torch.equal(alone.active[0], together.active[b])
        assert_close(alone.motions[0], together.motions[b], tolerance=1e-6)


@pytest.mark.parametrize("chains", ["joint", "matching"])
@pytest.mark.parametrize("name", list(LOOKS))
def test_a_model_begins_there_in_any_unit(name: str, chains: str, batch: ScanPairBatch, model: JointScanCRF) -> None:
    begins = JointScanCRF(ModelConfig(chains=chains, start=name, inference=CONFIG)).double()
    begins.load_state_dict(model.state_dict())
    assert begins.config.features.length_unit == "spacing"
    start = begins.initialise(batch)
    assert start.motions.shape[1] == (1 if chains == "matching" else 4)
    turn, shift = se2.distance(start.motions[:, 0], TRUE)
    assert (turn < 0.01).all()
    assert (shift < 0.05).all()
    larger = begins.initialise(batch.scaled(torch.tensor([3.0, 0.1]).to(batch.dt)))
    assert torch.equal(larger.association, start.association)
    assert_close(larger.motions, start.scaled(torch.tensor([3.0, 0.1]).to(batch.dt)).motions)


@pytest.mark.parametrize("look", list(LOOKS.values()), ids=list(LOOKS))
@pytest.mark.parametrize("case", CASES)
def test_scans_with_little_in_them_are_defined(case: str, look: Look) -> None:
    batch, start = poor_scene(case)
    model = JointScanCRF(ModelConfig(inference=CONFIG)).double()
    if case == "all outliers":  # nothing looks alike enough: the outlier wins everywhere
        with torch.no_grad():
            for name in ("dist1", "dist3", "pairwise_distance"):
                model.association_weights[name].fill_(100.0)
        far = 50 * batch.source
        batch = replace(batch, target=far[:, :6] * batch.target_mask[..., None])
    begun = look(PairView.of(batch), start, model.fitted, CONFIG)
    assert begun.motions.shape == start.motions.shape
    assert begun.motions.isfinite().all()
    assert begun.active[:, 0].all()
    assert (begun.association < batch.target_mask.sum(-1, keepdim=True)).all()
    assert (begun.association[~batch.source_mask] == -1).all()
    if case in ("all outliers", "empty source", "empty target"):
        assert (begun.association == -1).all()
        assert begun.active.sum() == 1
        assert_close(begun.motions, batch.initial_motion[:, None].expand_as(begun.motions))
    with torch.no_grad():
        assert_sane(model(batch, replace(begun, reach=None)), batch)


# --- parts --------------------------------------------------------------------------------------------------------------------


def test_the_agreed_motion_is_that_of_the_majority() -> None:
    source = make_points(40, 1)[None]
    true = torch.tensor([[0.2, 1.0, -0.5]]).double()
    target = se2.apply(true, source) + 0.02 * normal(1, 40, 2)
    batch = replace(poor_scene("duplicates")[0], source=source, target=target, source_mask=torch.ones(1, 40).bool())
    batch = replace(batch, target_mask=batch.source_mask)
    association = torch.arange(40)[None].clone()
    association[0, ::3] = association[0, ::3].flip(0)  # a third is wrong
    association[0, 1::7] = -1
    before = torch.full((1, 1, 3), 9.0).double()
    assert_close(agreed_motion(batch, before, association)[:, 0], true, tolerance=0.03)
    assert torch.equal(agreed_motion(batch, before, torch.full_like(association, -1)), before)
    assert torch.equal(before, torch.full_like(before, 9.0))
    assert EXPLAINED > 0.1


def test_the_odometry_is_where_the_cold_search_begins(batch: ScanPairBatch, model: JointScanCRF) -> None:
    nobody = replace(batch, source_mask=torch.zeros_like(batch.source_mask), initial_motion=3 * TRUE)
    background, association = match_cold(PairView.of(nobody), nothing_known(nobody), model.fitted, CONFIG)
    assert torch.equal(background, nobody.initial_motion)
    assert (association == -1).all()


def test_points_that_move_alike_are_one_cluster() -> None:
    n = 24
    source = make_points(n, 4)
    cluster = (torch.arange(n) >= 16).long()
    motions = torch.tensor([[0.05, 0.3, 0.1], [0.05, 2.0, -1.0]]).double()
    target = se2.apply(motions[cluster], source[:, None])[:, 0]
    batch, _ = poor_scene("duplicates")
    everything = torch.ones(1, n, dtype=torch.bool)
    batch = replace(batch, source=source[None], target=target[None], source_mask=everything, target_mask=everything)
    association = torch.arange(n)
    association[[3, 20]] = -1
    members = cluster_by_point(PairView.of(batch), 0, motions[0], association, JointScanCRF().double().fitted)
    assert members.shape == (2, n)
    assert members[0].tolist() == ((cluster == 0) & (association >= 0)).tolist()
    assert members[1].tolist() == ((cluster == 1) & (association >= 0)).tolist()
