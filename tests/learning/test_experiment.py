"""The paper's experiment as a whole: its folder, tables and figures; the folds themselves are made up here."""

import csv
import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
from made_up import RIVAL, Recorder, guess, make_pairs, make_study
from matplotlib.figure import Figure
from support import events_of

from torchcrf_scan.config import InferenceConfig, ModelConfig
from torchcrf_scan.data.pair_file import write_pair
from torchcrf_scan.evaluation.metrics import score_pair
from torchcrf_scan.evaluation.table import Table
from torchcrf_scan.experiment import experiment as module
from torchcrf_scan.experiment.experiment import (
    claim,
    differing,
    find_pairs,
    load_pairs,
    run_ablations,
    run_experiment,
    worst_pairs,
    write_tables,
)
from torchcrf_scan.experiment.models import JOINT
from torchcrf_scan.experiment.settings import ExperimentConfig, RunConfig
from torchcrf_scan.experiment.study import Study
from torchcrf_scan.learning.settings import LearningConfig

SMALL = ExperimentConfig(jobs=1, resamples=20)

# --- the folder ---------------------------------------------------------------------------------------------------------------


def test_a_folder_belongs_to_one_experiment(tmp_path: Path) -> None:
    pairs, config = make_pairs("a", "b"), RunConfig(experiment=SMALL)
    claim(tmp_path / "new", config, pairs)
    settings = (tmp_path / "new" / "experiment.json").read_bytes()
    harmless = replace(
        SMALL, jobs=7, resamples=9, figures=("a:0",), leave_out=("association.geo1",), protocols=("leave_one_pair_out",)
    )
    for same in (config, replace(config, output="elsewhere", overfit=True, compare_chains=False, experiment=harmless)):
        claim(tmp_path / "new", same, pairs)
    assert (tmp_path / "new" / "experiment.json").read_bytes() == settings
    assert [path.name for path in (tmp_path / "new").iterdir()] == ["experiment.json"]


@pytest.mark.parametrize(
    ("changed", "setting"),
    [
        (RunConfig(learning=LearningConfig(seed=1)), "learning.seed"),
        (RunConfig(model=ModelConfig(inference=InferenceConfig(clusters=4))), "model.inference.clusters"),
        (RunConfig(experiment=ExperimentConfig(test_every=2)), "experiment.test_every"),
        (RunConfig(experiment=ExperimentConfig(also_train=("indoor",))), "experiment.also_train"),
    ],
)
def test_another_experiment_is_refused_by_the_setting(tmp_path: Path, changed: RunConfig, setting: str) -> None:
    pairs = make_pairs("a", "b")
    claim(tmp_path, RunConfig(), pairs)
    with pytest.raises(ValueError, match=f"--output {tmp_path}: expected .* the same experiment, got one with another {setting}$"):
        claim(tmp_path, changed, pairs)


def test_other_pairs_are_another_experiment(tmp_path: Path) -> None:
    pairs = make_pairs("a", "b", "c")
    claim(tmp_path, RunConfig(), pairs)
    with pytest.raises(ValueError, match=r"got one with another tested$"):
        claim(tmp_path, RunConfig(), pairs[:2])


def test_differing_settings_are_named_from_the_top() -> None:
    assert differing({"a": 1, "b": {"c": [1], "d": 2}}, {"a": 1, "b": {"c": [1], "d": 2}}) == []
    assert sorted(differing({"a": 1, "b": {"c": [1], "d": 2}}, {"b": {"c": [2], "d": 2}, "e": 0})) == ["a", "b.c", "e"]


# --- pairs --------------------------------------------------------------------------------------------------------------------


def test_pairs_to_draw() -> None:
    pairs = make_pairs(*"aba")
    assert [pair.name for pair in find_pairs((), pairs)] == ["pair 0", "pair 1"]
    assert [pair.name for pair in find_pairs(("a:1", "b:0"), pairs)] == ["pair 2", "pair 1"]
    odd = [replace(pair, sequence="run:2") for pair in pairs]
    assert find_pairs(("run:2:2",), odd) == [odd[2]]


