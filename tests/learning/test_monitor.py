"""What first-order training writes for TensorBoard, read back with TensorBoard's own reader."""

import re
from pathlib import Path

import numpy as np
import pytest
import small_run
import torch
from support import events_of
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from tensorboard.plugins.custom_scalar import layout_pb2
from tensorboard.plugins.hparams import plugin_data_pb2

from torchcrf_scan.learning import run_log
from torchcrf_scan.learning.checkpoint import Store
from torchcrf_scan.learning.gradient import train_by_gradient
from torchcrf_scan.learning.monitor import TrainingMonitor, belief_changes, boosted_margins, named_weights
from torchcrf_scan.learning.portions import as_portion
from torchcrf_scan.learning.ranks import ALONE
from torchcrf_scan.learning.run_log import GROUPS
from torchcrf_scan.learning.trainer import flatten, settings_of
from torchcrf_scan.learning.validation import BASELINE, RIVAL
from torchcrf_scan.model import JointScanCRF
from torchcrf_scan.names import LOCAL_CHANNELS


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory, drawn_once: None) -> Path:
    """Four steps, with a look at the validation pairs every two."""
    folder = tmp_path_factory.mktemp("run")
    config = small_run.small_config(objective="unrolled", steps=4, batch_size=2, graph=True)
    train, held_out = small_run.small_pairs()
    store = Store(folder, settings_of(config))
    model = JointScanCRF(config.model)
    with TrainingMonitor(folder, config) as monitor:
        train_by_gradient(model, config, train, held_out, store, ALONE, monitor)
        monitor.finished(flatten(config))
    return folder


@pytest.fixture(scope="module")
def events(run: Path) -> EventAccumulator:
    return events_of(run / "training")


def steps(events: EventAccumulator, tag: str) -> list[int]:
    return [event.step for event in events.Scalars(tag)]


def test_every_step_tells_losses_gradients_weights_and_speed(events: EventAccumulator) -> None:
    names = [f"loss/{name}" for name in ("total", "association", "cluster", "rotation", "translation")]
    names += [f"gradient/{name}" for name in ("norm", "association_weights", "clustering_weights")]
    names += ["schedule/learning_rate", "schedule/temperature", "throughput/pairs_per_second", "throughput/nodes_per_second"]
    names += [f"weights/{name}" for name in named_weights(JointScanCRF(small_run.small_config().model))]
    for name in names:
        assert steps(events, name) == [1, 2, 3, 4], name
    rates = [event.value for event in events.Scalars("schedule/learning_rate")]
    assert rates[0] < rates[1] < rates[2] == pytest.approx(0.05)
    assert {event.value for event in events.Scalars("schedule/temperature")} == {1.0}


def test_looks_tell_losses_and_figures_beside_the_baseline(events: EventAccumulator) -> None:
    assert steps(events, "validation/total") == [0, 2, 4]
    for group, name in (("accuracy", "cluster_accuracy"), ("motion", "ego_rotation_median"), ("calibration", "cluster_ece")):
        assert name in GROUPS[group]
        for method in ("joint", BASELINE, RIVAL):
            assert steps(events, f"{group}/{name}/{method}") == [0, 2, 4]
    constant = {event.value for event in events.Scalars(f"accuracy/association_accuracy/{BASELINE}")}
    assert len(constant) == 1  # it has nothing to learn


def test_histograms_of_margins_and_of_every_round(events: EventAccumulator) -> None:
    tags = set(events.Tags()["histograms"])
    assert {"margins/data, true pairs", "margins/data, wrong pairs", "margins/outlier, others"} <= tags
    assert {"residuals/round 1", "residuals/round 2"} <= tags
    assert [event.step for event in events.Histograms("residuals/round 1")] == [0, 2, 4]


def test_figures(events: EventAccumulator) -> None:
    for tag in ("pair/associations", "pair/clusters", "pair/confidence", "all/reliability", "all/moving points"):
        images = events.Images(tag)
        assert [image.step for image in images] == [0, 2, 4]
        assert images[0].encoded_image_string.startswith(b"\x89PNG")


def test_the_graph_is_drawn(events: EventAccumulator) -> None:
    nodes = events.Graph().node
    assert len(nodes) > 100
    assert any("association_weights" in node.name for node in nodes)


