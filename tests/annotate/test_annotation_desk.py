"""Saving, order and progress of a folder of annotations, without a page."""

import errno
import json
import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from worked import a_change, case, cases

from torchcrf_scan.annotate.desk import PAUSE, Desk
from torchcrf_scan.annotate.document import assign, drag
from torchcrf_scan.annotate.queue import confidence_of, order
from torchcrf_scan.annotate.store import Progress, Store
from torchcrf_scan.data.pair_file import read_pair, write_pair
from torchcrf_scan.scan import PairPrediction, Scan, ScanPair

CASES = cases()


def body(path: Path) -> list[int]:
    annotation = read_pair(path).annotation
    assert annotation is not None
    return annotation.body.tolist()


def left_over(folder: Path) -> list[Path]:
    """Files that are not whole yet."""
    return [path for path in folder.rglob(".*") if path.is_file()]


def test_the_least_sure_comes_first_and_what_is_done_last(tmp_path: Path) -> None:
    desk = Desk(CASES, Store(tmp_path))
    assert desk.name == "unsure"
    assert desk.ring == ["unsure", "middling", "sure"]
    desk.finish()
    assert desk.name == "middling"
    assert desk.ring == ["middling", "sure", "unsure"]
    desk.go(-1)
    assert desk.name == "unsure"  # back to what was done last
    desk.go(1)
    desk.finish()
    desk.finish()
    assert desk.name == "unsure"
    assert desk.progress.done == ["unsure", "middling", "sure"]
    assert Desk(CASES, Store(tmp_path)).progress.done == desk.progress.done


def test_order_and_confidence_without_answers_or_points() -> None:
    assert order({}, []) == []
    assert order({"a": 0.5, "b": 0.5, "c": 0.1}, ["a", "gone"]) == ["c", "b", "a"]
    nothing = Scan.from_ranges([np.nan], [0.0])
    answer = PairPrediction(np.array([-1]), np.array([-1]), np.zeros((1, 3)), np.zeros(1), np.zeros(1), True)
    assert confidence_of(ScanPair(nothing, nothing), answer) == 1.0
    assert confidence_of(ScanPair(nothing, nothing), None) == 0.0


def test_every_change_is_on_the_disk_and_older_ones_are_kept(tmp_path: Path) -> None:
    store = Store(tmp_path)
    desk = Desk(CASES, store)
    path = store.unfinished("unsure")
    assert not path.exists()
    a_change(desk)
    first = path.read_bytes()
    assert body(path) == [-1] * 5 + [0] * 25
    desk.change(drag(desk.document, 0, np.array([0.0, 0.1, 0.0])))
    second = path.read_bytes()
    desk.undo()
    assert path.read_bytes() == first
    desk.redo()
    assert path.read_bytes() == second
    assert [version.read_bytes() for version in store.versions("unsure")] == [first, second, first]
    again = Desk(CASES, store)  # as after a killed server
    assert np.array_equal(again.document.label, desk.document.label)
    assert np.array_equal(again.document.motions, desk.document.motions)
    assert again.document.held.tolist() == [True]
    assert not left_over(tmp_path)


def test_a_damaged_file_gives_way_to_the_version_before(tmp_path: Path) -> None:
    store = Store(tmp_path)
    desk = Desk(CASES, store)
    a_change(desk)
    label = desk.document.label
    desk.change(assign(desk.document, np.arange(30), -2))
    store.unfinished("unsure").write_bytes(b"half a fi")
    assert np.array_equal(Desk(CASES, store).document.label, label)
    (tmp_path / ".annotate" / "progress.json").write_text("{")
    assert Desk(CASES, store).progress.done == []


def test_a_full_disk_loses_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    store = Store(tmp_path)
    desk = Desk(CASES, store)
    a_change(desk)
    before = store.unfinished("unsure").read_bytes()

    def full(number: int) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(os, "fsync", full)
        desk.change(assign(desk.document, np.arange(10), -2))
        assert "No space left on device" in desk.error
        assert store.unfinished("unsure").read_bytes() == before
        desk.finish()
        assert desk.name == "unsure"
        assert desk.progress.done == []
        desk.go(1)
        assert desk.name == "middling"
        assert desk.error
    desk.save()
    assert not desk.error
    assert body(store.unfinished("unsure")) == [-1] * 10 + [0] * 20
    assert not left_over(tmp_path)


def test_minutes_without_the_pauses(tmp_path: Path) -> None:
    now = [0.0]
    desk = Desk(CASES, Store(tmp_path), clock=lambda: now[0])
    for seconds in (30.0, 10 * PAUSE):
        now[0] += seconds
        a_change(desk)
    desk.finish()
    assert desk.minutes == pytest.approx((30 + PAUSE) / 60)
    assert json.loads((tmp_path / ".annotate" / "progress.json").read_text()) == {"seconds": {"unsure": 90.0}, "done": ["unsure"]}
    assert Store(tmp_path).read_progress() == Progress({"unsure": 90.0}, ["unsure"])


def test_annotations_of_other_scans_are_refused(tmp_path: Path) -> None:
    write_pair(tmp_path / "sure.npz", replace(case("sure", 0.9, 0.5).pair))
    with pytest.raises(ValueError, match=r"expected annotations of these scans, got .*sure\.npz of others"):
        Desk(CASES, Store(tmp_path))
