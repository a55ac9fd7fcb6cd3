"""The command line as its users meet it: files in, files and text out, one clear line for every mistake."""

import importlib.util
import json
import subprocess
import sys
from dataclasses import fields, replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest

import torchcrf_scan
from torchcrf_scan import JointScanCRF, ModelConfig, PairPrediction, Scan, ScanPair, cli
from torchcrf_scan.config import SimulatorConfig
from torchcrf_scan.data.dataset import PairFiles
from torchcrf_scan.data.pair_file import read_pair, read_prediction, write_pair, write_prediction
from torchcrf_scan.evaluation.metrics import score_pair, summarise
from torchcrf_scan.viz import plots

SCORER = Path(__file__).resolve().parents[2] / "shared" / "tools" / "score.py"
ROOT = Path(__file__).resolve().parents[1]
COLUMNS = {  # of the scorer: key of `summarise`, factor
    "assoc": ("association_accuracy", 1.0),
    "assoc2": ("association_within_2", 1.0),
    "clus": ("cluster_accuracy", 1.0),
    "oP": ("association_precision", 1.0),
    "oR": ("association_recall", 1.0),
    "mvIoU": ("iou_moving", 1.0),
    "ok": ("ego_success", 1.0),
    "det": ("movers_found", 1.0),
    "obj_t": ("found_mover_centroid_median", 1.0),
}
SPREADS = {"ego_r": ("ego_rotation", 1e3), "ego_t": ("ego_translation", 1.0)}


