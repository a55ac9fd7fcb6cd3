"""Saved models come back; what was saved long ago, damaged or made up is read with care."""

import errno
import json
import os
from collections.abc import Callable
from dataclasses import asdict, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from safetensors.numpy import load_file, save_file
from support import normal

from torchcrf_scan import InferenceConfig, JointScanCRF, MatchingCRF, ModelConfig, pretrained
from torchcrf_scan.config import RUN_TIME, EncoderConfig, FeatureConfig
from torchcrf_scan.pretrained import CONFIG, WEIGHTS, find_weights, model_config, read_config

SMALL = ModelConfig(features=FeatureConfig(stumps=2))


@torch.no_grad()
def randomise(model: JointScanCRF) -> JointScanCRF:
    """Weights that are not those of a new model."""
    for k, weight in enumerate(model.parameters()):
        weight.add_(0.1 * normal(1, seed=k)[0])
    return model


@pytest.fixture
def saved(tmp_path: Path) -> Path:
    randomise(JointScanCRF(SMALL)).save_pretrained(tmp_path)
    return tmp_path


@pytest.mark.parametrize("failing", range(3))
def test_a_model_that_cannot_be_written_leaves_the_one_before(saved: Path, failing: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """A flush to the disk fails: of the settings, the weights, and the folder, in which both are by then."""
    other, flushes = JointScanCRF(replace(SMALL, inference=InferenceConfig(clusters=5))), iter(range(3))

    def flush(number: int) -> None:
        if next(flushes) == failing:
            raise OSError(errno.ENOSPC, "No space left on device")

    before = files_of(saved)
    monkeypatch.setattr(os, "fsync", flush)
    with pytest.raises(OSError, match="No space left"):
        other.save_pretrained(saved)
    assert (files_of(saved) == before) == (failing < 2)
    assert JointScanCRF.from_pretrained(saved).config.inference.clusters == (5 if failing == 2 else 8)


def files_of(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir()}


def values_of(folder: Path) -> dict[str, Any]:
    values: dict[str, Any] = json.loads((folder / CONFIG).read_text())
    return values


def changed(folder: Path, change: Callable[[dict[str, Any]], object]) -> None:
    """Changes the config of a saved model."""
    values = values_of(folder)
    change(values)
    (folder / CONFIG).write_text(json.dumps(values))


# --- what comes back ------------------------------------------------------------------------------------------------------------


def test_a_saved_model_comes_back(tmp_path: Path) -> None:
    model = randomise(JointScanCRF(replace(SMALL, encoder=EncoderConfig(width=4, dilations=(1, 3)))))
    model.save_pretrained(tmp_path / "model")
    again = JointScanCRF.from_pretrained(tmp_path / "model")
    assert again.config == model.config
    assert not again.training
    for name, value in model.state_dict().items():
        assert torch.equal(again.state_dict()[name], value), name
    assert sorted(path.name for path in (tmp_path / "model").iterdir()) == [CONFIG, WEIGHTS]


def test_what_is_run_time_only_is_not_saved(tmp_path: Path) -> None:
    changes = {"backend": "eager", "stop_early": False, "detach_motion": True}
    changes |= {"rotation_tolerance": 1e-6, "translation_tolerance": 0.5}  # type: ignore[dict-item]
    assert tuple(sorted(changes)) == tuple(sorted(RUN_TIME))
    JointScanCRF(replace(SMALL, inference=InferenceConfig(clusters=5, **changes))).save_pretrained(tmp_path)  # type: ignore[arg-type]
    kept = {field.name for field in fields(InferenceConfig)} - set(RUN_TIME)
    assert set(values_of(tmp_path)["inference"]) == kept
    assert JointScanCRF.from_pretrained(tmp_path).config.inference == InferenceConfig(clusters=5)
    assert JointScanCRF.from_pretrained(tmp_path, **changes).config.inference == InferenceConfig(clusters=5, **changes)  # type: ignore[arg-type]


def test_a_model_of_one_chain_says_so(tmp_path: Path) -> None:
    MatchingCRF(replace(SMALL, inference=InferenceConfig(clusters=5))).save_pretrained(tmp_path)
    assert values_of(tmp_path)["chains"] == "matching"
    assert values_of(tmp_path)["inference"]["clusters"] == 5


def test_any_setting_of_the_inference_may_change_on_loading(saved: Path) -> None:
    changes = {"candidates": 0, "schedule": "flooding", "backend": "eager", "min_extent": 1, "rotation_tolerance": 0}
    found = JointScanCRF.from_pretrained(saved, **changes).config.inference
    assert found == InferenceConfig(**changes)  # type: ignore[arg-type]
    assert isinstance(found.min_extent, float)  # machine code is made for each type
    assert isinstance(found.rotation_tolerance, float)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"schedule": "slow"}, "schedule: expected one of sweep, flooding, got slow"),
        ({"clusters": 2.5}, r"clusters: expected a whole number in \[2, 32\], got 2.5"),
        ({"clusters": 10**9}, r"clusters: expected a whole number in \[2, 32\], got 1000000000"),
        ({"candidates": 10_000}, r"candidates: expected a whole number in \[0, 256\], got 10000"),
        ({"temperature": float("nan")}, "temperature: expected a finite number, 0 or more, got nan"),
        ({"min_extent": -1}, "min_extent: expected a finite number, 0 or more, got -1"),
        ({"features": {"stumps": -1}}, r"stumps: expected a whole number in \[1, 10000\], got -1"),
    ],
)
def test_a_wrong_change_is_refused(change: dict[str, Any], message: str, saved: Path) -> None:
    with pytest.raises(ValueError, match=f"^{message}$"):
        JointScanCRF.from_pretrained(saved, **change)


