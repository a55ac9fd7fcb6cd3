"""What `run`, `odometry`, `track` and `play` make of logs, whole, damaged, long, many, and interrupted."""

import contextlib
import csv
import os
import signal
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from command_line import fail, run
from forked import run_ranks
from PIL import Image
from results import FakeStream, carmen_log

from torchcrf_scan.commands import recording
from torchcrf_scan.commands.outputs import Outputs
from torchcrf_scan.data.trajectory_file import read_trajectory
from torchcrf_scan.viz.movie import can_write_mp4

MOVIE = "movie.mp4" if can_write_mp4() else "movie.gif"
ALL = {"poses.tum", "tracks.csv", "summary.png", MOVIE}


@pytest.fixture
def stream(monkeypatch: pytest.MonkeyPatch) -> FakeStream:
    """The stream that the commands use."""
    fake = FakeStream()
    monkeypatch.setattr(recording.Options, "make_stream", lambda self: lambda: fake)
    return fake


@pytest.fixture
def log(tmp_path: Path) -> Path:
    return carmen_log(tmp_path / "room.log")


def names(folder: Path) -> set[str]:
    return {path.name for path in folder.iterdir()}


@pytest.mark.usefixtures("fast_start")
def test_run_writes_everything(stream: FakeStream, log: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run("run", log, "--output", tmp_path / "out", "--clean") == 0
    assert names(tmp_path / "out") == ALL | {"clean.log"}
    path = read_trajectory(tmp_path / "out" / "poses.tum")
    np.testing.assert_allclose(path.stamps, 100 + 0.1 * np.arange(30))
    np.testing.assert_allclose(path.poses[:, 1], 0.1 * np.arange(1, 31))
    rows = list(csv.DictReader((tmp_path / "out" / "tracks.csv").read_text().splitlines()))
    assert len(rows) == 30
    assert (rows[0]["id"], float(rows[0]["vy"])) == ("1", 1.0)
    with Image.open(tmp_path / "out" / "summary.png") as picture:
        assert picture.width > 1000
    told = capsys.readouterr().out
    assert told.startswith(f"{log}: 30 scans, 2.9 s, 2.9 m travelled, 1 moving object; ok 100.0 %; ")
    assert told.endswith(f"; in {tmp_path / 'out'}\n")


@pytest.mark.usefixtures("fast_start")
@pytest.mark.parametrize(
    ("command", "name"), [("odometry", "poses.tum"), ("track", "tracks.csv"), ("play", "movie.gif"), ("play", "movie.mp4")]
)
def test_each_alone(stream: FakeStream, log: Path, tmp_path: Path, command: str, name: str) -> None:
    if name == "movie.mp4" and not can_write_mp4():
        pytest.skip("the library imageio-ffmpeg is not installed (extra `movie`)")
    assert run(command, log, "--output", tmp_path / "new" / name, "--end", "1") == 0
    assert names(tmp_path / "new") == {name}
    assert (tmp_path / "new" / name).stat().st_size > 500
    assert stream.fed == 11


@pytest.mark.parametrize(
    ("options", "expected"),
    [([], 30), (["--every", "4"], 8), (["--start", "1"], 20), (["--end", "0.55"], 6), (["--start=1", "--end=2", "--every=2"], 6)],
)
def test_scans_are_chosen(stream: FakeStream, log: Path, tmp_path: Path, options: list[str], expected: int) -> None:
    assert run("odometry", log, "--output", tmp_path / "a.tum", *options) == 0
    assert len(read_trajectory(tmp_path / "a.tum")) == expected


def test_odometry_is_used_when_asked_for(stream: FakeStream, log: Path, tmp_path: Path) -> None:
    assert run("odometry", log, "--output", tmp_path / "a.tum", "--end=0.2") == 0
    assert stream.odometry == [None] * 3
    assert run("odometry", "--use_odometry", log, "--output", tmp_path / "a.tum", "--end=0.2") == 0
    np.testing.assert_allclose(np.array(stream.odometry[3:])[:, 1], [0.1, 0.2, 0.3])


@pytest.mark.usefixtures("fast_start")
def test_what_comes_before_a_fault_is_written(stream: FakeStream, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    log = carmen_log(tmp_path / "cut.log", fault=True)
    assert run("run", log, "--output", tmp_path / "out", "--clean") == 1
    out, err = capsys.readouterr()
    assert "30 scans" in out
    assert err.startswith(f"torchcrf-scan run: error: {log}, line 34 (byte ")
    assert err.count("\n") == 1
    assert names(tmp_path / "out") == ALL | {"clean.log"}
    assert len(read_trajectory(tmp_path / "out" / "poses.tum")) == 30
    assert (tmp_path / "out" / "clean.log").read_text().count("FLASER 60") == 30


@pytest.mark.usefixtures("fast_start")
def test_a_bad_scan_is_left_out_and_counted(
    stream: FakeStream, log: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    stream.bad = (3, 7)
    assert run("run", log, "--output", tmp_path / "out", "--clean") == 0
    assert "28 scans" in (told := capsys.readouterr().out)
    assert "2 scans or messages left out, the first because of scan 3 is bad" in told
    assert len(read_trajectory(tmp_path / "out" / "poses.tum")) == 28
    assert (tmp_path / "out" / "clean.log").read_text().count("FLASER") == 28


@pytest.mark.usefixtures("fast_start")
def test_a_malformed_line_is_left_out_and_counted(
    stream: FakeStream, log: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    lines = log.read_text().splitlines(keepends=True)
    log.write_text("".join([*lines[:-5], "FLASER 60 1 two 3\n", *lines[-5:]]))
    assert run("run", log, "--output", tmp_path / "out", "--clean") == 0
    out, err = capsys.readouterr()
    assert "30 scans, " in out
    assert f"1 scan or message left out, because of {log}, line {len(lines) - 4} (byte " in out
    assert err == ""
    assert (tmp_path / "out" / "clean.log").read_text().count("FLASER") == 30


@pytest.mark.usefixtures("fast_start")
def test_several_logs_have_folders_and_a_bad_one_stops_no_other(
    stream: FakeStream, log: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "bad.log").write_text("no scans here\n")
    other = carmen_log(tmp_path / "hall.log", 5)
    assert run("run", log, tmp_path / "bad.log", other, "--output", tmp_path / "out") == 1
    assert names(tmp_path / "out") == {"room", "hall"}
    assert names(tmp_path / "out" / "hall") == names(tmp_path / "out" / "room") == ALL
    assert capsys.readouterr().err.count("\n") == 1


@pytest.mark.usefixtures("stream")
def test_bad_input_is_one_line_and_leaves_nothing(log: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "out" / "x.tum"
    assert "nowhere" in fail(capsys, "odometry", tmp_path / "nowhere.log", "--output", out)
    assert "--every: expected at least 1, got 0" in fail(capsys, "odometry", log, "--output", out, "--every=0")
    assert "--end: expected more" in fail(capsys, "track", log, "--output", out, "--start=3", "--end=2")
    assert "--start: expected" in fail(capsys, "track", log, "--output", out, "--start=-1")
    assert "expected scans in the chosen time" in fail(capsys, "odometry", log, "--output", out, "--start=100")
    assert ".mp4 or .gif" in fail(capsys, "play", log, "--output", tmp_path / "a.avi")
    assert "--speed" in fail(capsys, "play", log, "--output", tmp_path / "a.gif", "--speed=0")
    assert "names differ" in fail(capsys, "run", log, log, "--output", tmp_path / "out")
    assert "--clean" in fail(capsys, "run", log, "--output", tmp_path / "out", "--clean", "--every=2")
    assert "--rerun" in fail(capsys, "run", log, tmp_path / "b.log", "--output", tmp_path / "out", "--rerun=a.rrd")
    assert not list(tmp_path.glob("out/*"))


@pytest.mark.usefixtures("fast_start")
def test_an_output_that_fails_is_given_up_and_the_others_go_on(
    stream: FakeStream, log: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "out" / "tracks.csv" / "in_the_way").mkdir(parents=True)
    assert run("run", log, "--output", tmp_path / "out") == 1
    assert "tracks.csv" in capsys.readouterr().err
    assert names(tmp_path / "out") == ALL
    assert len(read_trajectory(tmp_path / "out" / "poses.tum")) == 30


def test_a_failing_output_is_closed_once() -> None:
    ended: list[Any] = []

    class Bad:
        def __enter__(self) -> Any:
            return self.add

        def add(self, result: Any) -> None:
            raise OSError("disk full")

        def __exit__(self, kind: Any, error: Any, trace: Any) -> None:
            ended.append(kind)

    failures: list[str] = []
    with Outputs({"bad": Bad()}, failures) as add:  # type: ignore[dict-item]
        add(None)  # type: ignore[arg-type]
        add(None)  # type: ignore[arg-type]
    assert failures == ["bad: disk full"]
    assert ended == [OSError]


@pytest.mark.usefixtures("fast_start")
@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_ctrl_c_and_termination_leave_what_was_written_valid(
    number: signal.Signals, code: int, stream: FakeStream, log: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    feed = FakeStream.feed

    def interrupting(self: FakeStream, *arguments: Any) -> Any:
        if self.fed == 8:
            os.kill(os.getpid(), number)
        return feed(self, *arguments)

    monkeypatch.setattr(FakeStream, "feed", interrupting)
    before = signal.getsignal(number)
    assert run("run", log, "--output", tmp_path / "out", "--clean") == code
    assert signal.getsignal(number) is before
    assert names(tmp_path / "out") == ALL | {"clean.log"}
    assert len(read_trajectory(tmp_path / "out" / "poses.tum")) == 9
    assert (tmp_path / "out" / "clean.log").read_text().count("FLASER") == 9


def test_a_file_for_the_viewer_beside_the_rest(stream: FakeStream, log: Path, tmp_path: Path) -> None:
    pytest.importorskip("rerun", reason="the library rerun-sdk is not installed (extra `viewer`)")
    assert run("odometry", log, "--output", tmp_path / "a.tum", "--rerun", tmp_path / "a.rrd") == 0
    assert (tmp_path / "a.rrd").stat().st_size > 5000


def test_the_real_stream_finds_the_way_along_a_room(tmp_path: Path) -> None:
    log = carmen_log(tmp_path / "room.log", 6)
    assert run("odometry", log, "--output", tmp_path / "a.tum", "--threads=1") == 0
    path = read_trajectory(tmp_path / "a.tum")
    np.testing.assert_allclose(path.poses[:, 1], 0.1 * np.arange(6), atol=0.03)


def run_rank(folder: Path, arguments: list[str]) -> None:
    """A process of `torchrun` that makes every output itself, its errors in a file of its own."""
    sys.modules["torchcrf_scan.commands.run"].Apart = lambda output, *given: output(*given)  # type: ignore[attr-defined]
    with (folder / f"errors_{os.environ['RANK']}").open("w") as errors, contextlib.redirect_stderr(errors):
        code = run(*arguments)
    sys.exit(code)


def test_torchrun_deals_logs_out(tmp_path: Path) -> None:
    logs = [carmen_log(tmp_path / f"{name}.log", 3) for name in "ab"]
    (tmp_path / "c.log").write_text("nothing\n")
    arguments = ["run", *map(str, logs), str(tmp_path / "c.log"), "--output", str(tmp_path / "out"), "--threads=1"]
    assert run_ranks(run_rank, tmp_path, arguments) == [1, 1]
    assert names(tmp_path / "out") == {"a", "b"}
    assert all(names(tmp_path / "out" / name) == ALL for name in "ab")
    first, second = ((tmp_path / f"errors_{rank}").read_text() for rank in "01")
    assert first.count("torchcrf-scan run: error: ") == 1
    assert second == ""


def test_the_distance_of_outliers_is_an_option(log_file: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run("odometry", log_file, "--output", tmp_path / "a.tum", "--model=simulated", "--outlier_distance=0.3") == 0
    capsys.readouterr()
    message = fail(capsys, "odometry", log_file, "--output", tmp_path / "b.tum", "--outlier_distance=-1")
    assert "--outlier_distance: expected nothing or a finite number above 0, got -1.0" in message
