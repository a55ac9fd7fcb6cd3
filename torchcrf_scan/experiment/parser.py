"""Parser of command line and YAML files of a run, for `train.py` and `torchcrf-scan experiment`."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache
from typing import Any

import yaml
from jsonargparse import ArgumentParser, get_loader, set_loader

from torchcrf_scan.experiment.settings import RunConfig

MOST_VALUES, DEEPEST = 10_000, 50  # limits of a YAML file; ours have some fifty values, four levels deep


def settings_parser(kind: type[ArgumentParser] = ArgumentParser, **options: Any) -> ArgumentParser:
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


def check_size(text: str) -> None:
    """Raises yaml.YAMLError if a text expands to more values or levels than settings need; in time linear in its length."""
    sizes: dict[str, int] = {}  # number of values of every anchor
    open_: list[tuple[str | None, int]] = [(None, 0)]  # anchors being read, with the values in them so far
    for event in yaml.parse(text, yaml.SafeLoader):
        anchor, count = getattr(event, "anchor", None), 0
        if isinstance(event, yaml.CollectionStartEvent):
            open_.append((anchor, 1))
            if anchor is not None:
                sizes[anchor] = MOST_VALUES + 1  # until it is complete: a recursive anchor is infinite
        elif isinstance(event, yaml.CollectionEndEvent):
            anchor, count = open_.pop()
        elif isinstance(event, yaml.ScalarEvent):
            count = 1
        elif isinstance(event, yaml.AliasEvent):
            anchor, count = None, sizes.get(event.anchor, 1)
        if count and anchor is not None:
            sizes[anchor] = count
        open_[-1] = (open_[-1][0], open_[-1][1] + count)
        if open_[-1][1] > MOST_VALUES or len(open_) > DEEPEST:
            raise yaml.YAMLError(f"expected at most {MOST_VALUES} values with aliases written out, {DEEPEST} levels deep, got more")
