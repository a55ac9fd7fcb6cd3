"""Saved models: a folder of `config.json` and `model.safetensors`, or the name of a model shipped with the package."""

from __future__ import annotations

import json
import warnings
from collections.abc import Mapping
from dataclasses import asdict, fields, replace
from importlib.resources import files
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from torchcrf_scan.checks import from_values
from torchcrf_scan.config import RUN_TIME, InferenceConfig, ModelConfig
from torchcrf_scan.errors import TorchCRFScanError
from torchcrf_scan.whole_file import write_together

PRETRAINED = "encoder"
CONFIG, WEIGHTS = "config.json", "model.safetensors"
PADDED = "thresholds"  # suffix of the names of tensors that are padded with infinity
LARGEST = 1e4  # of a weight; ours are below 50, and an encoder of larger ones overflows single precision
MOST_CONFIG, MOST_WEIGHTS = 1 << 20, 1 << 29  # bytes of the files


def find_weights(name_or_path: str | Path) -> Path:
    """The folder of a saved model, from a path or the name of a shipped model."""
    path = Path(name_or_path)
    if (path / CONFIG).is_file():
        return path
    shipped = Path(str(files("torchcrf_scan") / "weights"))
    if (shipped / str(name_or_path) / CONFIG).is_file():
        return shipped / str(name_or_path)
    names = sorted(entry.name for entry in shipped.iterdir()) if shipped.is_dir() else []
    raise TorchCRFScanError(
        f"name_or_path: expected a folder with config.json or one of {', '.join(names) or 'no'} shipped models, got {path}"
    )


def write_model(folder: Path, config: ModelConfig, state: Mapping[str, Tensor]) -> None:
    """Writes a model; run-time settings (`config.RUN_TIME`) are not written. Both files take their places when both are whole."""
    from safetensors.torch import save

    values = asdict(config)
    for name in RUN_TIME:
        del values["inference"][name]
    folder.mkdir(parents=True, exist_ok=True)
    weights = save({name: value.detach().cpu().contiguous() for name, value in state.items()})
    write_together({folder / CONFIG: json.dumps(values, indent=2) + "\n", folder / WEIGHTS: weights})


def read_config(folder: Path, features: Mapping[str, Any], inference: Mapping[str, Any]) -> ModelConfig:
    """The config of a saved model with some fields changed.

    Raises:
        TorchCRFScanError: a file that is not a valid config, or a value that is out of bounds.
    """
    path = folder / CONFIG
    content = _bytes(path, MOST_CONFIG)
    try:
        config = model_config(json.loads(content))
    except (ValueError, RecursionError) as error:
        raise TorchCRFScanError(f"{path}: {error}") from error
    return replace(config, inference=replace(config.inference, **inference), features=replace(config.features, **features))


def model_config(values: Any) -> ModelConfig:
    """The config from its dictionary (`asdict`); settings missing in older models take the defaults of their time."""
    if isinstance(values, dict):
        values = {name: dict(of) if isinstance(of, dict) else of for name, of in values.items()}
        if isinstance(values.get("inference"), dict):
            _drop_run_time(values["inference"])
        if isinstance(values.get("features"), dict):
            values["features"].setdefault("left_out", ())  # models saved before this setting existed have every feature
            values["features"].setdefault("reach", "hard")  # and only this
    return from_values(ModelConfig, values, "model")


def _drop_run_time(inference: dict[str, Any]) -> None:
    """Removes run-time settings that older versions saved with the weights; warns about values other than the default."""
    defaults = {field.name: field.default for field in fields(InferenceConfig)}
    for name in RUN_TIME:
        value = inference.pop(name, defaults[name])
        if value != defaults[name]:
            told = f"inference.{name} = {value} is not read from saved models, {defaults[name]} is used: give it when loading"
            warnings.warn(told, stacklevel=2)


def load_state(model: nn.Module, folder: Path, fresh: Mapping[str, Tensor]) -> None:
    """Loads the saved tensors into a model; those missing in the file are taken from `fresh`.

    Raises:
        TorchCRFScanError: a damaged file, one of another model, or numbers that are not finite.
    """
    from safetensors import SafetensorError
    from safetensors.torch import load

    path = folder / WEIGHTS
    try:
        saved = load(_bytes(path, MOST_WEIGHTS))
        model.load_state_dict({**fresh, **saved})
    except (SafetensorError, RuntimeError, TypeError, KeyError) as error:
        raise TorchCRFScanError(f"{path}: expected the tensors of the model that {CONFIG} describes, got {error}") from error
    check_weights(str(path), saved)


def check_weights(where: str, weights: Mapping[str, Tensor]) -> None:
    """Raises TorchCRFScanError for the first tensor that is not finite, or beyond `LARGEST`. where: for the message."""
    for name, value in weights.items():
        size = value.double().abs()
        is_right = (size <= LARGEST) | (torch.isinf(size) if name.endswith(PADDED) else False)
        if not is_right.all():
            raise TorchCRFScanError(f"{where}: {name}: expected finite numbers within {LARGEST:g}, got {value[~is_right][0]}")


def _bytes(path: Path, most: int) -> bytes:
    """The content of a file; raises TorchCRFScanError for one that is longer than any model's."""
    with path.open("rb") as file:
        content = file.read(most + 1)
    if len(content) > most:
        raise TorchCRFScanError(f"{path}: expected at most {most} bytes, got more")
    return content