def test_a_setting_that_there_is_not_is_no_argument(saved: Path) -> None:
    with pytest.raises(TypeError, match="speed"):
        JointScanCRF.from_pretrained(saved, speed=3)


# --- what was saved before ------------------------------------------------------------------------------------------------------


def before(**inference: object) -> dict[str, Any]:
    """A config as it was once saved, with everything of the inference."""
    values = json.loads(json.dumps(asdict(ModelConfig())))
    values["inference"] |= inference
    return dict(values)


def test_configs_with_what_is_run_time_only_are_read() -> None:
    assert model_config(before()) == ModelConfig()


@pytest.mark.parametrize(("name", "value"), [("backend", "eager"), ("stop_early", False), ("rotation_tolerance", 0.5)])
def test_what_is_no_longer_read_is_told_where_it_matters(name: str, value: object) -> None:
    with pytest.warns(UserWarning, match=f"inference.{name} = {value} is not read from saved models, .* is used"):
        assert model_config(before(**{name: value})) == ModelConfig()


def test_configs_of_the_time_before_there_were_encoders_and_features_left_out() -> None:
    values = before()
    del values["encoder"], values["features"]["left_out"], values["inference"]["movers"]
    assert model_config(values) == ModelConfig(features=FeatureConfig(left_out=()))
    assert values["inference"]["backend"] == "auto"  # what was given is not changed


@pytest.mark.parametrize("name", ["simulated", "encoder"])
def test_the_shipped_models_are_of_this_time(name: str) -> None:
    folder = find_weights(name)
    config = read_config(folder, {}, {})
    assert config.inference == InferenceConfig()
    assert (config.encoder.width > 0) == (name == "encoder")
    assert not set(RUN_TIME) & set(values_of(folder)["inference"])


