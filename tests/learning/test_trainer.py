"""One training run from the command to its run folder, on six pairs."""

import json
import re
from pathlib import Path

import pytest
import torch
from command_line import ROOT, load_main
from support import events_of
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from tensorboard.plugins.custom_scalar import layout_pb2
from tensorboard.plugins.hparams import plugin_data_pb2

from torchcrf_scan.data.pair_file import write_pair
from torchcrf_scan.data.simulate import simulate_pairs
from torchcrf_scan.data.worlds import SimulatorConfig
from torchcrf_scan.learning.leaks import TrainedOn
from torchcrf_scan.learning.run_data import load_annotated
from torchcrf_scan.learning.run_log import WATCHED
from torchcrf_scan.learning.settings import DataConfig
from torchcrf_scan.learning.trainer import pairs_to_draw, versions
from torchcrf_scan.model import JointScanCRF
from torchcrf_scan.names import ASSOCIATION_WEIGHTS, CLUSTERING_WEIGHTS
from torchcrf_scan.scan import Scan, ScanPair

METHODS = ("joint", "CRF-Matching", "CRF-Clustering")
SMALL = ("--data.pairs=6", "--data.sequences=3", "--learning.folds=2", "--model.features.stumps=15", "--learning.max_steps=40")


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory, drawn_once: None) -> Path:
    folder = tmp_path_factory.mktemp("runs") / "small"
    load_main()([*SMALL, f"--output={folder}"])
    return folder


@pytest.fixture(scope="module")
def events(run: Path) -> EventAccumulator:
    return events_of(run / "events")


def test_the_run_folder_is_complete(run: Path) -> None:
    names = {path.name for path in run.iterdir()}
    assert {"config.yaml", "versions.json", "metrics.json", "tables.md", "model", "pictures", "events"} <= names
    assert not any(name.startswith(".") for name in names)
    pictures = list((run / "pictures").glob("*.png"))
    assert len(pictures) == 3
    assert all(picture.stat().st_size > 1000 for picture in pictures)


def test_the_joint_model_has_learned(run: Path) -> None:
    metrics = json.loads((run / "metrics.json").read_text())
    assert tuple(metrics) == METHODS
    assert metrics["joint"]["cluster_accuracy"] > 70
    assert metrics["joint"]["association_accuracy"] > 50
    assert metrics["joint"]["ego_success"] >= 60
    assert metrics["joint"]["association_accuracy"] > metrics["CRF-Matching"]["association_accuracy"]
    for method in METHODS:
        assert 0 <= metrics[method]["cluster_accuracy"] <= 100


def test_the_model_can_be_loaded(run: Path) -> None:
    model = JointScanCRF.from_pretrained(run / "model")
    assert model.config.features.stumps == 15
    assert float(model.boosters.data.table.abs().max()) > 0
    assert not torch.equal(model.calibration.association, JointScanCRF().calibration.association)


def test_metrics_and_tables_tell_how_sure_the_answers_are(run: Path) -> None:
    metrics = json.loads((run / "metrics.json").read_text())
    for method in METHODS:
        assert 0 <= metrics[method]["association_ece"] <= 100
        assert 0 <= metrics[method]["cluster_ece"] <= 100
    assert metrics["joint"]["nees_pairs"] == 6
    assert metrics["joint"]["nees_mean"] > 0
    assert "**How sure**" in (run / "tables.md").read_text()


def test_the_config_is_the_resolved_one(run: Path) -> None:
    text = (run / "config.yaml").read_text()
    for line in ("pairs: 6", "stumps: 15", "max_steps: 40", "schedule: sweep"):
        assert line in text


def test_tables_name_every_method(run: Path) -> None:
    text = (run / "tables.md").read_text()
    assert text.count("Table") >= 3
    assert all(f"| {method} |" in text for method in METHODS)


def test_versions_are_noted(run: Path) -> None:
    assert json.loads((run / "versions.json").read_text()) == versions()
    assert {"python", "torch", "numpy", "scikit-learn", "scipy", "torchcrf-scan", "git"} <= set(versions())


