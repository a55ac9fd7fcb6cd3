"""`experiment`: the whole of it on four small pairs, and ablations."""

import contextlib
import csv
import io
import itertools
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from command_line import fail, run
from matplotlib.figure import Figure
from support import events_of

from torchcrf_scan.baselines.register import BASELINES, installed
from torchcrf_scan.experiment import cross_validation, experiment
from torchcrf_scan.experiment.methods import METHODS
from torchcrf_scan.experiment.models import ENCODED, EXACT, JOINT, LATTICE, LATTICE_EXACT
from torchcrf_scan.learning.run_log import RunLog

PROTOCOLS = ("leave_one_pair_out", "leave_one_sequence_out")
TABLES = {PROTOCOLS[0]: 10, PROTOCOLS[1]: 11}  # the second has differences of the exact model too
SMALL = (
    *("--model.features.stumps=4", "--model.inference.iterations=2", "--learning.folds=2", "--learning.max_steps=5"),
    *("--learning.booster_examples=500", "--experiment.jobs=1", "--experiment.resamples=50", "--experiment.test_every=2"),
)


def draw_once(patch: pytest.MonkeyPatch, at_first: int = 1) -> None:
    """Drawing takes time: the first figure of each kind is a real one, as a file; the others are blank."""
    log = RunLog.figure
    patch.setattr(RunLog, "figure", lambda run, tag, figure: log(run, tag, Figure((0.2, 0.2))))
    for name in ("plot_associations", "plot_association_sequence", "plot_cluster_sequence"):
        real, drawn = getattr(experiment, name), itertools.count()

        def draw(*what: object, real: Callable[..., Figure] = real, drawn: Iterator[int] = drawn) -> Figure:
            return real(*what) if next(drawn) < at_first else Figure((0.2, 0.2))

        patch.setattr(experiment, name, draw)


