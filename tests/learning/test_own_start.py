"""The paper's start with fitted weights: found under real motion, and what the model that uses it is trained on."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from torch import Tensor

from torchcrf_scan.batch import ScanPairBatch
from torchcrf_scan.config import FeatureConfig, InferenceConfig, ModelConfig
from torchcrf_scan.data.simulate import simulate_pairs
from torchcrf_scan.data.worlds import SimulatorConfig
from torchcrf_scan.experiment.models import JOINT, features_key, fit_models
from torchcrf_scan.experiment.settings import RunConfig
from torchcrf_scan.experiment.study import Study
from torchcrf_scan.features.potentials import Boosters
from torchcrf_scan.geometry import se2
from torchcrf_scan.inference.start import Start
from torchcrf_scan.inference.state import Parameters
from torchcrf_scan.learning import own_start, trainer
from torchcrf_scan.learning.fit import Margins, fit
from torchcrf_scan.learning.material import Material, collect
from torchcrf_scan.learning.objectives import start_of
from torchcrf_scan.learning.own_start import own_starts, start_anew
from torchcrf_scan.learning.portions import as_portion
from torchcrf_scan.learning.run_log import RunLog
from torchcrf_scan.learning.settings import Config, LearningConfig
from torchcrf_scan.learning.staged_watch import StagedWatch
from torchcrf_scan.model import JointScanCRF
from torchcrf_scan.search.score import HypothesisScore

LEARNING = LearningConfig(folds=2, negatives=5, batch_size=4)
PAPER = ModelConfig(
    start="paper",
    features=FeatureConfig(free_space=False, decisions=False, left_out=(), length_unit="metre", wrap_closed=False),
    inference=InferenceConfig(clusters=5, motion_metric="point", movers="threshold"),
)
SHARE = {"paper": 0.8, "points": 0.4}  # least share of right backgrounds
WORLD = SimulatorConfig(beams=181)


@pytest.fixture(scope="module")
def material() -> list[Material]:
    pairs = simulate_pairs(WORLD, 12, 4, 31)
    return collect(pairs, LEARNING).material(range(len(pairs)), HypothesisScore(), 4, LEARNING)


@pytest.fixture(scope="module")
def batch() -> ScanPairBatch:
    """Sixteen other pairs; the sensor moves by 0.15 to 1 m."""
    return ScanPairBatch.collate(simulate_pairs(WORLD, 16, 8, 32))


@pytest.fixture(scope="module", params=[True, False], ids=["raw channels", "boosted alone"])
def fitted(request: pytest.FixtureRequest, material: list[Material]) -> JointScanCRF:
    model = JointScanCRF(replace(PAPER, features=replace(PAPER.features, raw_channels=request.param)))
    fit(model, own_starts(model, material, LEARNING), LEARNING)
    return model


def travelled(start: Start, batch: ScanPairBatch) -> Tensor:
    """(B,) bool whether the background is right within 0.2 m."""
    assert batch.truth is not None
    return se2.distance(start.motions[:, 0], batch.truth.motions[:, 0])[1] < 0.2


@pytest.mark.parametrize("start", ["paper", "points"])
def test_fitted_weights_do_not_pull_the_background_to_standstill(start: str, fitted: JointScanCRF, batch: ScanPairBatch) -> None:
    few = batch[:8] if start == "points" else batch  # N^3
    assert few.truth is not None
    standstill = Start(few.initial_motion[:, None], torch.ones(len(few), 1).bool(), torch.zeros(0), torch.zeros(0))
    assert travelled(standstill, few).float().mean() < 0.3
    model = JointScanCRF(replace(fitted.config, start=start))
    model.load_state_dict(fitted.state_dict())
    assert travelled(model.initialise(few.without_truth()), few).float().mean() > SHARE[start]


@pytest.mark.parametrize("start", ["paper", "points"])
def test_training_starts_where_the_model_does(start: str, material: list[Material]) -> None:
    """Whatever motions the search has found, the model's own are trained on, and they are of boosters without the fold."""
    model, some = JointScanCRF(replace(PAPER, start=start)), material[::3]
    lied_to = [replace(part, start=replace(part.start, motions=part.start.motions + 5.0)) for part in some]
    begun = own_starts(model, lied_to, LEARNING)
    right = torch.cat([travelled(part.start, part.batch) for part in begun])
    assert right.float().mean() > SHARE[start]
    for one, other in zip(begun, own_starts(model, some, LEARNING), strict=True):
        assert torch.equal(one.start.motions, other.start.motions)
        assert one.start.log_odds is None  # no score of the search


def test_the_search_is_what_it_was(material: list[Material]) -> None:
    model = JointScanCRF(replace(PAPER, start="search"))
    assert own_starts(model, material, LEARNING) == start_anew(model, material, {}) == material


def test_every_fold_is_started_by_boosters_without_it(material: list[Material], monkeypatch: pytest.MonkeyPatch) -> None:
    used: list[Boosters] = []

    def begin(view: object, found: Start, parameters: Parameters, inference: object) -> Start:
        used.append(parameters.boosters)
        return found

    monkeypatch.setattr(own_start, "BEGINNINGS", {"paper": begin})
    own_starts(JointScanCRF(PAPER), material, LEARNING)
    tables = {part.fold: boosters.data.table for part, boosters in zip(material, used, strict=True)}
    assert len(tables) == 2
    assert not torch.equal(tables[0], tables[1])  # those of the model would be the same


def test_an_experiments_and_a_runs_models_are_trained_there(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pairs = simulate_pairs(SimulatorConfig(beams=91), 4, 2, 33)
    config = RunConfig(
        model=replace(PAPER, features=replace(PAPER.features, stumps=4)),
        learning=replace(LEARNING, max_steps=4, booster_examples=500),
    )
    study, trained = Study.of(pairs, replace(config, experiment=replace(config.experiment, joint_alone=True)), 1), []
    real = own_start.own_starts

    def watch(*given: object) -> list[Material]:
        trained.append(real(*given))  # type: ignore[arg-type]
        return trained[-1]

    def fit_on(model: JointScanCRF, parts: list[Material], *rest: object, **named: object) -> Margins:
        assert parts is trained[-1]
        return fit(model, parts, *rest, **named)  # type: ignore[arg-type]

    monkeypatch.setattr("torchcrf_scan.experiment.models.own_starts", watch)
    monkeypatch.setattr("torchcrf_scan.experiment.models.fit", fit_on)
    models = fit_models(study, range(3), replace(config, experiment=replace(config.experiment, joint_alone=True)), variants=False)
    assert models.joint[JOINT].config.start == "paper"
    searched = replace(config, model=replace(config.model, start="search"))
    assert features_key(study, range(3), config) != features_key(study, range(3), searched)
    monkeypatch.setattr(trainer, "own_starts", watch)
    monkeypatch.setattr(trainer, "fit", fit_on)
    with RunLog(tmp_path) as run:
        watched = StagedWatch(run)
        trainer.prepare(JointScanCRF(config.model), pairs, Config(model=config.model, learning=config.learning), watched, None)
    assert len(trained) == 2


def test_steps_of_first_order_start_there_too(fitted: JointScanCRF, batch: ScanPairBatch) -> None:
    pairs = simulate_pairs(WORLD, 2, 2, 34)
    portion = as_portion(pairs)
    assert len(portion.surveys) == 2
    assert torch.equal(start_of(fitted, portion).motions, fitted.initialise(portion.batch).motions)
    searching = JointScanCRF(replace(PAPER, start="search"))
    assert not torch.equal(start_of(searching, portion).motions, start_of(fitted, portion).motions)
