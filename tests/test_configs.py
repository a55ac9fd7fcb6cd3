"""Every file in configs/ is read by the parser that train.py builds, and says what it means to."""

from argparse import ArgumentError
from pathlib import Path

import pytest
from jsonargparse import ArgumentParser

from torchcrf_scan.config import Config, FeatureConfig, InferenceConfig, LearningConfig

CONFIGS = Path(__file__).resolve().parents[1] / "configs"
FILES = sorted(path.name for path in CONFIGS.glob("*.yaml"))


def parse(*arguments: str) -> Config:
    parser = ArgumentParser(exit_on_error=False)
    parser.add_argument("--config", action="config")
    parser.add_class_arguments(Config)
    settings = parser.instantiate(parser.parse_args(list(arguments)))
    return Config(**{name: value for name, value in settings.items() if name != "config"})


def load(name: str, *arguments: str) -> Config:
    return parse(f"--config={CONFIGS / name}", *arguments)


def test_the_known_files_are_there() -> None:
    assert {"literal.yaml", "paper.yaml", "pretrained.yaml", "real.yaml", "smoke.yaml"} <= set(FILES)


@pytest.mark.parametrize("name", FILES)
def test_a_file_loads_and_has_a_run_folder_and_a_reason(name: str) -> None:
    config = load(name)
    assert config != Config()
    assert config.output == f"runs/{Path(name).stem}"
    assert (CONFIGS / name).read_text().startswith("# ")


def test_without_a_file_everything_is_the_default() -> None:
    assert parse() == Config()


def test_the_paper_is_the_paper() -> None:
    config = load("paper.yaml")
    assert (config.data.pairs, config.data.sequences) == (31, 8)
    assert config.model.inference.clusters == 5
    assert config.model.inference.motion_weights == "hard"
    assert config.model.inference.motion_metric == "point"
    assert config.model.start == "paper"
    assert not config.model.features.wrap_closed
    assert config.model.features.stumps == 50
    assert config.learning.negatives == 10


def test_the_literal_reading_changes_one_feature() -> None:
    config = load("literal.yaml")
    assert config.model.features == FeatureConfig(raw_channels=False)
    assert config.model.inference == InferenceConfig()
    assert config.learning == LearningConfig()


def test_the_command_line_wins_over_the_file() -> None:
    config = load("paper.yaml", "--model.inference.clusters=7", "--learning.seed=3")
    assert config.model.inference.clusters == 7
    assert config.learning.seed == 3
    assert config.model.inference.motion_metric == "point"


@pytest.mark.parametrize(
    "argument", ["--model.inference.speed=3", "--model.inference.clusters=many", "--model.inference.schedule=slow", "--speed=1"]
)
def test_unknown_keys_and_wrong_values_are_refused(argument: str) -> None:
    with pytest.raises((ArgumentError, ValueError), match=argument.split("=")[0].split(".")[-1].strip("-")):
        parse(argument)


def test_a_file_with_an_unknown_key_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "wrong.yaml"
    path.write_text("model:\n  inference:\n    speed: 3\n")
    with pytest.raises(ArgumentError, match="speed"):
        parse(f"--config={path}")
