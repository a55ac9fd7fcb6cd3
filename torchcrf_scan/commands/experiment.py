"""`torchcrf-scan experiment`: the paper's experiment, and ablations of the model."""

from __future__ import annotations

import logging
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import yaml
from jsonargparse import ArgumentError, ArgumentParser

from torchcrf_scan.commands.parser import CommandParser
from torchcrf_scan.errors import TorchCRFScanError
from torchcrf_scan.experiment.parser import config_of, load_yaml, settings_parser
from torchcrf_scan.experiment.settings import RunConfig


def experiment(*, ablations: str | None = None, **settings: Any) -> int:
    """Leaves pairs, then sequences, out in turn; fits every method on the rest; prints Tables I to III with intervals.

    An interrupted run is resumed. Under `torchrun` every process takes its share of the folds.

    Args:
        ablations: folder of YAML files, each a variant of the settings; only the joint model is run, one table is printed
        settings: the fields of `RunConfig`
    """
    from torchcrf_scan.experiment.experiment import run_ablations, run_experiment

    config = config_of(settings)
    if config.has_steps and config.model.encoder.width == 0:
        got = config.first_order
        raise TorchCRFScanError(
            f"gradient.objective: expected none in an experiment without model.encoder (it fits in stages), got {got}"
        )
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    if ablations is not None:
        tables = run_ablations(config, read_variants(Path(ablations), config))
    else:
        tables = [table for of_protocol in run_experiment(config).values() for table in of_protocol]
    print("\n".join(table.to_markdown() for table in tables), end="")
    if tables:
        print(f"\ntables, figures and predictions: {config.output}  (tensorboard --logdir {config.output})")
    return 0


def experiment_parser(summary: str) -> ArgumentParser:
    """Options: every setting, from YAML files and one by one."""
    usage = "torchcrf-scan experiment [--config CONFIG.yaml] [--ablations FOLDER] --output OUTPUT [settings]"
    parser = settings_parser(CommandParser, description=summary, usage=usage)
    parser.add_argument("--ablations", type=str | None, help="folder of YAML files, each a variant: prints one table of them")
    return parser


def read_variants(folder: Path, config: RunConfig) -> dict[str, RunConfig]:
    """The variants of `config` in a folder: one per YAML file, or with `experiment.leave_out` one for each feature named there.

    Raises:
        TorchCRFScanError: no YAML file, or one with unknown settings.
    """
    files = sorted(folder.glob("*.yaml"))
    if not files:
        raise TorchCRFScanError(f"--ablations {folder}: expected a folder of .yaml files, got none")
    parser = settings_parser(exit_on_error=False)
    variants: dict[str, RunConfig] = {}
    config = replace(config, experiment=replace(config.experiment, leave_out=()))
    for file in files:
        variant = read_variant(parser, file, config)
        left_out = variant.experiment.leave_out
        variant = replace(variant, experiment=replace(variant.experiment, leave_out=()))
        if not left_out:
            variants[file.stem] = variant
        for name in left_out:
            features = replace(variant.model.features, left_out=(*variant.model.features.left_out, name))
            variants[f"without {name}"] = replace(variant, model=replace(variant.model, features=features))
    return variants


def read_variant(parser: ArgumentParser, file: Path, config: RunConfig) -> RunConfig:
    """`config` with the settings of one file changed."""
    try:
        changes = load_yaml(file.read_text()) or {}
        if not isinstance(changes, dict):
            raise TorchCRFScanError(f"expected settings, one a line as NAME: VALUE, got {changes!r}")
        base = parser.parse_object(asdict(config))
        return config_of(parser.instantiate(parser.parse_object(changes, base)))
    except (ArgumentError, yaml.YAMLError, ValueError, TypeError) as error:
        raise TorchCRFScanError(f"{file}: {error}") from error
