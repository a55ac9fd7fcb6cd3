"""A checkpoint is there whole or not at all, and the last good one stays."""

import errno
import logging
import os
import random
from pathlib import Path

import numpy as np
import pytest
import torch

from torchcrf_scan.learning import checkpoint
from torchcrf_scan.learning.checkpoint import Store, random_state, set_random_state


def fail(*_: object) -> None:
    raise OSError(errno.ENOSPC, "No space left on device")


def state(step: int) -> dict[str, object]:
    return {"step": step, "weights": torch.full((3,), float(step))}


def test_what_was_written_is_read(tmp_path: Path) -> None:
    store = Store(tmp_path, {"gradient.steps": "6"})
    assert store.read() is None
    assert store.write(4, state(4))
    found = Store(tmp_path, {"gradient.steps": "6"}).read()
    assert found is not None
    assert found["step"] == 4
    assert torch.equal(found["weights"], torch.full((3,), 4.0))
    assert [path.name for path in tmp_path.iterdir()] == [checkpoint.NAME]


@pytest.mark.parametrize("call", ["fsync", "replace"])
def test_a_full_disk_keeps_the_last_good_one_and_says_so(
    call: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    store = Store(tmp_path, {})
    assert store.write(2, state(2))
    before = store.path.read_bytes()
    with monkeypatch.context() as patch, caplog.at_level(logging.WARNING):
        patch.setattr(os, call, fail)
        assert not store.write(4, state(4))
    assert "checkpoint of step 4 not written" in caplog.text
    assert "No space left on device" in caplog.text
    assert "that of step 2 is kept" in caplog.text
    assert store.path.read_bytes() == before
    assert [path.name for path in tmp_path.iterdir()] == [checkpoint.NAME]
    assert store.write(6, state(6))  # there is room again
    found = store.read()
    assert found is not None
    assert found["step"] == 6


def test_what_a_killed_process_left_is_cleared_away(tmp_path: Path) -> None:
    store = Store(tmp_path, {})
    store.write(2, state(2))
    (tmp_path / f".{checkpoint.NAME}.123").write_bytes(b"half")
    assert store.read() is not None
    assert [path.name for path in tmp_path.iterdir()] == [checkpoint.NAME]


def test_other_settings_are_refused_by_name(tmp_path: Path) -> None:
    Store(tmp_path, {"gradient.steps": "6", "gradient.seed": "0"}).write(2, state(2))
    with pytest.raises(ValueError, match=r"expected the settings of the run .*, got gradient\.seed = '1' after '0'"):
        Store(tmp_path, {"gradient.steps": "6", "gradient.seed": "1"}).read()


@pytest.mark.parametrize("content", [b"", b"not a checkpoint", b"PK\x03\x04 half a zip"])
def test_a_broken_file_is_named(content: bytes, tmp_path: Path) -> None:
    store = Store(tmp_path, {})
    store.path.write_bytes(content)
    with pytest.raises(ValueError, match=r"resume: expected a checkpoint of this program, got .*checkpoint\.pt"):
        store.read()


@pytest.mark.parametrize("part", ["model", "best"])
def test_weights_that_are_no_numbers_are_refused(part: str, tmp_path: Path) -> None:
    store = Store(tmp_path, {})
    store.write(2, state(2) | {part: {"chain.weight": torch.tensor([1.0, torch.nan])}})
    with pytest.raises(ValueError, match=rf"checkpoint\.pt: {part}: chain\.weight: expected finite numbers .*, got nan"):
        store.read()


def test_all_generators_go_on_where_they_were(tmp_path: Path) -> None:
    def draw() -> tuple[float, float, float]:
        return float(torch.rand(())), float(np.random.rand()), random.random()

    draw()
    store = Store(tmp_path, {})
    np.random.randn()  # leaves a spare normal number behind
    store.write(0, {"step": 0})
    expected = draw(), np.random.randn()
    torch.manual_seed(5)
    np.random.seed(5)
    random.seed(5)
    found = store.read()
    assert found is not None
    set_random_state(found["random"])
    assert (draw(), np.random.randn()) == expected
    assert set(random_state()) >= {"torch", "numpy", "python"}
