"""Parser of command line and YAML files of a run, for `train.py` and `torchcrf-scan experiment`."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache
from typing import Any

import yaml
from jsonargparse import ArgumentParser, get_loader, set_loader

from torchcrf_scan.data.bounded_yaml import check_size
from torchcrf_scan.experiment.settings import RunConfig


class SettingsParser(ArgumentParser):
    """An `ArgumentParser` that refuses a file of other bytes than text as it refuses other settings."""

    def parse_path(self, path: str, *args: Any, **options: Any) -> Any:
        """The settings of a file."""
        try:
            return super().parse_path(path, *args, **options)
        except UnicodeDecodeError as error:
            raise TypeError(f"{path}: expected a text, got {error}") from error


def settings_parser(kind: type[ArgumentParser] = SettingsParser, **options: Any) -> ArgumentParser:
    """A parser of the fields of `RunConfig`, from YAML files (`--config`) and one by one. options: of `ArgumentParser`."""
    _bound_yaml()
    parser = kind(**options)
    parser.add_argument("--config", action="config", help="YAML file of settings")
    parser.add_class_arguments(RunConfig)
    return parser


def config_of(settings: Mapping[str, Any]) -> RunConfig:
    """The config from the instantiated settings; other arguments are ignored."""
    return RunConfig(**{name: value for name, value in settings.items() if name in RunConfig.__dataclass_fields__})


def load_yaml(text: str) -> Any:
    """Parses YAML text of bounded size.

    Raises:
        yaml.YAMLError: invalid YAML, or more aliases or levels than settings need.
    """
    return _bound_yaml()(text)


@cache
def _bound_yaml() -> Any:
    """Makes the parser reject texts that expand to more than `MOST_VALUES`, e.g. by nested aliases; returns its loader."""
    load = get_loader("yaml")

    def load_bounded(text: str) -> Any:
        check_size(text)
        return load(text)

    set_loader("yaml", load_bounded, (yaml.YAMLError,))
    return load_bounded
