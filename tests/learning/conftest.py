"""A study of six small pairs and the models of one of its folds, made once for all tests of the experiment."""

from collections.abc import Iterator

import pytest
from matplotlib.figure import Figure
from tensorboard.summary.writer import event_file_writer
from torch.utils.tensorboard import SummaryWriter

from torchcrf_scan.config import FeatureConfig, InferenceConfig, ModelConfig
from torchcrf_scan.data.simulate import simulate_pairs
from torchcrf_scan.data.worlds import SimulatorConfig
from torchcrf_scan.experiment.models import Models, fit_models
from torchcrf_scan.experiment.settings import ExperimentConfig, RunConfig
from torchcrf_scan.experiment.study import Study
from torchcrf_scan.learning.settings import LearningConfig
from torchcrf_scan.scan import ScanPair


@pytest.fixture
def event_files_in_order(monkeypatch: pytest.MonkeyPatch) -> None:
    """Writers of one second sort by a counter of the process, read as text: 10 comes before 9, so it begins at 0."""
    monkeypatch.setattr(event_file_writer, "_global_uid", event_file_writer.AtomicCounter(0))


@pytest.fixture(scope="session")
def small_config() -> RunConfig:
    """So little of everything that a fold takes a second."""
    return RunConfig(
        model=ModelConfig(features=FeatureConfig(stumps=4), inference=InferenceConfig(clusters=5, iterations=4)),
        learning=LearningConfig(folds=2, max_steps=8, booster_examples=500, batch_size=2),
        experiment=ExperimentConfig(jobs=1, resamples=50),
    )


@pytest.fixture(scope="session")
def small_pairs() -> list[ScanPair]:
    """Six pairs of three sequences."""
    return simulate_pairs(SimulatorConfig(beams=61), 6, 3, 3)


@pytest.fixture(scope="session")
def study(small_pairs: list[ScanPair], small_config: RunConfig) -> Study:
    return Study.of(small_pairs, small_config, jobs=1)


@pytest.fixture(scope="session")
def models(study: Study, small_config: RunConfig) -> Models:
    """Fitted on the first four pairs."""
    return fit_models(study, range(4), small_config, variants=True)


@pytest.fixture(scope="module")
def drawn_once() -> Iterator[None]:
    """Drawing takes time: of the figures of one name the first is drawn for TensorBoard, the others are blank."""
    drawn: set[str] = set()
    real = SummaryWriter.add_figure

    def add(writer: SummaryWriter, tag: str, figure: Figure, step: int, close: bool) -> None:
        real(writer, tag, Figure((0.2, 0.2)) if tag in drawn else figure, step, close)
        drawn.add(tag)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(SummaryWriter, "add_figure", add)
        yield
