"""The page's side of the server: what keys do, and what windows that are open at once know of each other."""

import errno
import os

import numpy as np
import pytest
from worked import cases

pytest.importorskip("bokeh", reason="the library bokeh is not installed (extra `annotate`)")
from pathlib import Path
from types import SimpleNamespace

from bokeh.document import Document as BokehDocument

from torchcrf_scan.annotate.desk import Desk
from torchcrf_scan.annotate.keys import ACTIONS
from torchcrf_scan.annotate.page import BUTTONS, MODES, Page
from torchcrf_scan.annotate.store import Store


def windows(folder: Path, number: int = 1) -> tuple[Desk, list[Page]]:
    """Windows that are not told of each other: as in the moment before one is drawn again."""
    desk = Desk(cases(), Store(folder))
    return desk, [Page(BokehDocument(), desk, lambda page: None) for _ in range(number)]


def mouse(x: float, y: float, **modifiers: bool) -> SimpleNamespace:
    return SimpleNamespace(x=x, y=y, modifiers=modifiers)


def drag_without_end(page: Page, *places: SimpleNamespace) -> None:
    page.mode.active = MODES.index("move")
    page._grab(places[0])
    for place in places[1:]:
        page._pull(place)


def test_every_key_does_something(tmp_path: Path) -> None:
    desk, (page,) = windows(tmp_path)
    assert {key for row in BUTTONS for _, key in row} <= set(ACTIONS)

    def seen() -> tuple:
        return desk.name, desk.document, [*page.chosen], page.active, page.is_own, [*page.picture._frame.data["x"]]

    for key in (key for key, action in ACTIONS.items() if action != "browser" and key not in "3456789"):
        while desk.document.movers:
            desk.undo()
        page.picture.choose(np.array([4, 5]))
        page.press("n")
        page.picture.choose(np.array([2]))
        if key in ("y", "ctrl+y", "ctrl+Z"):
            page.press("z")
        if key in "ci":
            page.picture.choose(np.zeros(0, np.int64))
        if key == "h":
            page.press("i")
        before = seen()
        page.press(key, mouse=(3, 1))
        assert seen() != before, key
        assert not page.message, key


def test_without_a_selection_the_page_says_what_is_missing(tmp_path: Path) -> None:
    desk, (page,) = windows(tmp_path)
    before = desk.document
    for key in "ngoux<r":
        page.press(key)
        assert "select points first" in page.error.text
    page.picture.choose(np.array([2]))
    page.press("a")
    assert "point at a ring" in page.error.text
    page.press("5")
    assert "expected a mover up to 1, got 5" in page.error.text
    assert desk.document is before


def test_a_drag_keeps_what_another_window_did_meanwhile(tmp_path: Path) -> None:
    desk, (page, other) = windows(tmp_path, 2)
    drag_without_end(page, mouse(0, 0), mouse(0.1, 0))
    other.picture.choose(np.arange(5))
    other.press("o")
    page._drop(mouse(0.2, 0))
    assert desk.document.label.tolist() == [-1] * 5 + [0] * 25
    np.testing.assert_allclose(desk.document.motions[0], [0, 0.2, 0], atol=1e-12)


def test_a_selection_is_not_used_for_a_pair_that_another_window_has_opened(tmp_path: Path) -> None:
    desk, (page, other) = windows(tmp_path, 2)
    page.picture.choose(np.arange(5))
    drag_without_end(page, mouse(0, 0), mouse(0.1, 0))
    other.press("Enter")
    before = desk.document
    page.press("o")
    assert desk.document is before
    assert "another window has opened this pair" in page.error.text
    assert not len(page.chosen)
    page._drop(mouse(1, 0))
    assert desk.document is before
    page.press("o")
    assert "select points first" in page.error.text


def test_a_mover_that_another_window_has_emptied_is_active_no_more(tmp_path: Path) -> None:
    _, (page, other) = windows(tmp_path, 2)
    page.picture.choose(np.arange(5))
    page.press("n")
    assert page.active == 1
    other.press("z")
    for key in ("c", "[", "f", "s"):
        page.active = 1
        page.press(key)
        assert not page.message
    assert page.active == 0
    assert len(page.chosen) == 30


def test_all_windows_tell_of_a_full_disk_until_there_is_room(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pages: list[Page] = []
    desk = Desk(cases(), Store(tmp_path))
    pages += [Page(BokehDocument(), desk, lambda by: [page.draw() for page in pages if page is not by]) for _ in range(2)]

    def full(number: int) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    with monkeypatch.context() as patch:
        patch.setattr(os, "fsync", full)
        pages[0].picture.choose(np.arange(5))
        pages[0].press("o")
        pages[1]._retry()
        assert all("Not saved" in page.error.text and "No space left on device" in page.error.text for page in pages)
        assert not list(tmp_path.rglob("*.npz*"))
    pages[1]._retry()
    assert not any(page.error.text for page in pages)
    assert Store(tmp_path).unfinished(desk.name).exists()
