"""What is written to the run folder, read back with TensorBoard's own reader."""

from pathlib import Path

import pytest
from matplotlib.figure import Figure
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from tensorboard.plugins.hparams import plugin_data_pb2

from torchcrf_scan.evaluation.table import Table
from torchcrf_scan.learning.run_log import RunLog


def read(folder: Path) -> EventAccumulator:
    events = EventAccumulator(str(folder / "events"), size_guidance={"tensors": 0, "images": 0, "scalars": 0})
    events.Reload()
    return events


def test_a_table_is_text_under_its_title(tmp_path: Path) -> None:
    table = Table("Table I: data association", ("method", "accuracy (%)"), (("joint", 74.1), ("ICP", float("nan"))))
    with RunLog(tmp_path) as log:
        log.table(table)
        log.table(table, step=3)
    events = read(tmp_path).Tensors("tables/Table I: data association/text_summary")
    assert [event.step for event in events] == [0, 3]
    assert events[0].tensor_proto.string_val[0].decode() == table.to_markdown()


def test_a_figure_is_an_event_and_no_file(tmp_path: Path) -> None:
    figure = Figure(figsize=(2.0, 1.0), dpi=50)
    figure.subplots().plot([0.0, 1.0])
    with RunLog(tmp_path) as log:
        log.figure("clusters/first pair", figure, step=2)
    (event,) = read(tmp_path).Images("clusters/first pair")
    assert (event.step, event.width, event.height) == (2, 100, 50)
    assert event.encoded_image_string.startswith(b"\x89PNG")
    assert list(tmp_path.rglob("*.png")) == []
    assert figure.axes, "the figure is still open"


def test_only_numbers_of_a_summary_are_scalars(tmp_path: Path) -> None:
    with RunLog(tmp_path) as log:
        log.metrics("joint", {"cluster_accuracy": 83.0, "target_distance": float("nan")}, step=1)
    events = read(tmp_path)
    assert events.Tags()["scalars"] == ["test/cluster_accuracy/joint"]
    assert events.Scalars("test/cluster_accuracy/joint")[0].value == pytest.approx(83.0)


def test_settings_of_a_staged_run_stand_beside_what_came_of_it(tmp_path: Path) -> None:
    with RunLog(tmp_path) as log:
        log.settings({"learning.prior": 10.0, "data.simulate_train": ("street",)}, {"cluster_accuracy": 83.0})
    events = read(tmp_path)
    data = events.SummaryMetadata("_hparams_/session_start_info").plugin_data.content
    settings = plugin_data_pb2.HParamsPluginData.FromString(data).session_start_info.hparams
    assert settings["learning.prior"].number_value == 10.0
    assert settings["data.simulate_train"].string_value == "('street',)"
    assert events.Scalars("final/cluster_accuracy")[0].value == pytest.approx(83.0)
