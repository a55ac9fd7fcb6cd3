"""`train.py` with first-order steps after the staged fit, from the command to its run folder; and settings that are refused."""

import json
from pathlib import Path

import pytest
import torch
from command_line import load_main
from support import events_of

from torchcrf_scan.commands.experiment import experiment
from torchcrf_scan.data.pair_file import write_pair
from torchcrf_scan.data.simulate import simulate_pairs
from torchcrf_scan.data.worlds import SimulatorConfig
from torchcrf_scan.learning.checkpoint import Store
from torchcrf_scan.learning.leaks import TrainedOn
from torchcrf_scan.learning.run_data import hold_out, load_annotated
from torchcrf_scan.learning.settings import AugmentConfig, Config, DataConfig, GradientConfig, LearningConfig
from torchcrf_scan.learning.trainer import flatten, load_weights, settings_of
from torchcrf_scan.model import JointScanCRF

SEED = 33  # of no world that the shipped weights were trained on


@pytest.fixture(scope="module")
def pairs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Pair files of four sequences, coarse so that everything is quick."""
    folder = tmp_path_factory.mktemp("pairs")
    for k, pair in enumerate(simulate_pairs(SimulatorConfig(beams=61), 8, 4, SEED)):
        write_pair(folder / f"{pair.sequence}_{k}.npz", pair)
    return folder


@pytest.fixture(scope="module")
def arguments(pairs: Path) -> list[str]:
    train, test = [f"{pairs}/sim{SEED}_{k}_*.npz" for k in (0, 1, 2)], f"{pairs}/sim{SEED}_3_*.npz"
    return [
        *(f"--data.train={json.dumps(train)}", f"--data.test={test}", "--data.simulate_train=[]", "--data.simulate_test=[]"),
        *("--learning.folds=2", "--learning.max_steps=10", "--learning.booster_examples=500", "--learning.objective=unrolled"),
        *("--model.features.stumps=4", "--model.inference.backend=eager", "--model.inference.clusters=4"),
        *("--gradient.steps=2", "--gradient.batch_size=2", "--gradient.part=2", "--gradient.fresh=0", "--gradient.workers=0"),
        *("--gradient.validate_every=1", "--gradient.graph=false", "--unrolled.iterations=2", "--compare_chains=false"),
    ]


@pytest.fixture(scope="module")
def run(arguments: list[str], tmp_path_factory: pytest.TempPathFactory, undrawn: None) -> Path:
    folder = tmp_path_factory.mktemp("runs") / "small"
    load_main()([*arguments, f"--output={folder}"])
    return folder


@pytest.mark.usefixtures("undrawn")
@pytest.mark.parametrize("is_anew", [True, False])
def test_the_potential_of_movers_is_fitted_anew_or_kept(arguments: list[str], tmp_path: Path, is_anew: bool) -> None:
    own = [of for of in arguments if not of.startswith("--model") and "steps" not in of]
    steps = ["--learning.max_steps=10", "--gradient.steps=1", f"--gradient.refit_potential={str(is_anew).lower()}"]
    load_main()([*own, *steps, "--init=simulated", f"--output={tmp_path / 'run'}"])
    initial, fitted = (JointScanCRF.from_pretrained(name).cluster_potential for name in ("simulated", tmp_path / "run" / "model"))
    assert (float(initial.score) != float(fitted.score)) == is_anew


def test_the_run_folder_has_a_checkpoint_and_the_training_events(run: Path) -> None:
    names = {path.name for path in run.iterdir()}
    assert {"config.yaml", "versions.json", "metrics.json", "model", "events", "training", "checkpoint.pt"} <= names
    assert not any(name.startswith(".") for name in names)
    events = events_of(run / "training")
    assert [event.step for event in events.Scalars("loss/total")] == [1, 2]
    assert [event.step for event in events.Scalars("validation/total")] == [0, 1, 2]
    (final,) = events_of(run / "events").Tensors("final/text_summary")  # the numbers of the test pairs, of which no curve is drawn
    assert final.tensor_proto.string_val[0].decode().strip() == (run / "tables.md").read_text().strip()
    assert not any(tag.startswith("final/") for tag in events.Tags()["scalars"])


def test_the_saved_model_is_the_best_of_the_looks(run: Path) -> None:
    state = torch.load(run / "checkpoint.pt", weights_only=True)
    model = JointScanCRF.from_pretrained(run / "model")
    for name, weight in model.named_parameters():
        assert torch.equal(weight, state["best"][name]), name
    assert not torch.equal(state["model"]["association_weights.sequence"], torch.tensor(2.0))  # the staged fit came before


def test_resuming_a_finished_run_changes_nothing(run: Path, arguments: list[str]) -> None:
    before = (run / "model" / "model.safetensors").read_bytes(), (run / "metrics.json").read_bytes()
    load_main()([*arguments, f"--output={run}", "--resume"])
    assert ((run / "model" / "model.safetensors").read_bytes(), (run / "metrics.json").read_bytes()) == before


def test_a_refused_run_leaves_the_folder_as_it_was(run: Path, arguments: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    before = (run / "config.yaml").read_text()
    assert load_main()([*arguments, f"--output={run}", "--resume", "--learning.prior=3"]) == 1
    error = capsys.readouterr().err.strip().splitlines()[-1]
    assert error.startswith("train.py: error: resume: expected the settings of the run")
    assert "learning.prior = '3.0' after '10.0'" in error
    assert (run / "config.yaml").read_text() == before


def test_training_can_begin_from_a_saved_model(run: Path, arguments: list[str], tmp_path: Path) -> None:
    load_main()([*arguments, f"--output={tmp_path}", f"--init={run / 'model'}", "--gradient.steps=1", "--gradient.validation=0"])
    first = JointScanCRF.from_pretrained(run / "model")
    moved = JointScanCRF.from_pretrained(tmp_path / "model")
    assert torch.equal(moved.boosters.data.table, first.boosters.data.table)
    assert torch.equal(moved.hypothesis_score.state_dict()["mean"], first.hypothesis_score.state_dict()["mean"])
    assert not torch.equal(moved.association_weights["sequence"], first.association_weights["sequence"])
    seen = TrainedOn(tuple(f"sim{SEED}_{k}" for k in range(3)))
    assert TrainedOn.of_model(str(run / "model")) == TrainedOn.of_model(str(tmp_path / "model")) == seen


def test_what_the_initial_weights_were_trained_on_is_not_tested(
    run: Path, pairs: Path, arguments: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    turned = [f"--data.train={pairs}/sim{SEED}_3_*.npz", f"--data.test={pairs}/sim{SEED}_0_*.npz"]
    init = run / "model"
    assert load_main()([*arguments, *turned, f"--init={init}", f"--output={tmp_path}"]) == 1
    told = f"init {init}: expected no sequence in both training and test pairs, got sim{SEED}_0"
    assert capsys.readouterr().err.strip().splitlines()[-1] == f"train.py: error: {told}"
    assert not (tmp_path / "config.yaml").exists()


def test_the_saved_config_is_read_again(run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    text = (run / "config.yaml").read_text()
    assert "resume" not in text
    assert "frame_rotation" in text
    with pytest.raises(SystemExit):
        load_main()([f"--config={run / 'config.yaml'}", "--gradient.steps=0"])
    assert "gradient.steps: expected a whole number in [1, 1000000], got 0" in capsys.readouterr().err


def test_help_tells_of_every_setting(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        load_main()(["--help"])
    text = capsys.readouterr().out
    for name in flatten(Config()):
        assert f"--{name} " in text, name
    assert "--resume" in text
    assert text.count("final learning rate as a share of the maximum") == 1  # a docstring's words


# --- settings -----------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "value", "expected"),
    [
        ("objective", "hinge", "expected one of none, pseudo_likelihood, likelihood, unrolled, got hinge"),
        ("device", "tpu", "expected one of auto, cpu, cuda, got tpu"),
        ("worlds", ("moon",), "expected one of .*, got moon"),
        ("worlds", (), "expected at least one"),
        ("steps", 0, r"expected a whole number in \[1, 1000000\], got 0"),
        ("part", 3, "expected a divisor of batch_size = 8, got 3"),
        ("workers", -1, r"expected a whole number in \[0, 1000\], got -1"),
        ("learning_rate", 0.0, "expected a finite number above 0, got 0.0"),
        ("learning_rate", float("nan"), "expected a finite number above 0, got nan"),
        ("clip", float("nan"), "expected a finite number, 0 or more, got nan"),
        ("fresh", 1.5, r"expected a finite number in \[0, 1\], got 1.5"),
        ("validation", 1.0, r"expected a finite number in \[0, 1\), got 1.0"),
        ("seed", -1, r"expected a whole number in \[0, 2147483647\], got -1"),
    ],
)
def test_values_out_of_range_are_named(name: str, value: object, expected: str) -> None:
    with pytest.raises(ValueError, match=rf"gradient\.{name}: {expected}"):
        GradientConfig(**{name: value})  # type: ignore[arg-type]


@pytest.mark.parametrize("name", ["mirror", "dropout", "noise", "frame_rotation", "frame_translation"])
def test_augmentation_out_of_range_is_named(name: str) -> None:
    with pytest.raises(ValueError, match=rf"gradient\.augment\.{name}: expected .*, got -0.1"):
        AugmentConfig(**{name: -0.1})


def test_objectives_that_do_not_go_together_are_named() -> None:
    with pytest.raises(ValueError, match=r"gradient\.objective: expected unrolled"):
        Config(learning=LearningConfig(objective="unrolled"), gradient=GradientConfig(objective="pseudo_likelihood"))
    assert not Config(init="simulated").has_steps  # fitted to the pairs as it is, see `learning.own_laser`
    assert Config().first_order == "none"
    both = Config(learning=LearningConfig(objective="unrolled"))
    assert (both.first_order, both.staged.objective) == ("unrolled", "pseudo_likelihood")
    exact = Config(learning=LearningConfig(objective="likelihood"), gradient=GradientConfig(objective="unrolled"))
    assert (exact.first_order, exact.staged.objective) == ("unrolled", "likelihood")


def test_one_sequence_cannot_be_held_out_of_itself() -> None:
    config = Config(data=DataConfig(pairs=2, sequences=1), gradient=GradientConfig(objective="unrolled"))
    train, _ = load_annotated(config.data)
    with pytest.raises(ValueError, match=r"gradient\.validation: .*at least 2 sequences"):
        hold_out(train, config)
    assert hold_out(train, Config(data=config.data)) == (train, [])


def test_weights_of_other_features_are_refused(run: Path) -> None:
    with pytest.raises(ValueError, match="init: expected a model with the features of"):
        load_weights(JointScanCRF(), run / "model")


def test_what_a_run_may_change_when_it_goes_on(tmp_path: Path) -> None:
    before = settings_of(Config(output="a", gradient=GradientConfig(workers=1)))
    assert before == settings_of(Config(output="b", compare_chains=False, gradient=GradientConfig(workers=3, checkpoint_every=1)))
    Store(tmp_path, before).write(0, {"step": 0})
    with pytest.raises(ValueError, match=r"learning\.seed"):
        Store(tmp_path, settings_of(Config(learning=LearningConfig(seed=1)))).read()


def test_an_experiment_fits_in_stages(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"gradient\.objective: expected none in an experiment without .* got unrolled"):
        experiment(output=str(tmp_path), learning=LearningConfig(objective="unrolled"))