@pytest.fixture(scope="module")
def pairs_dir(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Four simulated pairs of two sequences."""
    folder = tmp_path_factory.mktemp("simulated") / "pairs"
    assert cli.main(["simulate", "--output", str(folder), "--pairs=4", "--sequences=2", "--seed=3", "--simulator.beams=61"]) == 0
    return folder


@pytest.fixture(scope="module")
def model_dir(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("model")
    JointScanCRF(ModelConfig()).save_pretrained(folder)
    return folder


@pytest.fixture(scope="module")
def predictions_dir(pairs_dir: Path, model_dir: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The predictions of the four pairs."""
    folder = tmp_path_factory.mktemp("matched") / "predictions"
    assert cli.main(["match", str(pairs_dir), "--output", str(folder), "--model", str(model_dir), "--threads=1"]) == 0
    return folder


def run(*arguments: object) -> int:
    return cli.main([str(argument) for argument in arguments])


def fail(capsys: pytest.CaptureFixture[str], *arguments: object) -> str:
    """The one line on stderr of a command that exits with 1."""
    assert run(*arguments) == 1
    out, err = capsys.readouterr()
    assert err.count("\n") == 1, err
    assert err.startswith(f"torchcrf-scan {arguments[0]}: error: ")
    assert out == ""
    return err


def guess(pair: ScanPair, seed: int) -> PairPrediction:
    """The annotation with mistakes."""
    rng, truth = np.random.default_rng(seed), pair.annotation
    assert truth is not None
    association = np.where(rng.random(pair.source.n_beams) < 0.2, -1, truth.association)
    association[association >= 0] = np.clip(association[association >= 0] + rng.integers(-3, 4), 0, pair.target.n_beams - 1)
    cluster = np.where(rng.random(len(association)) < 0.15, rng.integers(-1, 3, len(association)), truth.cluster)
    motions = np.zeros((max(len(truth.motions), 3), 3))
    motions[: len(truth.motions)] = np.nan_to_num(truth.motions) + rng.normal(0, 0.03, truth.motions.shape)
    ones = np.ones(len(association))
    return PairPrediction(association, cluster, motions, ones, ones, True)


# --- the package --------------------------------------------------------------------------------------------------------------


def test_imports_stay_light() -> None:
    code = (
        "import sys, torchcrf_scan; heavy = 'matplotlib sklearn scipy tensorboard rosbags'.split();"
        "print([name for name in [*heavy, 'jsonargparse'] if name in sys.modules]);"
        "import torchcrf_scan.cli; print([name for name in heavy if name in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
    assert done.stdout == "[]\n[]\n"


def test_public_names_are_there() -> None:
    assert all(hasattr(torchcrf_scan, name) for name in torchcrf_scan.__all__)


# --- usage --------------------------------------------------------------------------------------------------------------------


def help_of(capsys: pytest.CaptureFixture[str], *command: str) -> str:
    with pytest.raises(SystemExit) as stop:
        run(*command, "--help")
    assert stop.value.code == 0
    return capsys.readouterr().out


def test_help_tells_every_option(capsys: pytest.CaptureFixture[str]) -> None:
    assert all(name in help_of(capsys) for name in cli.COMMANDS)
    simulate = help_of(capsys, "simulate")
    assert all(f"--simulator.{field.name}" in simulate for field in fields(SimulatorConfig))
    assert all(f"--{name}" in help_of(capsys, "match") for name in ("output", "model", "candidates", "device", "threads"))
    evaluate = help_of(capsys, "evaluate")
    assert all(f"--{name}" in evaluate for name in ("predictions", "method", "model", "json"))
    assert all(name in evaluate for name in cli.METHODS)
    assert all(f"--{name}" in help_of(capsys, "plot") for name in ("prediction", "model", "output"))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ([], "command"),
        (["fly"], "fly"),
        (["match", "a.npz"], "output"),
        (["match", "--output", "b"], "files"),
        (["match", "a.npz", "--output", "b", "--candidates", "many"], "candidates"),
        (["match", "a.npz", "--output", "b", "--speed", "3"], "--speed"),
        (["simulate", "--output", "b", "--simulator.beams", "1.5"], "simulator.beams"),
        (["simulate", "--output", "b", "--simulator.beamz", "5"], "simulator.beamz"),
        (["plot", "a.npz", "b.npz", "--output", "c.png"], "b.npz"),
    ],
)
def test_bad_usage_exits_with_2(arguments: list[str], message: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stop:
        run(*arguments)
    assert stop.value.code == 2
    assert message in capsys.readouterr().err


def test_a_closed_pipe_is_no_traceback(pairs_dir: Path) -> None:
    command = [sys.executable, "-m", "torchcrf_scan.cli", "evaluate", str(pairs_dir), "--method=static"]
    with subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        assert process.stderr is not None
        process.stdout.close()
        errors = process.stderr.read()
    assert process.returncode == 1
    assert errors == ""


# --- simulate -----------------------------------------------------------------------------------------------------------------


def contents(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir()}


def test_same_seed_same_bytes(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for name, seed in (("a", 1), ("b", 1), ("c", 2)):
        assert (
            run("simulate", "--output", tmp_path / name, "--pairs=2", "--sequences=1", f"--seed={seed}", "--simulator.beams=31")
            == 0
        )
    assert contents(tmp_path / "a") == contents(tmp_path / "b") != contents(tmp_path / "c")
    assert capsys.readouterr().out.startswith("2 pairs of 1 sequences in ")
    assert run("simulate", "--output", tmp_path / "c", "--pairs=2", "--sequences=1", "--seed=1", "--simulator.beams=31") == 0
    assert contents(tmp_path / "c") == contents(tmp_path / "a")


def test_simulator_options_arrive(tmp_path: Path) -> None:
    options = ["--pairs=1", "--sequences=1", "--simulator.beams=31", "--simulator.dt=0.5", "--simulator.range_max=30"]
    assert run("simulate", "--output", tmp_path, *options) == 0
    pair = PairFiles(tmp_path)[0]
    assert (pair.dt, pair.source.range_max) == (0.5, 30.0)
    assert len(pair.source) <= 31
    assert pair.annotation is not None


def test_simulate_never_mixes_with_other_files(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "mine.npz").write_bytes(b"precious")
    message = fail(capsys, "simulate", "--output", tmp_path, "--pairs=1", "--sequences=1", "--simulator.beams=11")
    assert "mine.npz" in message
    assert contents(tmp_path) == {"mine.npz": b"precious"}


@pytest.mark.parametrize(("option", "name"), [("--pairs=0", "pairs"), ("--simulator.scene=moon", "scene"), ("--seed=-1", "seed")])
def test_simulate_names_the_bad_value(tmp_path: Path, option: str, name: str, capsys: pytest.CaptureFixture[str]) -> None:
    message = fail(capsys, "simulate", "--output", tmp_path, option)
    assert f"{name}: expected" in message
    assert "got" in message


def test_output_must_not_be_a_file(tmp_path: Path, model_dir: Path, pairs_dir: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "file").touch()
    assert "--output: expected a folder" in fail(capsys, "simulate", "--output", tmp_path / "file", "--pairs=1", "--sequences=1")
    assert "--output: expected a folder" in fail(capsys, "match", pairs_dir, "--output", tmp_path / "file", "--model", model_dir)


# --- match --------------------------------------------------------------------------------------------------------------------


def test_match_writes_what_the_model_says(pairs_dir: Path, predictions_dir: Path, model_dir: Path) -> None:
    pairs = PairFiles(pairs_dir)
    assert sorted(path.name for path in predictions_dir.iterdir()) == [path.name for path in pairs.paths]
    for pair, expected in zip(pairs, JointScanCRF.from_pretrained(model_dir).match_pairs(list(pairs)), strict=True):
        found = read_prediction(predictions_dir / f"{pair.name}.npz")
        assert (found.association == expected.association).all()
        assert (found.cluster == expected.cluster).all()
        assert np.allclose(found.motions, expected.motions, atol=1e-6)


def test_match_takes_files_and_patterns_once_each(
    pairs_dir: Path, model_dir: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    other_spelling = pairs_dir / ".." / pairs_dir.name / "sim_s0_000.npz"
    files = [pairs_dir / "sim_s0_000.npz", other_spelling, f"{pairs_dir}/*s1_001.npz"]
    assert run("match", *files, "--output", tmp_path, "--model", model_dir, "--candidates=4") == 0
    out = capsys.readouterr().out.splitlines()
    assert [line.split(":")[0] for line in out] == ["sim_s0_000", "sim_s1_001", f"2 of 2 pairs matched, predictions in {tmp_path}"]
    assert "sensor" in out[0]
    assert sorted(path.name for path in tmp_path.iterdir()) == ["sim_s0_000.npz", "sim_s1_001.npz"]


def test_match_refuses_two_files_of_one_name(pairs_dir: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    copy = tmp_path / "sim_s0_000.npz"
    copy.write_bytes((pairs_dir / copy.name).read_bytes())
    message = fail(capsys, "match", pairs_dir, copy, "--output", tmp_path / "out")
    assert str(copy) in message
    assert not (tmp_path / "out").exists()


def test_match_never_replaces_a_pair(pairs_dir: Path, model_dir: Path, capsys: pytest.CaptureFixture[str]) -> None:
    before = contents(pairs_dir)
    assert "nothing but predictions" in fail(capsys, "match", pairs_dir, "--output", pairs_dir, "--model", model_dir)
    assert contents(pairs_dir) == before


def test_match_again_replaces_predictions(pairs_dir: Path, model_dir: Path, tmp_path: Path) -> None:
    for candidates in (1, 8):
        options = ["--output", tmp_path, "--model", model_dir, f"--candidates={candidates}"]
        assert run("match", pairs_dir / "sim_s0_000.npz", *options) == 0
    pair = read_pair(pairs_dir / "sim_s0_000.npz")
    expected = JointScanCRF.from_pretrained(model_dir).match_pairs([pair])[0]
    assert (read_prediction(tmp_path / "sim_s0_000.npz").association == expected.association).all()


def test_broken_files_do_not_lose_the_others(
    pairs_dir: Path, model_dir: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    broken, empty = tmp_path / "a_broken.npz", tmp_path / "z_empty.npz"
    broken.write_bytes((pairs_dir / "sim_s0_000.npz").read_bytes()[:300])
    empty.touch()
    assert run("match", broken, pairs_dir / "sim_s0_000.npz", empty, "--output", tmp_path / "out", "--model", model_dir) == 1
    out, err = capsys.readouterr()
    assert "1 of 3 pairs matched" in out
    assert [str(path) in line for path, line in zip((broken, empty), err.splitlines(), strict=True)] == [True, True]
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["sim_s0_000.npz"]


def test_a_pair_that_the_model_cannot_take_does_not_lose_the_others(
    pairs_dir: Path, model_dir: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = JointScanCRF.match_pairs

    def picky(model: JointScanCRF, pairs: list[ScanPair]) -> list[PairPrediction]:
        if any(pair.name == "sim_s0_001" for pair in pairs):
            raise RuntimeError("too large")
        return whole(model, pairs)

    monkeypatch.setattr(JointScanCRF, "match_pairs", picky)
    files = [pairs_dir / f"sim_s0_00{i}.npz" for i in (0, 1)]
    assert run("match", *files, "--output", tmp_path, "--model", model_dir) == 1
    assert f"{files[1]}: too large" in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["sim_s0_000.npz"]


def test_match_names_the_bad_argument(pairs_dir: Path, model_dir: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    def message(*options: object) -> str:
        return fail(capsys, "match", pairs_dir, "--output", tmp_path / "out", *options)

    assert "nowhere" in fail(capsys, "match", tmp_path / "nowhere", "--output", tmp_path / "out")
    assert "--model no_such_model" in message("--model", "no_such_model")
    assert "--threads: expected at least 1" in message("--model", model_dir, "--threads=0")
    assert "candidates: expected 0 or more" in message("--model", model_dir, "--candidates=-1")
    assert "--device: expected" in message("--model", model_dir, "--device=abacus")
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("name", ["config.json", "model.safetensors"])
def test_a_damaged_model_is_one_clear_line(
    pairs_dir: Path, model_dir: Path, tmp_path: Path, name: str, capsys: pytest.CaptureFixture[str]
) -> None:
    for path in model_dir.iterdir():
        (tmp_path / path.name).write_bytes(path.read_bytes()[: 100 if path.name == name else None])
    assert f"--model {tmp_path}" in fail(capsys, "match", pairs_dir, "--output", tmp_path / "out", "--model", tmp_path)


def moving_pair() -> tuple[ScanPair, PairPrediction]:
    """The sensor goes 1 m ahead while turning by 90 degrees; points 0 and 1 stand still, 2 and 3 go 0.2 m to the left in 0.1 s."""
    scan = Scan.from_ranges([5.0, 5.0, 5.0, 5.0, np.nan], [-0.4, -0.2, 0.0, 0.2, 0.3])
    background, mover = [-np.pi / 2, 0.0, 1.0], [-np.pi / 2, 0.2, 1.0]
    ones = np.ones(5)
    labels = np.array([0, 0, 1, 1, -1])
    return ScanPair(scan, scan, 0.1, name="corner"), PairPrediction(labels, labels, np.array([background, mover]), ones, ones, True)


def test_speeds_are_over_ground() -> None:
    pair, prediction = moving_pair()
    assert cli.mover_speeds(pair, prediction) == pytest.approx([2.0])


def test_a_pair_is_described_in_one_line() -> None:
    pair, prediction = moving_pair()
    moving = "corner: sensor +1.00 m ahead, +0.00 m left, +90.0 deg; 1 moving: 2.00 m/s (2 points); 0 of 4 points outliers"
    assert cli.describe(pair, prediction) == moving
    lost = np.full(5, -1)
    still = replace(prediction, association=lost, cluster=lost, motions=np.zeros((1, 3)), converged=False)
    expected = "corner: sensor +0.00 m ahead, +0.00 m left, +0.0 deg; nothing moving; 4 of 4 points outliers; not converged"
    assert cli.describe(pair, still) == expected


# --- evaluate -----------------------------------------------------------------------------------------------------------------


def score_by_tool(pairs: Path, predictions: Path) -> dict[str, dict]:
    if not SCORER.is_file():
        pytest.skip(f"needs the scorer, which is not part of the repository: no {SCORER}")
    spec = importlib.util.spec_from_file_location("score", SCORER)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module.main(str(pairs), str(predictions), as_json=True)


def assert_equal_to_tool(figures: dict, pairs: Path, predictions: Path) -> None:
    expected = score_by_tool(pairs, predictions)
    groups = {**figures["sequences"], "ALL": figures["all"]}
    assert groups.keys() == expected.keys()
    for name, group in groups.items():
        for column, (key, factor) in COLUMNS.items():
            value = np.nan if group[key] is None else group[key]
            assert factor * value == pytest.approx(expected[name][column], abs=1e-9, nan_ok=True), (name, column)
        for column, (key, factor) in SPREADS.items():
            spread = [factor * group[f"{key}_{which}"] for which in ("median", "p95")]
            assert spread == pytest.approx(expected[name][column], abs=1e-9), (name, column)


def evaluate(capsys: pytest.CaptureFixture[str], figures: Path, *arguments: object) -> tuple[str, dict]:
    capsys.readouterr()
    assert run("evaluate", *arguments, "--json", figures) == 0
    return capsys.readouterr().out, json.loads(figures.read_text())


def test_figures_equal_the_scorers(
    pairs_dir: Path, predictions_dir: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    _, figures = evaluate(capsys, tmp_path / "f.json", pairs_dir, "--predictions", predictions_dir)
    assert_equal_to_tool(figures, pairs_dir, predictions_dir)


def test_figures_equal_the_scorers_with_movers_and_mistakes(
    pairs_dir: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for seed, pair in enumerate(PairFiles(pairs_dir)):
        write_prediction(tmp_path / f"{pair.name}.npz", guess(pair, seed))
    _, figures = evaluate(capsys, tmp_path / "f.json", pairs_dir, "--predictions", tmp_path)
    assert figures["all"]["movers_found"] > 0
    assert_equal_to_tool(figures, pairs_dir, tmp_path)


def test_figures_equal_the_scorers_on_real_pairs(real_pairs_dir: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    some = PairFiles(real_pairs_dir).paths[::20]
    for name in ("pairs", "predictions"):
        (tmp_path / name).mkdir()
    for seed, path in enumerate(some):
        (tmp_path / "pairs" / path.name).symlink_to(path)
        write_prediction(tmp_path / "predictions" / path.name, guess(read_pair(path), seed))
    _, figures = evaluate(capsys, tmp_path / "f.json", tmp_path / "pairs", "--predictions", tmp_path / "predictions")
    assert len(some) == figures["all"]["pairs"] == 5
    assert_equal_to_tool(figures, tmp_path / "pairs", tmp_path / "predictions")


def test_tables_have_a_row_for_every_sequence_and_for_all(
    pairs_dir: Path, predictions_dir: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run("evaluate", pairs_dir, "--predictions", predictions_dir) == 0
    out = capsys.readouterr().out
    titles = [line.strip("*").split(":")[0] for line in out.splitlines() if line.startswith("**")]
    assert titles == ["Overview", "Table I", "Table II", "Table III"]
    for row in ("predictions, sim3_0", "predictions, sim3_1", "predictions, all"):
        assert out.count(f"| {row} |") == 4


def test_one_sequence_needs_one_row(pairs_dir: Path, predictions_dir: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run("evaluate", f"{pairs_dir}/sim_s0_*.npz", "--predictions", predictions_dir) == 0
    out = capsys.readouterr().out
    assert out.count("| predictions, all |") == 4
    assert "sim3_0" not in out


def test_running_the_model_gives_the_figures_of_its_files(
    pairs_dir: Path, predictions_dir: Path, model_dir: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    _, from_files = evaluate(capsys, tmp_path / "a.json", pairs_dir, "--predictions", predictions_dir)
    out, from_model = evaluate(capsys, tmp_path / "new" / "b.json", pairs_dir, "--model", model_dir)
    assert "| joint, all |" in out
    assert from_model["method"] == "joint"
    assert from_model["sequences"] == from_files["sequences"]
    assert from_model["all"] == from_files["all"]


@pytest.mark.parametrize("method", ["start", "static"])
def test_other_methods(pairs_dir: Path, model_dir: Path, tmp_path: Path, method: str, capsys: pytest.CaptureFixture[str]) -> None:
    out, figures = evaluate(capsys, tmp_path / "f.json", pairs_dir, "--method", method, "--model", model_dir)
    pairs = list(PairFiles(pairs_dir))
    answers = cli.METHODS[method](lambda: JointScanCRF.from_pretrained(model_dir))(pairs)
    expected = summarise([score_pair(pair, answer) for pair, answer in zip(pairs, answers, strict=True)])
    found = {key: np.nan if value is None else value for key, value in figures["all"].items()}
    assert found == pytest.approx(expected, nan_ok=True)
    assert f"| {method}, all |" in out


def test_static_needs_no_model(pairs_dir: Path) -> None:
    assert run("evaluate", pairs_dir, "--method=static", "--model=no_such_model") == 0


def test_evaluate_names_the_bad_argument(
    pairs_dir: Path, predictions_dir: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert "joint, start, static" in fail(capsys, "evaluate", pairs_dir, "--method=magic")
    assert "--predictions" in fail(capsys, "evaluate", pairs_dir, "--predictions", predictions_dir, "--method=joint")
    assert "none for 4 of 4, the first sim_s0_000.npz" in fail(capsys, "evaluate", pairs_dir, "--predictions", tmp_path)
    assert "source_ranges" in fail(capsys, "evaluate", predictions_dir, "--predictions", predictions_dir)
    pair = read_pair(pairs_dir / "sim_s0_000.npz")
    write_pair(tmp_path / "bare.npz", replace(pair, annotation=None))
    assert "bare.npz: expected an annotated pair" in fail(capsys, "evaluate", tmp_path / "bare.npz", "--method=static")
    (tmp_path / "other").mkdir()
    write_prediction(tmp_path / "other" / "sim_s0_000.npz", moving_pair()[1])
    message = fail(capsys, "evaluate", pairs_dir / "sim_s0_000.npz", "--predictions", tmp_path / "other")
    assert "sim_s0_000" in message


# --- plot ---------------------------------------------------------------------------------------------------------------------


def test_plot_draws_pair_prediction_and_model(
    pairs_dir: Path, predictions_dir: Path, model_dir: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(plots, "save_figure", partial(plots.save_figure, dpi=15))  # drawing takes time
    pair = pairs_dir / "sim_s0_000.npz"
    for name, options in {"a": [], "b": ["--prediction", predictions_dir / pair.name], "c": ["--model", model_dir]}.items():
        assert run("plot", pair, "--output", tmp_path / "new" / f"{name}.png", *options) == 0
    pictures = [(tmp_path / "new" / f"{name}.png").read_bytes() for name in "abc"]
    assert all(picture.startswith(b"\x89PNG") for picture in pictures)
    assert pictures[0] != pictures[1] == pictures[2]


def test_plot_names_the_bad_argument(
    pairs_dir: Path, predictions_dir: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    pair = pairs_dir / "sim_s0_000.npz"
    picture = tmp_path / "a.png"
    assert "--output: expected a name ending in .png" in fail(capsys, "plot", pair, "--output", tmp_path / "a.pdf")
    both = ["--prediction", predictions_dir / pair.name, "--model", "simulated"]
    assert "--prediction" in fail(capsys, "plot", pair, "--output", picture, *both)
    assert "nowhere.npz" in fail(capsys, "plot", tmp_path / "nowhere.npz", "--output", picture)
    write_prediction(tmp_path / "p.npz", moving_pair()[1])
    assert "association: expected" in fail(capsys, "plot", pair, "--output", picture, "--prediction", tmp_path / "p.npz")
    assert not picture.exists()
