"""`evaluate`: its figures are those of an independent scorer, its tables have the rows they should."""

import importlib.util
import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from command_line import fail, run

from torchcrf_scan import JointScanCRF, PairPrediction, ScanPair
from torchcrf_scan.commands.evaluate import METHODS
from torchcrf_scan.data.dataset import PairFiles
from torchcrf_scan.data.pair_file import read_pair, read_prediction, write_pair, write_prediction
from torchcrf_scan.evaluation.metrics import score_pair
from torchcrf_scan.evaluation.neighbours import NeighbourScore, summarise_neighbours
from torchcrf_scan.evaluation.summary import summarise

ROOT = Path(__file__).resolve().parents[2]
SCORER = ROOT.parent / "shared" / "tools" / "score.py"
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
    papers = [f"Table {number}{more}" for number in ("I", "II", "III") for more in ("", ", more")]
    tables = ["Overview", *papers, "How sure", "Scene flow", "Moving points and movers"]
    assert titles == [*tables, "Errors by range"]
    for row in ("predictions, sim3_0", "predictions, sim3_1", "predictions, all"):
        assert out.count(f"| {row} |") == 10


def test_one_sequence_needs_one_row(pairs_dir: Path, predictions_dir: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run("evaluate", f"{pairs_dir}/sim_s0_*.npz", "--predictions", predictions_dir) == 0
    out = capsys.readouterr().out
    assert out.count("| predictions, all |") == 10
    assert "sim3_0" not in out


def test_figures_tell_how_sure_the_model_is(
    pairs_dir: Path, predictions_dir: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out, figures = evaluate(capsys, tmp_path / "f.json", pairs_dir, "--predictions", predictions_dir)
    for group in (figures["all"], *figures["sequences"].values()):
        assert 0 <= group["association_ece"] <= 100
        assert 0 <= group["cluster_ece"] <= 100
        assert 0 <= group["nees_covered"] <= 100
        assert group["nees_pairs"] == group["pairs"]
        assert group["nees_low"] < 3 < group["nees_high"]
    keys = ("association_ece", "cluster_ece", "nees_covered", "nees_mean", "nees_low", "nees_high")
    cells = [f"{figures['all'][key]:.{digits}f}" for key, digits in zip(keys, (1, 1, 1, 2, 2, 2), strict=True)]
    assert f"| predictions, all | {' | '.join(cells)} |" in out.splitlines()


def test_figures_hold_scene_flow_and_ranges(
    pairs_dir: Path, predictions_dir: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out, figures = evaluate(capsys, tmp_path / "f.json", pairs_dir, "--predictions", predictions_dir)
    for group in (figures["all"], *figures["sequences"].values()):
        assert group["epe_background"] >= 0
        assert group["epe_standing"] is None  # nobody stands still in simulated streets but what is background
        assert 0 <= group["accuracy_strict"] <= group["accuracy_relaxed"] <= 100
    assert sum(row["points"] for row in figures["ranges"].values()) > 0
    assert f"| {figures['all']['speed_iou']:.1f} |" in out


def test_predictions_that_do_not_say_how_well_motions_are_known(
    pairs_dir: Path, predictions_dir: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Older files, and other programs'."""
    for path in predictions_dir.iterdir():
        prediction = read_prediction(path)
        write_prediction(tmp_path / path.name, replace(prediction, covariances=None, unobserved_turn=None, unobserved_shift=None))
    out, figures = evaluate(capsys, tmp_path / "f.json", pairs_dir, "--predictions", tmp_path)
    _, whole = evaluate(capsys, tmp_path / "w.json", pairs_dir, "--predictions", predictions_dir)
    how_sure = out.split("**How sure**")[1].split("**Scene flow**")[0]
    assert how_sure.splitlines()[-2].endswith(" | - | - | - | - |")
    assert {key for key, value in figures["all"].items() if value != whole["all"][key]} == {
        *("nees_pairs", "nees_covered", "nees_mean", "nees_low", "nees_high")
    }
    assert figures["all"]["nees_mean"] is None


def test_running_the_model_gives_the_figures_of_its_files(
    pairs_dir: Path, predictions_dir: Path, model_dir: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    _, from_files = evaluate(capsys, tmp_path / "a.json", pairs_dir, "--predictions", predictions_dir)
    out, from_model = evaluate(capsys, tmp_path / "new" / "b.json", pairs_dir, "--model", model_dir)
    assert "| joint, all |" in out
    assert from_model["method"] == "joint"
    assert from_model["sequences"] == from_files["sequences"]
    assert from_model["all"] == from_files["all"]


@pytest.mark.parametrize("method", ["start", "static", "background", "icp", "ransac"])
def test_other_methods(pairs_dir: Path, model_dir: Path, tmp_path: Path, method: str, capsys: pytest.CaptureFixture[str]) -> None:
    out, figures = evaluate(capsys, tmp_path / "f.json", pairs_dir, "--method", method, "--model", model_dir)
    pairs = list(PairFiles(pairs_dir))
    answers = METHODS[method](lambda: JointScanCRF.from_pretrained(model_dir))(pairs)
    both = list(zip(pairs, answers, strict=True))
    expected = summarise([score_pair(*of) for of in both]) | summarise_neighbours([NeighbourScore.of(*of) for of in both])
    found = {key: np.nan if value is None else value for key, value in figures["all"].items()}
    assert found == pytest.approx(expected, nan_ok=True)
    assert f"| {method}, all |" in out


@pytest.mark.parametrize("method", ["joint", "start"])
def test_frames_that_stay_change_nothing_but_add_a_table(
    pairs_dir: Path, model_dir: Path, tmp_path: Path, method: str, capsys: pytest.CaptureFixture[str]
) -> None:
    options = [pairs_dir, "--method", method, "--model", model_dir]
    out, figures = evaluate(capsys, tmp_path / "a.json", *options)
    same, displaced = evaluate(capsys, tmp_path / "b.json", *options, "--frame_offset=0")
    extra = displaced.pop("displaced")
    for name, figure in figures["all"].items():
        assert displaced["all"][name] == (figure and pytest.approx(figure, abs=1e-4, rel=1e-6)), name
    assert displaced["all"].keys() == figures["all"].keys()
    assert same.startswith(out)
    assert (extra["metres"], extra["turn"], extra["seed"]) == (0, 0, 0)
    scores = [score_pair(pair, answer) for pair, answer in zip(*answers_of(pairs_dir, model_dir, method), strict=True)]
    assert extra["ego_success"]["all"] == 100 * np.mean([score.has_ego_within(0.2, 0.02) for score in scores])
    assert list(extra["ego_success"]["sequences"]) == ["sim3_0", "sim3_1"]
    assert "**The second scan's frame displaced by 0 m and turned by 0 rad**" in same
    assert same.splitlines()[-1] == f"| {method}, all | {extra['ego_success']['all']:.1f} |"


def answers_of(pairs_dir: Path, model_dir: Path, method: str) -> tuple[list[ScanPair], list[PairPrediction]]:
    pairs = list(PairFiles(pairs_dir))
    return pairs, METHODS[method](lambda: JointScanCRF.from_pretrained(model_dir))(pairs)


def test_displaced_frames_are_drawn_from_the_seed(
    pairs_dir: Path, model_dir: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    options = [pairs_dir, "--method=start", "--model", model_dir, "--frame_offset=3.5"]
    figures = [
        evaluate(capsys, tmp_path / "f.json", *options, "--frame_turn", turn, "--seed", seed)[1]
        for turn, seed in ((0.35, 1), (0.35, 1), (0.35, 2), ("any", 1))
    ]
    assert figures[0] == figures[1]
    errors = [figure["all"]["ego_translation_mean"] for figure in figures]
    assert len(set(errors)) == 3
    assert [figure["displaced"]["turn"] for figure in figures] == [0.35, 0.35, 0.35, "any"]


def test_evaluate_names_the_bad_displacement(
    pairs_dir: Path, predictions_dir: Path, model_dir: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    def message(*options: object) -> str:
        return fail(capsys, "evaluate", pairs_dir, *options)

    assert "--frame_offset: expected metres from 0 to 1e+06, got -1" in message("--frame_offset=-1")
    assert "--frame_turn: expected radians from 0 to pi, or any, got 4" in message("--frame_turn=4")
    assert "expected no --predictions" in message("--frame_turn=any", "--predictions", predictions_dir)
    for method in ("static", "background", "icp", "ransac"):
        got = message("--frame_offset=1", "--method", method)
        assert f"--method: expected one of joint, start with --frame_offset or --frame_turn, got {method}" in got


def test_static_needs_no_model(pairs_dir: Path) -> None:
    assert run("evaluate", pairs_dir, "--method=static", "--model=no_such_model") == 0


def test_evaluate_names_the_bad_argument(
    pairs_dir: Path,
    predictions_dir: Path,
    tmp_path: Path,
    moving_pair: tuple[ScanPair, PairPrediction],
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert "joint, start, static, background, icp, ransac" in fail(capsys, "evaluate", pairs_dir, "--method=magic")
    assert "--predictions" in fail(capsys, "evaluate", pairs_dir, "--predictions", predictions_dir, "--method=joint")
    for option in ("--candidates=5", "--outlier_distance=1"):
        assert "expected no --candidates" in fail(capsys, "evaluate", pairs_dir, "--predictions", predictions_dir, option)
    assert "/nosuch: no such file or folder" in fail(capsys, "evaluate", "/nosuch", "--method=static")
    assert "none for 4 of 4, the first sim_s0_000.npz" in fail(capsys, "evaluate", pairs_dir, "--predictions", tmp_path)
    assert "source_ranges" in fail(capsys, "evaluate", predictions_dir, "--predictions", predictions_dir)
    pair = read_pair(pairs_dir / "sim_s0_000.npz")
    write_pair(tmp_path / "bare.npz", replace(pair, annotation=None))
    assert "bare.npz: expected an annotated pair" in fail(capsys, "evaluate", tmp_path / "bare.npz", "--method=static")
    (tmp_path / "a.log").write_text("FLASER 1 2.0 0 0 0 0 0 0 1.0 host 1.0\n")
    message = fail(capsys, "evaluate", tmp_path / "a.log", "--method=static")
    assert "a.log: expected an annotated pair file (.npz), got a CARMEN log, which has no annotation" in message
    (tmp_path / "other").mkdir()
    write_prediction(tmp_path / "other" / "sim_s0_000.npz", moving_pair[1])
    message = fail(capsys, "evaluate", pairs_dir / "sim_s0_000.npz", "--predictions", tmp_path / "other")
    assert "sim_s0_000" in message


def test_a_closed_pipe_is_no_traceback(pairs_dir: Path) -> None:
    command = [sys.executable, "-m", "torchcrf_scan", "evaluate", str(pairs_dir), "--method=static"]
    with subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        assert process.stderr is not None
        process.stdout.close()
        errors = process.stderr.read()
    assert process.returncode == 1
    assert errors == ""
