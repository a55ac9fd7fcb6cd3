"""Every file in configs/ is read by the parser that train.py builds, and says what it means to."""

from argparse import ArgumentError
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from support import PAPER_WEIGHTS

from torchcrf_scan.commands.experiment import read_variants
from torchcrf_scan.config import FeatureConfig, InferenceConfig, ModelConfig
from torchcrf_scan.experiment.parser import config_of, settings_parser
from torchcrf_scan.experiment.settings import ExperimentConfig, RunConfig
from torchcrf_scan.features.scales import live_weights
from torchcrf_scan.learning.settings import LearningConfig
from torchcrf_scan.model import JointScanCRF
from torchcrf_scan.names import WEIGHTS

PAPER = FeatureConfig(free_space=False, decisions=False, reach="hard", left_out=())
CONFIGS = Path(__file__).resolve().parents[1] / "configs"
FILES = sorted(path.name for path in CONFIGS.glob("*.yaml"))


def parse(*arguments: str) -> RunConfig:
    parser = settings_parser(exit_on_error=False)
    return config_of(parser.instantiate(parser.parse_args(list(arguments))))


def load(name: str, *arguments: str) -> RunConfig:
    return parse(f"--config={CONFIGS / name}", *arguments)


def test_the_known_files_are_there() -> None:
    assert {"literal.yaml", "paper.yaml", "pretrained.yaml", "real.yaml", "smoke.yaml"} <= set(FILES)


@pytest.mark.parametrize("name", FILES)
def test_a_file_loads_and_has_a_run_folder_and_a_reason(name: str) -> None:
    config = load(name)
    assert config != RunConfig()
    assert config.output == f"runs/{Path(name).stem}"
    assert (CONFIGS / name).read_text().startswith("# ")


def test_without_a_file_everything_is_the_default() -> None:
    assert parse() == RunConfig()


PAPERS_FEATURES = FeatureConfig(
    free_space=False,
    decisions=False,
    reach="off",
    left_out=(),
    length_unit="metre",
    wrap_closed=False,
    raw_channels=True,
    stumps=50,
)
PAPERS_LEARNING = LearningConfig(objective="pseudo_likelihood", predicted_share=0.0, negatives=10, disturbance=0.0)
PAPERS_MOTIONS = {"clusters": 5, "motion_metric": "point", "motion_weights": "hard", "movers": "threshold"}


def has_papers_weights(config: RunConfig) -> bool:
    live = torch.cat(live_weights(config.model.features))
    return len(list(JointScanCRF(config.model).parameters())) == 30 and bool(live[PAPER_WEIGHTS].all())


def test_the_paper_is_the_paper() -> None:
    """Field by field; every one in which it is not is in the file's comment."""
    config = load("paper.yaml")
    assert (config.data.pairs, config.data.sequences, config.experiment) == (31, 8, ExperimentConfig())
    assert has_papers_weights(config)
    inference = InferenceConfig(**PAPERS_MOTIONS, iterations=50, candidates=8, schedule="sweep")
    assert config.model == ModelConfig(start="search", features=PAPERS_FEATURES, inference=inference)
    noise = {"rotation_noise": 0.005, "translation_noise": 0.02, "start_share": 0.5}
    assert config.learning == replace(PAPERS_LEARNING, folds=4, booster_examples=5000, **noise)
    said = (CONFIGS / "paper.yaml").read_text().split("data:")[0]
    for departure in ("8 candidates", "sweep", "5,000 examples", "half of the pairs", "out-of-fold", "search", "W-A"):
        assert departure in said, departure


def test_the_exact_paper_has_no_departure() -> None:
    config = load("paper_exact.yaml")
    assert (config.data.pairs, config.data.sequences) == (31, 8)
    assert has_papers_weights(config)
    inference = InferenceConfig(**PAPERS_MOTIONS, iterations=10, candidates=0, schedule="flooding", flooding_order="ascending")
    assert config.model == ModelConfig(start="paper", features=PAPERS_FEATURES, inference=inference)
    noise = {"rotation_noise": 0.0, "translation_noise": 0.0, "start_share": 0.0}
    assert config.learning == replace(PAPERS_LEARNING, folds=0, booster_examples=0, batch_size=1, **noise)
    assert config.experiment == ExperimentConfig(protocols=("leave_one_pair_out",), test_every=16, joint_alone=True)