def test_joint_and_baselines_are_laid_out_in_one_chart(events: EventAccumulator) -> None:
    (event,) = events.Tensors("custom_scalars__config__")
    layout = layout_pb2.Layout.FromString(event.tensor_proto.string_val[0])
    charts = {chart.title: list(chart.multiline.tag) for category in layout.category for chart in category.chart}
    assert charts["ego_success"] == ["motion/ego_success/.*"]
    assert not {*charts} & {*run_log.LAYOUT["what one watches"]}  # TensorBoard merges both layouts
    watched = {name: patterns for name, (_, patterns) in run_log.LAYOUT["what one watches"].items()}
    lines = [tag for tag in events.Tags()["scalars"] if any(re.match(pattern, tag) for pattern in watched["cluster_accuracy"])]
    assert len(lines) == 3
    losses = [tag for tag in events.Tags()["scalars"] if any(re.match(pattern, tag) for pattern in watched["loss"])]
    assert sorted(losses) == ["loss/total", "validation/total"]


def test_settings_stand_beside_what_came_of_them(events: EventAccumulator) -> None:
    data = events.SummaryMetadata("_hparams_/session_start_info").plugin_data.content
    settings = plugin_data_pb2.HParamsPluginData.FromString(data).session_start_info.hparams
    assert settings["gradient.learning_rate"].number_value == pytest.approx(0.05)
    assert settings["gradient.objective"].string_value == "unrolled"
    content = events.SummaryMetadata("_hparams_/experiment").plugin_data.content
    tags = {metric.name.tag for metric in plugin_data_pb2.HParamsPluginData.FromString(content).experiment.metric_infos}
    assert {"validation/total", "accuracy/cluster_accuracy/joint"} <= tags <= {*events.Tags()["scalars"]}


def test_every_card_is_a_curve(events: EventAccumulator) -> None:
    assert all(len(events.Scalars(tag)) > 1 for tag in events.Tags()["scalars"])


def test_a_run_that_goes_on_hides_what_it_does_again(tmp_path: Path) -> None:
    config = small_run.small_config()
    for first_step, values in ((None, (1.0, 2.0, 3.0, 4.0)), (3, (30.0, 40.0))):
        with TrainingMonitor(tmp_path, config, first_step) as monitor:
            for step, value in enumerate(values, first_step or 1):
                monitor.writer.add_scalar("loss/total", value, step)
    events = events_of(tmp_path / "training").Scalars("loss/total")
    assert [(event.step, event.value) for event in events] == [(1, 1.0), (2, 2.0), (3, 30.0), (4, 40.0)]


def test_another_run_in_the_folder_hides_the_one_before(tmp_path: Path, event_files_in_order: None) -> None:
    for values in ((1.0, 2.0, 3.0), (10.0, 20.0)):
        with TrainingMonitor(tmp_path, small_run.small_config()) as monitor:
            for step, value in enumerate(values, 1):
                monitor.writer.add_scalar("loss/total", value, step)
    assert [event.value for event in events_of(tmp_path / "training").Scalars("loss/total")] == [10.0, 20.0]


def test_a_full_disk_ends_the_watching_and_not_the_training(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    config = small_run.small_config(steps=2)
    train, held_out = small_run.small_pairs()
    store = Store(tmp_path, settings_of(config))

    def refuse(*_: object) -> None:
        raise OSError(28, "No space left on device")

    with TrainingMonitor(tmp_path, config) as monitor:
        monkeypatch.setattr(monitor.writer, "add_scalar", refuse)
        learner = train_by_gradient(JointScanCRF(config.model), config, train, held_out, store, ALONE, monitor)
    assert learner.step == 2
    assert caplog.text.count("nothing more is written for TensorBoard") == 1


# --- what is shown ------------------------------------------------------------------------------------------------------------


def test_margins_are_those_of_the_boosters() -> None:
    model = JointScanCRF(small_run.small_config().model)
    feature, threshold = torch.tensor([LOCAL_CHANNELS.index("registered_translation")]), torch.tensor([-4.0])
    model.boosters.data.set_stumps(feature, threshold, torch.tensor([-2.0]), torch.tensor([3.0]))
    found = boosted_margins(model, as_portion(small_run.small_pairs()[0]).batch)
    for values in found.values():
        assert set(values.tolist()) <= {-2.0, 3.0, 0.0}
    assert found["margins/data, true pairs"].mean() > found["margins/data, wrong pairs"].mean()


def test_beliefs_that_have_settled_change_no_more() -> None:
    config = small_run.small_config().model
    model = JointScanCRF(config)
    portion = as_portion(small_run.small_pairs()[0][:2])
    start = model.initialise(portion.batch)
    changes = belief_changes(model, portion.batch, start)
    assert list(changes) == ["residuals/round 1", "residuals/round 2"]
    points = int(portion.batch.source_mask.sum())
    for values in changes.values():
        assert values.shape == (points,)
        assert bool((values >= 0).all() and (values <= 1).all())
    assert np.isfinite(changes["residuals/round 1"].numpy()).all()
