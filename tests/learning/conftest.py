"""A study of six small pairs and the models of one of its folds, made once for all tests of the experiment."""

from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager

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
from torchcrf_scan.learning import monitor, run_log
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


@contextmanager
def drawing_at_most(most: int) -> Iterator[None]:
    """Drawing takes most of the time of a small run: so many figures of a kind, and of a tag, are real; the others are blank."""
    made: Counter[str] = Counter()

    def sparingly(real: Callable[..., Figure], name: str, times: int) -> Callable[..., Figure]:
        def plot(*given: object) -> Figure:
            made[name] += 1
            return real(*given) if made[name] <= times else Figure((8.0, 6.0))

        return plot

    def add(writer: SummaryWriter, tag: str, figure: Figure, step: int, close: bool) -> None:
        made[tag] += 1
        draw(writer, tag, figure if made[tag] <= most else Figure((0.2, 0.2)), step, close)

    draw = SummaryWriter.add_figure
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(SummaryWriter, "add_figure", add)
        patch.setattr(run_log, "plot_pair", sparingly(run_log.plot_pair, "pair", 2 * most))  # for TensorBoard, and as a file
        for name in [name for name in vars(monitor) if name.startswith("plot_")]:
            patch.setattr(monitor, name, sparingly(getattr(monitor, name), name, most))
        yield


@pytest.fixture(scope="module")
def drawn_once() -> Iterator[None]:
    """The first figure of every kind is real."""
    with drawing_at_most(1):
        yield


@pytest.fixture(scope="module")
def undrawn() -> Iterator[None]:
    """All figures are blank."""
    with drawing_at_most(0):
        yield
