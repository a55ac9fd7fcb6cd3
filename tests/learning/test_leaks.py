"""What a model was trained on is recorded beside its weights, and is not tested on."""

import logging
from dataclasses import replace
from pathlib import Path

import pytest
from made_up import make_pairs

from torchcrf_scan import JointScanCRF
from torchcrf_scan.config import EncoderConfig, ModelConfig
from torchcrf_scan.experiment.experiment import load_pairs, refuse_leaks, run_ablations, run_experiment
from torchcrf_scan.experiment.parser import config_of, settings_parser
from torchcrf_scan.experiment.settings import ExperimentConfig, RunConfig
from torchcrf_scan.learning.leaks import RECORD, TrainedOn
from torchcrf_scan.learning.settings import DataConfig, GradientConfig

CONFIGS = Path(__file__).resolve().parents[2] / "configs"


def test_a_sequence_on_both_sides_is_refused() -> None:
    trained_on = TrainedOn().plus(make_pairs("a", "b", "c"))
    with pytest.raises(ValueError, match=r"^data: expected no sequence in both training and test pairs, got b, c$"):
        trained_on.refuse(make_pairs("c", "d", "b"), "data")
    trained_on.refuse(make_pairs("d", "e"), "data")


def test_pairs_without_a_sequence_count_as_one() -> None:
    with pytest.raises(ValueError, match=r"got one without a name$"):
        TrainedOn().plus(make_pairs("", "a")).refuse(make_pairs("b", ""), "data")


def saved(folder: Path, trained_on: TrainedOn | None) -> str:
    """A model with a record, or without."""
    JointScanCRF().save_pretrained(folder)
    if trained_on is not None:
        trained_on.write(folder)
    return str(folder)


def test_a_record_is_read_again_and_goes_on(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    first = saved(tmp_path / "first", TrainedOn().plus(make_pairs("b", "a", "a")))
    assert TrainedOn.of_model(first) == TrainedOn(("a", "b"))
    second = saved(tmp_path / "second", TrainedOn.of_model(first).plus(make_pairs("c")))
    assert TrainedOn.of_model(second) == TrainedOn(("a", "b", "c"))
    assert TrainedOn.of_model("") == TrainedOn()
    assert not caplog.records


def test_weights_without_a_record_are_told_and_so_are_those_that_began_from_them(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    bare = TrainedOn.of_model(saved(tmp_path / "bare", None))
    assert [(record.levelno, str(tmp_path / "bare") in record.message) for record in caplog.records] == [(logging.WARNING, True)]
    bare.refuse(make_pairs("a"), "init")
    after = TrainedOn.of_model(saved(tmp_path / "after", bare.plus(make_pairs("a"))))
    assert len(caplog.records) == 2
    with pytest.raises(ValueError, match="init: expected no sequence in both"):
        after.refuse(make_pairs("a"), "init")


@pytest.mark.parametrize("content", ["[", "[]", '{"sequences": 3}', '{"pairs": []}'])
def test_a_damaged_record_is_one_line(content: str, tmp_path: Path) -> None:
    saved(tmp_path, None)
    (tmp_path / RECORD).write_text(content)
    with pytest.raises(ValueError, match=f"^{tmp_path / RECORD}: .+$"):
        TrainedOn.of_model(str(tmp_path))


@pytest.mark.parametrize(("name", "files"), [("simulated", ["pretrained"]), ("encoder", ["pretrained", "encoder"])])
def test_the_shipped_weights_record_the_worlds_of_their_settings(name: str, files: list[str]) -> None:
    expected = set()
    for file in files:
        parser = settings_parser()
        data = config_of(parser.instantiate(parser.parse_args([f"--config={CONFIGS / file}.yaml"]))).data
        expected |= {f"sim{data.seed + k}_{s}" for k in range(len(data.simulate_train)) for s in range(data.sequences)}
    found = TrainedOn.of_model(name)
    assert found.is_complete
    assert set(found.sequences) == expected


# --- the experiment -----------------------------------------------------------------------------------------------------------


def encoded(init: str, seed: int = 0, **experiment: object) -> RunConfig:
    """An experiment on two simulated sequences with an encoder that begins from `init`."""
    return RunConfig(
        data=DataConfig(pairs=2, sequences=2, seed=seed),
        model=ModelConfig(encoder=EncoderConfig(width=4)),
        gradient=GradientConfig(objective="likelihood"),
        experiment=ExperimentConfig(**experiment),  # type: ignore[arg-type]
        init=init,
    )


def test_an_experiment_does_not_test_what_its_initial_weights_have_seen(tmp_path: Path) -> None:
    leak = replace(encoded("simulated"), output=str(tmp_path / "run"))
    told = "^init simulated: expected no sequence in both training and test pairs, got sim0_0, sim0_1$"
    with pytest.raises(ValueError, match=told):
        run_experiment(leak)
    with pytest.raises(ValueError, match=told):
        run_ablations(replace(leak, init=""), {"begun": leak})
    assert not (tmp_path / "run").exists()
    other_seed = encoded("simulated", seed=70)
    refuse_leaks([other_seed], *load_pairs(other_seed))
    without_encoder = replace(leak, model=ModelConfig())  # does not begin from `init`
    refuse_leaks([without_encoder], *load_pairs(without_encoder))


def test_recorded_pairs_of_the_initial_weights_are_not_tested(tmp_path: Path) -> None:
    init = saved(tmp_path, TrainedOn(("drive 1",)))
    pairs = make_pairs("drive 0", "drive 1", "drive 2")
    with pytest.raises(ValueError, match=f"^init {tmp_path}: expected no sequence in both .* got drive 1$"):
        refuse_leaks([encoded(init)], pairs, 3)
    refuse_leaks([encoded(init)], [pairs[0], pairs[2], pairs[1]], 2)  # trained on in every fold


def test_worlds_trained_on_too_are_not_tested() -> None:
    config = encoded("", worlds=("street", "indoor"), also_train=("street", "indoor"))
    pairs, tested = load_pairs(config)
    refuse_leaks([config], pairs, tested)
    again = pairs[tested]
    assert again.sequence == "sim5000_0"
    told = "^experiment.also_train: expected no sequence in both training and test pairs, got sim5000_0$"
    with pytest.raises(ValueError, match=told):
        refuse_leaks([config], [again, *pairs], tested + 1)