# --- what is damaged or made up -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("[]", r"model: expected settings by name, got \[\]"),
        ("null", "model: expected settings by name, got None"),
        ("3", "model: expected settings by name, got 3"),
        ("", "Expecting value"),
        ('{"chains": ', "Expecting value"),
        ("[" * 100_000, "recursion"),
        ('{"speed": 3}', "model: expected settings among chains, .*, got speed"),
        ('{"inference": []}', r"inference: expected settings by name, got \[\]"),
        ('{"inference": {"clusters": 2.5}}', r"clusters: expected a whole number in \[2, 32\], got 2.5"),
        ('{"inference": {"clusters": 1000000000}}', "clusters: expected a whole number"),
        ('{"inference": {"temperature": NaN}}', "temperature: expected a finite number, 0 or more, got nan"),
        ('{"inference": {"temperature": 1e999}}', "temperature: expected a finite number, 0 or more, got inf"),
        ('{"features": {"left_out": "association.dist1"}}', "left_out: expected a list, got association.dist1"),
        ('{"features": null}', "features: expected settings by name, got None"),
        ('{"encoder": {"dilations": [0]}}', r"encoder.dilations: expected a whole number in \[1, 10000\], got 0"),
        (
            '{"encoder": {"dilations": [1,1,1,1,1,1,1,1,1,1,1,1,1,1,1,1,1]}}',
            "encoder.dilations: expected a list of at most 16, got",
        ),
        ('{"chains": ["joint"]}', r"chains: expected one of joint, matching, clustering, got \['joint'\]"),
    ],
)
def test_a_config_that_is_none_is_a_value_error_with_its_file(text: str, message: str, saved: Path) -> None:
    (saved / CONFIG).write_text(text)
    with pytest.raises(ValueError, match=f"^{saved / CONFIG}: .*{message}"):
        JointScanCRF.from_pretrained(saved)


@pytest.mark.parametrize(("part", "value"), [("sequence", np.nan), ("sequence", np.inf), ("sequence", 2e4), ("thresholds", np.nan)])
def test_weights_that_are_no_numbers_are_refused(part: str, value: float, saved: Path) -> None:
    tensors = load_file(saved / WEIGHTS)
    name = next(name for name in sorted(tensors) if name.endswith(part))
    tensors[name] = np.full_like(tensors[name], value)
    save_file(tensors, saved / WEIGHTS)
    with pytest.raises(ValueError, match=f"{WEIGHTS}: {name}: expected finite numbers within 10000, got {value}"):
        JointScanCRF.from_pretrained(saved)


@pytest.mark.parametrize("content", [b"", b"half a file", None])
def test_weights_that_are_none_are_refused(content: bytes | None, saved: Path) -> None:
    whole = (saved / WEIGHTS).read_bytes()
    (saved / WEIGHTS).write_bytes(whole[: len(whole) // 2] if content is None else content)
    with pytest.raises(ValueError, match=f"^{saved / WEIGHTS}: expected the tensors of the model"):
        JointScanCRF.from_pretrained(saved)


def test_files_longer_than_a_models_are_not_read(saved: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name, limit in ((WEIGHTS, "MOST_WEIGHTS"), (CONFIG, "MOST_CONFIG")):
        monkeypatch.setattr(pretrained, limit, 100)
        with pytest.raises(ValueError, match=f"^{saved / name}: expected at most 100 bytes, got more"):
            JointScanCRF.from_pretrained(saved)


def test_weights_of_another_model_are_refused(saved: Path) -> None:
    changed(saved, lambda values: values["features"].update(stumps=7))
    with pytest.raises(ValueError, match=f"^{saved / WEIGHTS}: expected the tensors of the model that config.json describes, got"):
        JointScanCRF.from_pretrained(saved)


def test_a_full_disk_keeps_the_model_that_was_there(saved: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    kept = [(saved / name).read_bytes() for name in (CONFIG, WEIGHTS)]
    monkeypatch.setattr(os, "replace", lambda *_: (_ for _ in ()).throw(OSError("No space left on device")))
    with pytest.raises(OSError, match="No space left"):
        randomise(JointScanCRF()).save_pretrained(saved)
    monkeypatch.undo()
    assert [(saved / name).read_bytes() for name in (CONFIG, WEIGHTS)] == kept


def test_an_unknown_name_lists_the_shipped_ones(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("one", "other"):
        JointScanCRF(SMALL).save_pretrained(tmp_path / "weights" / name)
    monkeypatch.setattr("torchcrf_scan.pretrained.files", lambda package: tmp_path)
    with pytest.raises(ValueError, match=r"expected a folder with config\.json or one of one, other shipped models, got nowhere"):
        JointScanCRF.from_pretrained("nowhere")
    assert len(JointScanCRF.from_pretrained("other").state_dict()) > 30
