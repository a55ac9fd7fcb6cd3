"""The benchmark: what its report holds, in tiny sizes, and the arithmetic of times, ratios and limits. No time is asserted."""

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from command_line import fail, run

from torchcrf_scan.benchmark import beside, limits, rivals
from torchcrf_scan.benchmark.fresh import high_water_mark
from torchcrf_scan.benchmark.limits import Rates
from torchcrf_scan.benchmark.plan import Plan, settings_of, with_backend
from torchcrf_scan.benchmark.report import EVERYWHERE, report_tables, write_report
from torchcrf_scan.benchmark.scenes import ODOMETRY_SHIFT, ODOMETRY_TURN, in_mode, street_pairs
from torchcrf_scan.benchmark.study import growth_rows
from torchcrf_scan.benchmark.timing import Task, Timed, time_in_turns
from torchcrf_scan.model import JointScanCRF

RATES = Rates(bandwidth=1e10, matrix=1e10, vector=1e9)
ROW_KEYS = {"stage", "mode", "batch", "beams", "threads", "median_ms_per_pair", "runs", "backend"}
TINY = ("--beams=[31]", "--batches=[1,2]", "--threads=[1]", "--repeats=1", "--simulated=1", "--backends=[compiled,eager]")


@pytest.fixture(scope="module")
def report(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    folder = tmp_path_factory.mktemp("bench")
    assert run("simulate", "--output", folder / "pairs", "--pairs=1", "--sequences=1", "--simulator.beams=41") == 0
    assert run("bench", "--output", folder / "report.json", f"--pairs={folder / 'pairs'}", "--training_pairs=2", *TINY) == 0
    assert sorted(path.name for path in folder.iterdir()) == ["pairs", "report.json"]
    read: dict[str, Any] = json.loads((folder / "report.json").read_text())
    return read


def rows_of(report: dict[str, Any], stage: str) -> list[dict[str, Any]]:
    return [row for row in report["rows"] if row["stage"] == stage]


# --- the report ---------------------------------------------------------------------------------------------------------------


def test_whole_pairs_have_a_time(report: dict[str, Any]) -> None:
    whole = [row for row in rows_of(report, "whole") if row["data"] == "simulated"]
    assert {(row["backend"], row["mode"], row["batch"], row["beams"], row["threads"]) for row in whole} == {
        (backend, mode, batch, 31, 1) for backend in ("compiled", "eager") for mode in ("cold", "warm") for batch in (1, 2)
    }
    assert all(row.keys() >= ROW_KEYS and row["median_ms_per_pair"] > 0 for row in whole)


def test_recorded_pairs_are_timed_in_both_modes(report: dict[str, Any]) -> None:
    recorded = [row for row in rows_of(report, "whole") if row["data"] == "recorded"]
    assert sorted(row["mode"] for row in recorded) == ["cold", "cold", "warm", "warm"]
    assert all(row["median_ms_per_pair"] > 0 for row in recorded)


def test_rivals_have_a_ratio_or_a_note(report: dict[str, Any]) -> None:
    found = rows_of(report, "registration")
    assert {row["rival"] for row in found} == set(rivals.REGISTRATIONS)
    assert all(row["eager_to_rival"] > 0 if row["runs"] else row["note"] for row in found)
    chains = rows_of(report, "chain")
    assert {row["decoder"] for row in chains} == set(rivals.CHAINS)
    assert {row["states"] for row in chains} == {16, 17}
    assert all(row["eager_to_this"] > 0 and row.get("same_labels", True) if row["runs"] else row["note"] for row in chains)


def test_everything_else_is_there(report: dict[str, Any]) -> None:
    assert rows_of(report, "first_call")[0]["median_ms_per_pair"] > 0
    assert rows_of(report, "peak_memory")[0]["megabytes"] > 0
    assert all(
        rows_of(report, stage)[0]["seconds"] > 0
        for stage in ("fit_fold", "leave_one_out_31", "training_pass_1000", "rounds_1", "rounds_32")
    )
    assert [row["mode"] for row in rows_of(report, "limit")] == ["cold", "warm"]
    assert all(row["compiled_to_limit"] > 0 and row["eager_to_limit"] > 0 for row in rows_of(report, "limit"))
    assert report["machine"]["torch"] == torch.__version__
    assert {"cpu_count", "numba"} <= report["machine"].keys()


def test_tables_tell_every_kind_of_row(report: dict[str, Any]) -> None:
    titles = [table.title for table in report_tables(report["rows"], RATES)]
    assert len(titles) == 7  # no growth from one number of beams, nothing beside
    assert all("nan" not in table.to_markdown() for table in report_tables(report["rows"], RATES))


def test_report_has_null_for_what_is_not_known(tmp_path: Path) -> None:
    write_report(tmp_path / "report.json", [{"stage": "whole", "exponent": math.nan}], RATES)
    (row,) = json.loads((tmp_path / "report.json").read_text())["rows"]
    assert row == {**dict.fromkeys(EVERYWHERE), "stage": "whole", "exponent": None}


# --- the command --------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--beams=[0]"], "--beams: expected numbers of at least 1, got [0]"),
        (["--batches=[]"], "--batches"),
        (["--repeats=0"], "--repeats: expected at least 1, got 0"),
        (["--backends=[guess]"], "--backends: expected some of"),
        (["--pairs=nowhere.npz"], "nowhere.npz"),
    ],
)
def test_bad_options_are_told(arguments: list[str], message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert message in fail(capsys, "bench", "--output", tmp_path / "report.json", *arguments)


# --- sizes --------------------------------------------------------------------------------------------------------------------


def make_plan(**changes: Any) -> Plan:
    values = {"beams": (181, 361, 721), "batches": (1, 8), "threads": (1, 2), "repeats": 1, "pairs": 2, "patience": 1.0}
    return Plan("simulated", ("compiled", "eager"), **{**values, **changes})


def test_reference_is_timed_in_fewer_sizes() -> None:
    plan = make_plan()
    assert plan.centre == (1, 361, 1)
    assert len(settings_of(plan, "compiled")) == 12
    assert sorted(settings_of(plan, "eager")) == [(1, 181, 1), (1, 361, 1), (1, 361, 2), (1, 721, 1), (8, 361, 1)]
    assert len(settings_of(make_plan(is_full=True), "eager")) == 12


def test_growth_is_the_exponent() -> None:
    def timed(beams: int) -> Timed:
        row = {"stage": "whole", "backend": "eager", "mode": "warm", "batch": 1, "beams": beams, "threads": 1, "data": "simulated"}
        return Timed(Task(row, lambda turn: None), {0: 1e-6 * beams**1.5})

    (row,) = growth_rows([timed(beams) for beams in (181, 361, 721)], make_plan())
    assert row["exponent"] == pytest.approx(1.5)
    assert (row["mode"], row["from_beams"], row["to_beams"]) == ("warm", 361, 721)


def test_prior_is_as_wrong_as_odometry() -> None:
    pairs = street_pairs(21, 3)
    assert all(pair.initial_motion is None for pair in in_mode(pairs, "cold"))
    warm = in_mode(pairs, "warm")
    error = np.stack([pair.initial_motion - pair.annotation.motions[0] for pair in warm])  # type: ignore[union-attr, operator]
    assert (np.abs(error) < 5 * np.array([ODOMETRY_TURN, ODOMETRY_SHIFT, ODOMETRY_SHIFT])).all()
    assert np.abs(error).min() > 0
    assert all((a.initial_motion == b.initial_motion).all() for a, b in zip(warm, in_mode(pairs, "warm"), strict=True))


# --- timing -------------------------------------------------------------------------------------------------------------------


def test_tasks_take_turns() -> None:
    order: list[tuple[str, int]] = []
    tasks = [Task({}, lambda turn: order.append(("b", turn)), rounds=2, size=2), Task({}, lambda turn: order.append(("a", turn)))]
    timed = time_in_turns(tasks, patience=10.0)
    assert order == [("a", 0), ("b", 0), ("b", 1)]
    assert [len(one.seconds) for one in timed] == [1, 2]


def test_too_long_a_call_is_left_out() -> None:
    large = Task({}, lambda turn: pytest.fail("called"), series=("one",), size=1e12)
    small = Task({}, lambda turn: sum(range(1000)), series=("one",))
    row = time_in_turns([large, small], patience=0.1)[1].as_row()
    assert (row["median_ms_per_pair"], row["runs"]) == (None, 0)
    assert "patience" in row["note"]


def test_ratios_are_of_the_same_rounds() -> None:
    ours = Timed(Task({}, lambda turn: None, pairs=2), {0: 2.0, 1: 8.0, 2: 100.0})
    theirs = Timed(Task({}, lambda turn: None), {0: 1.0, 1: 2.0})
    assert ours.ratio(theirs) == pytest.approx((1.0 + 2.0) / 2)
    assert ours.milliseconds == 4000.0
    assert math.isnan(ours.ratio(Timed(Task({}, lambda turn: None))))


# --- limits, rivals, memory ---------------------------------------------------------------------------------------------------


def test_work_of_a_chain_is_counted_by_hand() -> None:
    work = limits.chain_work(points=10, states=3)
    assert work.operations == 2 * 10 * (3 * 3 * 2) + 3 * 10 * 3
    assert work.bytes == 8 * 10 * (2 * 9 + 2 * 3)


def test_work_grows_with_the_points_and_without_a_prior() -> None:
    once, twice = limits.count_work(limits.Size()), limits.count_work(limits.Size(points=722))
    assert twice.operations > once.operations > 0
    assert twice.bytes > once.bytes > 0
    assert limits.count_work(limits.Size(is_warm=True)).operations < once.operations
    assert limits.Work(2e10, 1e10).milliseconds(RATES) == pytest.approx(2000.0)


def test_viterbi_finds_the_best_labelling() -> None:
    generator = np.random.default_rng(0)
    unary, pairwise = generator.normal(size=(4, 3)), generator.normal(size=(3, 3, 3))
    every = np.stack(np.meshgrid(*[range(3)] * 4, indexing="ij"), axis=-1).reshape(-1, 4)
    score = sum(unary[i, every[:, i]] for i in range(4)) + sum(pairwise[i, every[:, i], every[:, i + 1]] for i in range(3))
    assert rivals.viterbi(unary, pairwise).tolist() == every[score.argmax()].tolist()


def test_rivals_start_from_the_prior() -> None:
    pytest.importorskip("small_gicp")
    (pair,) = in_mode(street_pairs(181, 1), "warm")
    found = rivals.load_small_gicp()(pair)
    assert np.linalg.norm(found[1:] - pair.annotation.motions[0, 1:]) < 0.3  # type: ignore[union-attr]


def test_missing_library_is_a_note() -> None:
    def missing() -> None:
        raise ImportError("no such library")

    assert rivals.load(missing) == (None, "not installed or not usable: no such library")


def test_high_water_mark_is_read() -> None:
    assert high_water_mark("Name:\tpython\nVmHWM:\t    2048 kB\n") == 2.0


# --- backends, another checkout -----------------------------------------------------------------------------------------------


def test_backend_changes_the_config_alone() -> None:
    model = JointScanCRF.from_pretrained()
    other = with_backend(model, "eager")
    assert other.association_weights is model.association_weights
    assert other.config.inference.candidates == model.config.inference.candidates


def test_another_checkout_is_asked_in_turns(monkeypatch: pytest.MonkeyPatch) -> None:
    tree = Path(beside.__file__).parents[2]  # this one beside itself
    monkeypatch.setattr(beside, "TASKS", {"cold, one pair": "match", "a batch of gradients": "rounds"})
    rows = beside.compare(street_pairs(31, 1), "simulated", tree, repeats=1)
    assert [row["task"] for row in rows] == ["cold, one pair", "a batch of gradients"]
    assert all(row["ratio"] == pytest.approx(row["ms_per_pair"] / row["other_ms_per_pair"]) for row in rows)
    assert "Beside another checkout" in [table.title for table in report_tables(rows, RATES)]


def test_a_folder_without_the_package_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="--beside: expected a folder that holds torchcrf_scan"):
        beside.compare(street_pairs(31, 1), "simulated", tmp_path, repeats=1)


def test_a_process_that_fails_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "torchcrf_scan").mkdir()
    (tmp_path / "torchcrf_scan" / "__init__.py").touch()
    ends = f"import os, sys\nif os.environ['PYTHONPATH'] == {str(tmp_path)!r}: sys.exit(3)\n"
    monkeypatch.setattr(beside, "PROGRAM", ends + "for line in sys.stdin: print(1, flush=True)")  # they begin at once
    with pytest.raises(ValueError, match="ended with 3"):
        beside.compare(street_pairs(31, 1), "simulated", tmp_path, repeats=1)
