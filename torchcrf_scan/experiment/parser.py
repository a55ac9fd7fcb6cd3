"""The command line and the YAML files of every setting of a run, for `train.py` and `torchcrf-scan experiment`."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache
from typing import Any

import yaml
from jsonargparse import ArgumentParser, get_loader, set_loader

from torchcrf_scan.experiment.settings import RunConfig

MOST_VALUES = 10_000  # of a YAML file, aliases written out; ours have some fifty


def settings_parser(**options: Any) -> ArgumentParser:
    """A parser of the fields of `RunConfig`, from YAML files (`--config`) and one by one. options: of `ArgumentParser`."""
    _bound_yaml()
    parser = ArgumentParser(**options)
    parser.add_argument("--config", action="config", help="YAML file of settings")
    parser.add_class_arguments(RunConfig)
    return parser


def config_of(settings: Mapping[str, Any]) -> RunConfig:
    """The config from what the parser has instantiated; what it has parsed besides does not count."""
    return RunConfig(**{name: value for name, value in settings.items() if name in RunConfig.__dataclass_fields__})


def load_yaml(text: str) -> Any:
    """What a YAML text says.

    Raises:
        yaml.YAMLError: no YAML, or one whose aliases, or whose depth, are beyond what settings need.
    """
    return _bound_yaml()(text)


@cache
def _bound_yaml() -> Any:
    """Has the parser refuse a text that unfolds to more than `MOST_VALUES`, as nested aliases do; returns its loader."""
    load = get_loader("yaml")

    def load_bounded(text: str) -> Any:
        try:
            if "*" in text and _values(yaml.compose(text, yaml.SafeLoader), {}) > MOST_VALUES:
                raise yaml.YAMLError(f"expected at most {MOST_VALUES} values, aliases written out, got more")
            return load(text)
        except RecursionError as error:
            raise yaml.YAMLError("expected settings a few levels deep, got a text without end") from error

    set_loader("yaml", load_bounded, (yaml.YAMLError,))
    return load_bounded


def _values(node: yaml.Node | None, known: dict[int, int]) -> int:
    """How many values a text unfolds to from a node on; an alias leads to the node that was counted before."""
    if node is None or isinstance(node.value, str):
        return 1
    if id(node) not in known:
        known[id(node)] = MOST_VALUES + 1  # until it is counted: a node within itself has no end
        parts = [part for entry in node.value for part in (entry if isinstance(entry, tuple) else (entry,))]
        known[id(node)] = 1 + sum(_values(part, known) for part in parts)
    return known[id(node)]