@pytest.mark.parametrize("name", ["a:2", "c:0", "a", "a:-1", "a:x", ":0", ""])
def test_a_pair_that_is_not_there_cannot_be_drawn(name: str) -> None:
    with pytest.raises(ValueError, match=rf"experiment.figures: expected SEQUENCE:NUMBER out of a:0..1, b:0..0, got {name}$"):
        find_pairs((name,), make_pairs(*"aba"))


def test_simulated_pairs_have_names_of_their_own() -> None:
    few = replace(RunConfig().data, pairs=2, sequences=2)
    experiment = ExperimentConfig(worlds=("street", "indoor"), also_train=("street",))
    pairs, tested = load_pairs(RunConfig(data=few, experiment=experiment))
    assert (len(pairs), tested) == (6, 4)
    assert len({pair.name for pair in pairs}) == len({pair.sequence for pair in pairs}) == 6


def test_pairs_without_annotation_are_refused(tmp_path: Path) -> None:
    pair = make_pairs("a")[0]
    write_pair(tmp_path / "bare.npz", replace(pair, annotation=None))
    for experiment, got in ((ExperimentConfig(pairs=str(tmp_path)), r"\['bare'\]"), (ExperimentConfig(worlds=()), "none")):
        with pytest.raises(ValueError, match=f"experiment.pairs: expected annotated pairs, got {got}"):
            load_pairs(RunConfig(experiment=experiment))


# --- results ------------------------------------------------------------------------------------------------------------------


def test_tables_are_written_as_text_and_numbers(tmp_path: Path) -> None:
    one = Table("Table I: associations (leave one pair out)", ("method", "x"), (("joint", 1.23456),))
    other = Table("Overview (leave one pair out)", ("method", "y"), (("joint", 7.0),))
    write_tables(tmp_path / "tables", "name", [one, other])
    assert (tmp_path / "tables" / "name.md").read_text() == f"{one.to_markdown()}\n\n{other.to_markdown()}\n"
    assert {path.name for path in (tmp_path / "tables").iterdir()} == {"name.md", "name_table_i.csv", "name_overview.csv"}
    with (tmp_path / "tables" / "name_table_i.csv").open(newline="") as file:
        assert list(csv.reader(file)) == [["method", "x"], ["joint", "1.23456"]]


def test_the_worst_pairs_are_those_that_lose_most_against_the_start() -> None:
    pairs = make_pairs(*"abcdef")
    mistakes = {JOINT: [2, 0, 5, 1, 4, 1], RIVAL: [1, 4, 1, 1, 0, 0]}  # losses: 1, -4, 4, 0, 4, 1
    scores = {name: [score_pair(p, guess(p, many)) for p, many in zip(pairs, of, strict=True)] for name, of in mistakes.items()}
    assert worst_pairs(scores) == [2, 4, 0]
    assert worst_pairs({name: of[:2] for name, of in scores.items()}) == [0]


@pytest.fixture
def pair_files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[[], RunConfig]:
    """The settings of an experiment on four pairs in files, with cheap models and blank figures."""
    (tmp_path / "pairs").mkdir()
    for pair in make_pairs(*"aabc"):
        write_pair(tmp_path / "pairs" / f"{pair.name}.npz", pair)
    monkeypatch.setattr(Study, "of", lambda pairs, config, jobs: make_study(pairs))
    for name in ("plot_associations", "plot_association_sequence", "plot_cluster_sequence"):
        monkeypatch.setattr(module, name, lambda pair, predictions: Figure((0.2, 0.2)))  # drawing takes time, and has its own tests
    experiment = replace(SMALL, pairs=str(tmp_path / "pairs"))
    return lambda **changes: RunConfig(output=str(tmp_path / "run"), experiment=replace(experiment, **changes))