@pytest.fixture(scope="module")
def done(pairs_dir: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    """The run folder of the whole experiment, and what was printed."""
    folder = tmp_path_factory.mktemp("experiment") / "run"
    with pytest.MonkeyPatch.context() as patch, contextlib.redirect_stdout(io.StringIO()) as printed:
        draw_once(patch)
        assert run("experiment", "--experiment.pairs", pairs_dir, "--output", folder, *SMALL) == 0
    return folder, printed.getvalue()


def test_every_method_is_in_every_table(done: tuple[Path, str]) -> None:
    folder, printed = done
    absent = {ENCODED, *BASELINES} - {*installed()}
    for protocol in PROTOCOLS:
        text = (folder / "tables" / f"{protocol}.md").read_text()
        assert text.strip().split("\n\n")[-1] in printed
        rows = [
            name
            for name in METHODS
            if name not in absent and (protocol == PROTOCOLS[1] or name not in (EXACT, LATTICE, LATTICE_EXACT))
        ]
        files = sorted((folder / "tables").glob(f"{protocol}_*.csv"))
        assert len(files) == TABLES[protocol], [path.name for path in files]
        for path in files:
            with path.open(newline="") as file:
                found = [row[0] for row in csv.reader(file)][1:]
            if "by_sequence" in path.name:
                assert {*found} == {"sim3_0", "sim3_1"}, path
                continue
            assert found == rows or ("minus" in path.name and {*found} in ({*rows} - {JOINT}, {*rows} - {EXACT})), path
            assert all(f"| {name} |" in text for name in found)


def test_figures_and_events_are_there(done: tuple[Path, str]) -> None:
    folder, printed = done
    assert f"tables, figures and predictions: {folder}" in printed
    for protocol in PROTOCOLS:
        pictures = {path.name for path in (folder / "figures" / protocol).iterdir()}
        assert {f"{kind}_sim_s{s}_000.png" for kind in ("associations", "clusters") for s in (0, 1)} <= pictures
    tags = events_of(folder / "events").Tags()
    assert {f"{protocol}/associations/sim_s0_000" for protocol in PROTOCOLS} <= {*tags["images"]}
    assert {f"{protocol}/text_summary" for protocol in PROTOCOLS} <= {*tags["tensors"]}


def test_a_second_run_does_nothing_anew(
    done: tuple[Path, str], pairs_dir: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    folder, _ = done
    before = {path: path.stat().st_mtime_ns for path in (folder / "folds").rglob("*")}
    tables = {path: path.read_bytes() for path in (folder / "tables").iterdir()}
    draw_once(monkeypatch, at_first=0)
    monkeypatch.setattr(cross_validation, "fit_models", lambda *_: pytest.fail("fitted again"))
    assert run("experiment", "--experiment.pairs", pairs_dir, "--output", folder, *SMALL) == 0
    capsys.readouterr()
    assert {path: path.stat().st_mtime_ns for path in (folder / "folds").rglob("*")} == before
    assert {path: path.read_bytes() for path in (folder / "tables").iterdir()} == tables
    message = fail(capsys, "experiment", "--experiment.pairs", pairs_dir, "--output", folder, *SMALL, "--learning.seed=3")
    assert f"--output {folder}: expected the folder of the same experiment, got one with another learning.seed" in message


def test_ablations_print_one_table(pairs_dir: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    variants = tmp_path / "variants"
    variants.mkdir()
    (variants / "point.yaml").write_text("# Kabsch.\nmodel: {inference: {motion_metric: point}}\n")
    (variants / "without.yaml").write_text("# No boosting.\nexperiment: {leave_out: [association.data_boosting]}\n")
    options = ["--experiment.pairs", pairs_dir, "--output", tmp_path / "run", "--ablations", variants, *SMALL]
    assert run("experiment", *options) == 0
    out = capsys.readouterr().out
    assert out.count("**Ablations**") == 1
    rows = [line.split(" | ")[0].removeprefix("| ") for line in out.splitlines() if line.startswith("| ")]
    assert rows == ["variant", "---", "as configured", "point", "without association.data_boosting"]
    assert (tmp_path / "run" / "tables" / "ablations.md").read_text().strip() in out
    assert (tmp_path / "run" / "tables" / "ablations_ablations.csv").is_file()


@pytest.mark.parametrize(
    ("content", "reason"),
    [
        ("model: {inference: {speed: 3}}", "speed"),
        ("model: {inference: {clusters: many}}", "clusters"),
        ("model: {inference: {clusters: 1}}", "clusters: expected a whole number in [2, 32], got 1"),
        ("model: {features: {left_out: [association.dist2]}}", "left_out: expected one of"),
        ("model: [", "model"),
        ("just words", ""),
        ("- a\n- list", ""),
        ("3", ""),
    ],
)
def test_a_bad_variant_is_one_line(
    content: str, reason: str, pairs_dir: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "a_good.yaml").write_text("# Fewer.\nmodel: {inference: {candidates: 4}}\n")
    (tmp_path / "bad.yaml").write_text(content)
    message = fail(capsys, "experiment", "--experiment.pairs", pairs_dir, "--output", tmp_path / "out", "--ablations", tmp_path)
    assert str(tmp_path / "bad.yaml") in message
    assert reason in message
    assert not (tmp_path / "out").exists()


def test_bad_folders_and_pairs_are_one_line(pairs_dir: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    def message(*options: object) -> str:
        return fail(capsys, "experiment", "--output", tmp_path / "out", *options)

    assert f"--ablations {tmp_path}: expected a folder of .yaml files, got none" in message("--ablations", tmp_path)
    assert "nowhere" in message("--experiment.pairs", tmp_path / "nowhere")
    one = next(pairs_dir.glob("*.npz"))
    assert "leave_one_pair_out: expected at least 2 to leave out" in message("--experiment.pairs", one)
    assert "experiment.figures: expected" in message("--experiment.pairs", pairs_dir, "--experiment.figures=[moon:1]")
    assert not (tmp_path / "out").exists()
    (tmp_path / "file").touch()
    assert "file" in fail(capsys, "experiment", "--output", tmp_path / "file" / "run", "--experiment.pairs", pairs_dir)