def test_the_literal_reading_changes_one_feature() -> None:
    config = load("literal.yaml")
    assert config.model.features == replace(PAPER, raw_channels=False)
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


# --- ablations ----------------------------------------------------------------------------------------------------------------

ABLATIONS = CONFIGS / "ablations"


@pytest.fixture(scope="module")
def variants() -> dict[str, RunConfig]:
    return read_variants(ABLATIONS, load("paper.yaml"))


@pytest.mark.parametrize("path", sorted(ABLATIONS.glob("*.yaml")), ids=lambda path: path.stem)
def test_an_ablation_has_a_reason_and_changes_the_paper(path: Path, variants: dict[str, RunConfig]) -> None:
    assert path.read_text().startswith("# ")
    paper = load("paper.yaml")
    if path.stem == "without_a_feature":
        assert path.stem not in variants
    else:
        assert variants[path.stem] != paper
        assert (variants[path.stem].data, variants[path.stem].output) == (paper.data, paper.output)  # the same pairs


def test_no_two_ablations_are_the_same(variants: dict[str, RunConfig]) -> None:
    assert len({str(config) for config in variants.values()}) == len(variants) > 40


def test_an_ablation_of_the_default_has_a_reason_and_changes_it() -> None:
    folder, default = CONFIGS / "ablations_default", load("simulated.yaml")
    variants = read_variants(folder, default)
    for path in folder.glob("*.yaml"):
        assert path.read_text().startswith("# "), path
        assert variants[path.stem] != default, path
        assert (variants[path.stem].data, variants[path.stem].output) == (default.data, default.output), path


def test_every_feature_is_left_out_in_turn(variants: dict[str, RunConfig]) -> None:
    paper = load("paper.yaml")
    without = {name.removeprefix("without "): config for name, config in variants.items() if name.startswith("without ")}
    for name, config in without.items():
        features = replace(paper.model.features, left_out=(name,))
        assert config == replace(paper, model=replace(paper.model, features=features))
    assert set(without) == {WEIGHTS[k] for k in PAPER_WEIGHTS}


def test_a_variant_keeps_what_it_does_not_name(tmp_path: Path) -> None:
    (tmp_path / "one.yaml").write_text("# Others.\nmodel: {inference: {candidates: 4}}\n")
    (tmp_path / "two.yaml").write_text("")
    base = load("paper.yaml", "--learning.seed=7", "--experiment.pairs=[a, b]", "--model.features.left_out=[clustering.outlier]")
    found = read_variants(tmp_path, base)
    assert found["two"] == base
    assert found["one"] == replace(base, model=replace(base.model, inference=replace(base.model.inference, candidates=4)))
    assert found["one"].experiment.pairs == ("a", "b")


# --- values that are refused ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("config", "name", "value"),
    [
        (InferenceConfig, "candidate_search", "luck"),
        (InferenceConfig, "motion_metric", "plane"),
        (ModelConfig, "start", "nowhere"),
        (FeatureConfig, "left_out", ("association.dist2",)),
        (FeatureConfig, "left_out", ("dist1",)),
        (FeatureConfig, "left_out", ("clustering.outlier", "clustering.dist1")),
        (ExperimentConfig, "protocols", ("leave_all_out",)),
        (ExperimentConfig, "worlds", ("moon",)),
        (ExperimentConfig, "also_train", ("moon",)),
        (ExperimentConfig, "test_every", 0),
        (ExperimentConfig, "resamples", 0),
        (ExperimentConfig, "jobs", -1),
    ],
)
def test_values_out_of_range_are_named(config: type, name: str, value: object) -> None:
    last = value[-1] if isinstance(value, tuple) else value
    with pytest.raises(ValueError, match=f"{name}: expected .*, got {last}"):
        config(**{name: value})


def test_every_weight_can_be_left_out() -> None:
    assert len(set(WEIGHTS)) == 44
    assert FeatureConfig(left_out=WEIGHTS).left_out == WEIGHTS