def test_a_run_leaves_tables_figures_and_events(
    pair_files: Callable[..., RunConfig], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    recorder = Recorder()
    recorder.install(monkeypatch)
    tables = run_experiment(pair_files())
    assert list(tables) == ["leave_one_pair_out", "leave_one_sequence_out"]
    assert len(recorder.trained) == 4 + 3
    for protocol, of_protocol in tables.items():
        assert len({table.title for table in of_protocol}) == len(of_protocol) > 4
        text = (tmp_path / "run" / "tables" / f"{protocol}.md").read_text()
        assert all(table.to_markdown() in text for table in of_protocol)
        assert len(list((tmp_path / "run" / "tables").glob(f"{protocol}_*.csv"))) == len(of_protocol)
        pictures = {path.stem for path in (tmp_path / "run" / "figures" / protocol).iterdir()}
        drawn = {f"{kind}_pair {k}" for kind in ("associations", "clusters") for k in (0, 2, 3)}
        assert pictures == drawn | {"loss_pair 2", "loss_pair 3"}  # pairs where `joint` makes more mistakes than its rival
    tags = events_of(tmp_path / "run" / "events").Tags()
    assert tags["scalars"] == []  # final numbers are text
    assert "leave_one_pair_out/clusters/pair 3" in tags["images"]
    assert {f"{protocol}/text_summary" for protocol in tables} <= {*tags["tensors"]}
    again = run_experiment(pair_files(figures=("a:1",), protocols=("leave_one_sequence_out",)))
    assert len(recorder.trained) == 7
    both = [[table.to_markdown() for table in of["leave_one_sequence_out"]] for of in (tables, again)]
    assert both[0] == both[1]
    assert (tmp_path / "run" / "figures" / "leave_one_sequence_out" / "clusters_pair 1.png").is_file()


def test_a_run_that_cannot_be_leaves_nothing(pair_files: Callable[..., RunConfig], tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"experiment.figures: expected SEQUENCE:NUMBER .* got z:0"):
        run_experiment(pair_files(figures=("z:0",)))
    assert not (tmp_path / "run").exists()


def test_ablations_are_one_table_beside_the_model(
    pair_files: Callable[..., RunConfig], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    recorder = Recorder()
    recorder.install(monkeypatch)
    base = pair_files(test_every=1)
    variants = {
        "seed 1": replace(base, learning=replace(base.learning, seed=1)),
        "thin": replace(base, experiment=replace(base.experiment, test_every=3)),
    }
    (table,) = run_ablations(base, variants)
    content = table.to_markdown()
    assert [row[:2] for row in table.rows] == [("as configured", 4.0), ("seed 1", 4.0), ("thin", 2.0)]
    assert len(recorder.trained) == 3 + 3 + 2
    assert (tmp_path / "run" / "tables" / "ablations.md").read_text() == content + "\n"
    assert json.loads((tmp_path / "run" / "ablations" / "thin" / "experiment.json").read_text())["experiment"]["joint_alone"]
    assert [again.to_markdown() for again in run_ablations(base, variants)] == [content]
    assert len(recorder.trained) == 8


def test_a_variants_pairs_are_among_those_of_the_model(
    pair_files: Callable[..., RunConfig], monkeypatch: pytest.MonkeyPatch
) -> None:
    Recorder().install(monkeypatch)
    base = pair_files(test_every=2)
    (table,) = run_ablations(base, {"thin": replace(base, experiment=replace(base.experiment, test_every=3))})
    assert [row[1] for row in table.rows] == [2.0, 1.0]  # every second pair, every sixth


def test_a_rank_that_only_helps_has_no_tables(pair_files: Callable[..., RunConfig], monkeypatch: pytest.MonkeyPatch) -> None:
    helped = []
    monkeypatch.setattr(module, "run_folds", lambda *arguments: helped.append(arguments))
    monkeypatch.setattr(module, "rank_and_world", lambda: (1, 2))
    base = pair_files()
    assert run_ablations(base, {"same": base}) == []
    assert run_experiment(pair_files()) == {}
    assert len(helped) == 3