def test_versions_are_told_without_git(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    assert versions()["git"] == "unknown"


@pytest.mark.parametrize("tag", ["joint/association", "joint/clustering", "matching/association", "clustering/clustering"])
def test_every_step_of_the_fit_is_logged(events: EventAccumulator, tag: str) -> None:
    losses = [event.value for event in events.Scalars(f"objective/{tag}")]
    assert len(losses) > 1
    assert losses[-1] < losses[0]
    assert len(events.Scalars(f"gradient/{tag}")) == len(losses)


@pytest.mark.parametrize(("chain", "names"), [("association", ASSOCIATION_WEIGHTS), ("clustering", CLUSTERING_WEIGHTS)])
def test_weights_of_every_step_are_logged(run: Path, events: EventAccumulator, chain: str, names: tuple[str, ...]) -> None:
    """Those of the joint model, the last ones as saved."""
    model = JointScanCRF.from_pretrained(run / "model")
    saved = {"association": model.association_weights, "clustering": model.clustering_weights}[chain]
    for name in names:
        logged = [event.value for event in events.Scalars(f"weights/{chain}/{name}")]
        assert len(logged) == len(events.Scalars(f"objective/joint/{chain}"))
        assert logged[-1] == pytest.approx(saved[name].item() if name in saved else 0.0, rel=1e-4, abs=1e-5), name


def test_the_fit_is_seen_to_learn(run: Path, events: EventAccumulator) -> None:
    """Curves of the accuracy from the first step to the fitted model, whose figures on the few test pairs are the final ones."""
    metrics = json.loads((run / "metrics.json").read_text())["joint"]
    rival = events_of(run / "events" / "start + gated NN")
    for name in WATCHED:
        curve = [event.value for event in events.Scalars(f"accuracy/{name}")]
        assert len(curve) >= 3
        assert curve[-1] == pytest.approx(metrics[name], rel=1e-4)
        assert len({event.value for event in rival.Scalars(f"accuracy/{name}")}) == 1  # it has nothing to learn
    exact = [event.value for event in events.Scalars("accuracy/association_accuracy")]
    assert exact[-1] > exact[0]


def test_every_card_is_a_curve(events: EventAccumulator) -> None:
    """What one opens first is what one watches: no card has a single point, no figure is in two places, pictures are by pair."""
    scalars = events.Tags()["scalars"]
    assert all(len(events.Scalars(tag)) > 1 for tag in scalars)
    assert [*dict.fromkeys(tag.split("/")[0] for tag in sorted(scalars))] == ["accuracy", "gradient", "objective", "weights"]
    assert len([tag for tag in scalars if not tag.startswith("weights/")]) == len(WATCHED) + 2 * 4
    for tag in (tag for tag in events.Tags()["images"]):
        before, after = events.Images(tag)
        assert before.step == 0 < after.step
        assert tag.startswith("pair/")
    assert len(events.Tags()["images"]) == 3


def test_weights_are_one_chart_a_chain(events: EventAccumulator) -> None:
    (event,) = events.Tensors("custom_scalars__config__")
    layout = layout_pb2.Layout.FromString(event.tensor_proto.string_val[0])
    charts = {chart.title: list(chart.multiline.tag) for category in layout.category for chart in category.chart}
    assert layout.category[0].title == "what one watches"
    for chain in ("association", "clustering"):
        (pattern,) = charts[chain]
        lines = [tag for tag in events.Tags()["scalars"] if re.fullmatch(pattern, tag)]
        assert len(lines) == len({"association": ASSOCIATION_WEIGHTS, "clustering": CLUSTERING_WEIGHTS}[chain])


def test_final_numbers_are_one_text_and_in_hparams(run: Path, events: EventAccumulator) -> None:
    (text,) = events.Tensors("final/text_summary")
    assert text.tensor_proto.string_val[0].decode().strip() == (run / "tables.md").read_text().strip()
    content = events.SummaryMetadata("_hparams_/experiment").plugin_data.content
    found = plugin_data_pb2.HParamsPluginData.FromString(content).experiment.metric_infos
    assert [metric.name.tag for metric in found] == [f"accuracy/{name}" for name in WATCHED]


def named(*sequences: str) -> list[ScanPair]:
    scan = Scan.from_ranges([1.0], [0.0])
    return [ScanPair(scan, scan, sequence=sequence, name=f"{sequence}{k}") for k, sequence in enumerate(sequences)]


def test_pictures_are_of_the_first_pairs_of_the_first_sequences() -> None:
    assert pairs_to_draw(named("a", "a", "b", "a", "c"), most=2) == [0, 2]


def test_simulated_training_and_test_pairs_share_nothing() -> None:
    train, test = load_annotated(DataConfig(simulate_train=("street", "indoor"), simulate_test=("street",), pairs=2, sequences=2))
    assert (len(train), len(test)) == (4, 2)
    TrainedOn().plus(train).refuse(test, "data")
    assert len({pair.sequence for pair in train}) == 4


def test_no_test_pair_is_no_error() -> None:
    train, test = load_annotated(DataConfig(simulate_test=(), pairs=1, sequences=1))
    assert (len(train), len(test)) == (1, 0)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--data.simulate_train=[]"], "data.simulate_train: expected a world at least where data.train names no files, got none"),
        (["--data.train=/nosuch"], "/nosuch: no such file or folder"),
        (["--data.unlabelled=/nosuch.log"], "[Errno 2] No such file or directory: '/nosuch.log'"),
        (["--init=nosuch", "--gradient.objective=unrolled"], "name_or_path: expected a folder with config.json or one of"),
    ],
)
def test_bad_input_is_one_line(arguments: list[str], message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert load_main()([*SMALL, *arguments, f"--output={tmp_path}"]) == 1
    lines = capsys.readouterr().err.strip().splitlines()
    assert len(lines) == 1
    assert lines[0].startswith(f"train.py: error: {message}")
    assert not (tmp_path / "config.yaml").exists()


@pytest.mark.parametrize(("output", "got"), [("", "an empty name"), ("file", "file, where a file is in the way")])
def test_an_output_that_is_no_folder_is_told(
    output: str, got: str, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "file").write_text("")
    assert load_main()([*SMALL, f"--output={output}"]) == 1
    assert capsys.readouterr().err == f"train.py: error: output: expected a folder, got {got}\n"
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--data.pairs=0"], "data.pairs: expected a whole number in [1, 100000], got 0"),
        (["--learning.prior=nan"], "--learning.prior: expected a finite number, got nan"),
        (["--learning.priro=1"], "did you mean --learning.prior instead of --learning.priro?"),
        (["--config=binary.yaml"], "expected a text, got"),
        (["--config=cut.yaml"], "Problems parsing config: while parsing a flow sequence"),
        (["--config=none.yaml"], "File does not exist"),
    ],
)
def test_bad_settings_are_bad_usage_in_one_line(
    arguments: list[str], message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "binary.yaml").write_bytes(b"\xff\xfe\x00")
    (tmp_path / "cut.yaml").write_text("data: [1")
    before = sorted(tmp_path.iterdir())
    with pytest.raises(SystemExit) as left:
        load_main()(arguments)
    assert left.value.code == 2
    said = capsys.readouterr().err
    assert message in said
    assert ": error: " in said
    assert len(said.splitlines()) == 1
    assert sorted(tmp_path.iterdir()) == before


def test_a_shipped_model_is_fitted_to_a_few_pairs(tmp_path: Path) -> None:
    """The settings `mine.yaml`: no staged fit, the encoder stays, and the model that comes out is a whole one."""
    (tmp_path / "pairs").mkdir()
    pairs = simulate_pairs(SimulatorConfig(beams=61), 3, 3, 40)
    made = {pair.sequence for pair in pairs}
    for pair in pairs:
        write_pair(tmp_path / "pairs" / f"{pair.name}.npz", pair)
    options = [f"--config={ROOT / 'configs' / 'mine.yaml'}", f"--data.train={tmp_path / 'pairs'}", "--learning.max_steps=2"]
    assert load_main()([*options, f"--output={tmp_path / 'run'}"]) == 0
    before, after = JointScanCRF.from_pretrained(), JointScanCRF.from_pretrained(tmp_path / "run" / "model")
    for name, value in before.state_dict().items():
        if name.startswith(("encoder.", "boosters.")):
            assert torch.equal(after.state_dict()[name], value), name
    assert {*TrainedOn.of_model(tmp_path / "run" / "model").sequences} == {*TrainedOn.of_model("encoder").sequences, *made}
