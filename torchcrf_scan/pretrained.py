"""."""

from __future__ import annotations

from importlib.resources import files
from pathlib import Path
from typing import Any

from torchcrf_scan.config import EncoderConfig, FeatureConfig, InferenceConfig, ModelConfig

PRETRAINED = "simulated"


def model_config(values: dict[str, Any]) -> ModelConfig:
    """The config that `asdict` made into a dictionary."""
    return ModelConfig(
        **{k: v for k, v in values.items() if k not in ("features", "inference", "encoder")},
        features=FeatureConfig(**{**values["features"], "left_out": tuple(values["features"].get("left_out", ()))}),
        inference=InferenceConfig(**values["inference"]),
        encoder=encoder_config(values.get("encoder", {})),
    )


def encoder_config(values: dict[str, Any]) -> EncoderConfig:
    """The config that `asdict` made into a dictionary; none of models that were saved before there were encoders."""
    return EncoderConfig(**{**values, "dilations": tuple(values["dilations"])}) if values else EncoderConfig()


def find_weights(name_or_path: str | Path) -> Path:
    """The folder of a saved model: a path, or the name of one that the package ships."""
    path = Path(name_or_path)
    if (path / "config.json").is_file():
        return path
    shipped = Path(str(files("torchcrf_scan") / "weights"))
    if (shipped / str(name_or_path) / "config.json").is_file():
        return shipped / str(name_or_path)
    names = sorted(entry.name for entry in shipped.iterdir()) if shipped.is_dir() else []
    raise ValueError(
        f"name_or_path: expected a folder with config.json or one of {', '.join(names) or 'no'} shipped models, got {path}"
    )
