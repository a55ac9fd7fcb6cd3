"""What is written to the run folder, read back with TensorBoard's own reader."""

import errno
import threading
from pathlib import Path

import pytest
from matplotlib.figure import Figure
from support import events_of
from tensorboard.plugins.hparams import plugin_data_pb2

from torchcrf_scan.evaluation.table import Table
from torchcrf_scan.learning.run_log import WATCHED, RunLog, one_error


def test_tables_are_one_text(tmp_path: Path) -> None:
    table = Table("Table I: data association", ("method", "accuracy (%)"), (("joint", 74.1), ("ICP", float("nan"))))
    with RunLog(tmp_path) as log:
        log.tables("final", [table, table])
    (event,) = events_of(tmp_path / "events").Tensors("final/text_summary")
    assert event.tensor_proto.string_val[0].decode() == f"{table.to_markdown()}\n\n{table.to_markdown()}"


def test_another_run_in_the_folder_hides_the_one_before(tmp_path: Path, event_files_in_order: None) -> None:
    for values in ((1.0, 2.0, 3.0), (10.0, 20.0)):
        with RunLog(tmp_path) as log:
            for step, value in enumerate(values, 1):
                log.objective("joint/association", step, value, value)
    assert [event.value for event in events_of(tmp_path / "events").Scalars("objective/joint/association")] == [10.0, 20.0]


def test_a_figure_is_an_event_and_no_file(tmp_path: Path) -> None:
    figure = Figure(figsize=(2.0, 1.0), dpi=50)
    figure.subplots().plot([0.0, 1.0])
    with RunLog(tmp_path) as log:
        log.figure("clusters/first pair", figure, step=2)
    (event,) = events_of(tmp_path / "events").Images("clusters/first pair")
    assert (event.step, event.width, event.height) == (2, 100, 50)
    assert event.encoded_image_string.startswith(b"\x89PNG")
    assert list(tmp_path.rglob("*.png")) == []
    assert figure.axes, "the figure is still open"


def test_settings_of_a_staged_run_stand_beside_its_last_figures(tmp_path: Path) -> None:
    with RunLog(tmp_path) as log:
        log.curves(dict.fromkeys(WATCHED, 83.0), step=1)
        log.settings({"learning.prior": 10.0, "data.simulate_train": ("street",)}, ["accuracy/cluster_accuracy"])
    events = events_of(tmp_path / "events")
    data = events.SummaryMetadata("_hparams_/session_start_info").plugin_data.content
    settings = plugin_data_pb2.HParamsPluginData.FromString(data).session_start_info.hparams
    assert settings["learning.prior"].number_value == 10.0
    assert settings["data.simulate_train"].string_value == "('street',)"
    assert sorted(events.Tags()["scalars"]) == sorted(f"accuracy/{name}" for name in WATCHED)  # none but the curves


def test_a_full_disk_is_one_error_that_names_the_folder(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """TensorBoard's thread says nothing of it; a thread of somebody else still does."""

    def fail() -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    writer = type("Writer", (threading.Thread,), {"__module__": "tensorboard.summary.writer"})
    before = threading.excepthook
    with one_error(tmp_path / "run"):
        run_to_its_end(writer(target=fail))
    assert capsys.readouterr().err == ""
    with pytest.raises(OSError, match=r"No space left on device: '.*run'"), one_error(tmp_path / "run"):
        fail()
    assert threading.excepthook is before
    named = OSError(errno.ENOENT, "No such file or directory", "weights")
    with pytest.raises(OSError, match="'weights'"), one_error(tmp_path / "run"):
        raise named


@pytest.mark.filterwarnings("ignore::pytest.PytestUnhandledThreadExceptionWarning")
def test_other_threads_still_tell_their_errors(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    told: list[threading.ExceptHookArgs] = []
    monkeypatch.setattr(threading, "excepthook", told.append)

    def fail() -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    with one_error(tmp_path):
        run_to_its_end(threading.Thread(target=fail))
    assert len(told) == 1


def run_to_its_end(thread: threading.Thread) -> None:
    thread.start()
    thread.join()
