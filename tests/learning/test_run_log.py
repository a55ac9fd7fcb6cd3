"""What is written to the run folder, read back with TensorBoard's own reader."""

from pathlib import Path

from matplotlib.figure import Figure
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from tensorboard.plugins.hparams import plugin_data_pb2

from torchcrf_scan.evaluation.table import Table
from torchcrf_scan.learning.run_log import WATCHED, RunLog


def read(folder: Path) -> EventAccumulator:
    events = EventAccumulator(str(folder / "events"), size_guidance={"tensors": 0, "images": 0, "scalars": 0})
    events.Reload()
    return events


def test_tables_are_one_text(tmp_path: Path) -> None:
    table = Table("Table I: data association", ("method", "accuracy (%)"), (("joint", 74.1), ("ICP", float("nan"))))
    with RunLog(tmp_path) as log:
        log.tables("final", [table, table])
    (event,) = read(tmp_path).Tensors("final/text_summary")
    assert event.tensor_proto.string_val[0].decode() == f"{table.to_markdown()}\n\n{table.to_markdown()}"


def test_another_run_in_the_folder_hides_the_one_before(tmp_path: Path, event_files_in_order: None) -> None:
    for values in ((1.0, 2.0, 3.0), (10.0, 20.0)):
        with RunLog(tmp_path) as log:
            for step, value in enumerate(values, 1):
                log.objective("joint/association", step, value, value)
    assert [event.value for event in read(tmp_path).Scalars("objective/joint/association")] == [10.0, 20.0]


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


def test_settings_of_a_staged_run_stand_beside_its_last_figures(tmp_path: Path) -> None:
    with RunLog(tmp_path) as log:
        log.curves(dict.fromkeys(WATCHED, 83.0), step=1)
        log.settings({"learning.prior": 10.0, "data.simulate_train": ("street",)}, ["accuracy/cluster_accuracy"])
    events = read(tmp_path)
    data = events.SummaryMetadata("_hparams_/session_start_info").plugin_data.content
    settings = plugin_data_pb2.HParamsPluginData.FromString(data).session_start_info.hparams
    assert settings["learning.prior"].number_value == 10.0
    assert settings["data.simulate_train"].string_value == "('street',)"
    assert sorted(events.Tags()["scalars"]) == sorted(f"accuracy/{name}" for name in WATCHED)  # none but the curves
