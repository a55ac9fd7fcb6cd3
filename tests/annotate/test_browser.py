"""The page in a browser without a window: what mouse and keys do is read from the saved files."""

import shutil
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from serving import Serve, saved, saved_file, title_of

from torchcrf_scan.annotate.store import Store
from torchcrf_scan.data.pair_file import read_pair
from torchcrf_scan.geometry import se2

pytest.importorskip("bokeh", reason="the library bokeh is not installed (extra `annotate`)")
webdriver = pytest.importorskip("selenium.webdriver", reason="the library selenium is not installed")
BROWSER, DRIVER = (shutil.which("chromium") or shutil.which("chromium-browser")), shutil.which("chromedriver")
pytestmark = pytest.mark.skipif(not (BROWSER and DRIVER), reason="needs chromium and chromedriver on the PATH")

PATIENCE = 60.0  # seconds
ALONE = ["headless", "no-sandbox", "disable-gpu", "disable-quic", "no-first-run", "disable-sync"]
ALONE += ["disable-background-networking", "disable-component-update"]
READY = "return window.Bokeh !== undefined && Boolean(Bokeh.documents[0]?.is_idle)"
POINTS = """
const doc = Bokeh.documents[0], plot = doc.get_model_by_name("scans"), frame = Bokeh.index.find_one(plot).frame
const {x, y, color} = doc.get_model_by_name("source").data
const xs = Array.from(x), ys = Array.from(y)
return [xs.map((v) => frame.x_scale.compute(v)), ys.map((v) => frame.y_scale.compute(v)), Array.from(color), xs, ys]
"""
SELECTED = 'return Bokeh.documents[0].get_model_by_name("source").selected.indices'


@pytest.fixture
def browser(tmp_path: Path) -> Iterator[Any]:
    options = webdriver.ChromeOptions()
    options.binary_location = str(BROWSER)
    for argument in (*ALONE, "window-size=1400,900", f"user-data-dir={tmp_path / 'profile'}"):
        options.add_argument(f"--{argument}")
    driver = webdriver.Chrome(options=options, service=webdriver.ChromeService(str(DRIVER)))
    yield driver
    driver.quit()


def until(what: Callable[[], Any]) -> Any:
    """The first true answer; fails after some time without one."""
    end = time.monotonic() + PATIENCE
    while time.monotonic() < end:
        found = what()
        if found:
            return found
        time.sleep(0.1)
    raise AssertionError("it did not happen in time")


class Window:
    """The page as a user has it before them."""

    def __init__(self, driver: Any, address: str) -> None:
        self.driver = driver
        driver.get(address)
        self.wait()

    def wait(self) -> None:
        """Until the points are drawn."""
        until(lambda: self.driver.execute_script(READY))
        until(self._is_still)

    def _is_still(self) -> bool:
        before = self.points()[0]
        time.sleep(0.5)
        return before.size > 0 and np.array_equal(before, self.points()[0])

    def points(self) -> tuple[np.ndarray, np.ndarray, list[str]]:
        """Where the points are, in pixels (2, N) and in metres (2, N), and their colours."""
        x, y, color, x_metres, y_metres = self.driver.execute_script(POINTS)
        return np.array([x, y], float), np.array([x_metres, y_metres], float), color

    def shown(self, what: str = "title") -> str:
        """The name of the pair on the page, or another text there."""
        text = self.driver.execute_script(f"return Bokeh.documents[0].get_model_by_name('{what}').text")
        return title_of(text) if what == "title" else text

    def press(self, key: str) -> None:
        webdriver.ActionChains(self.driver).send_keys(key).perform()

    def drag(self, path: Sequence[tuple[float, float]], held: str = "") -> None:
        """Along a path of pixels with the button down. held: a key."""
        if held:
            webdriver.ActionChains(self.driver).key_down(held).perform()
        actions = webdriver.ActionChains(self.driver, duration=50)
        pointer = actions.w3c_actions.pointer_action
        pointer.move_to_location(*map(int, path[0]))
        pointer.pointer_down()
        for place in path[1:]:
            pointer.move_to_location(*map(int, place))
        pointer.pointer_up()
        actions.perform()
        if held:
            webdriver.ActionChains(self.driver).key_up(held).perform()

    def click(self, point: int) -> None:
        """On a point, until it is selected: a browser that is busy takes a click for a long press."""
        until(lambda: self.drag([self.points()[0][:, point]] * 2) or self.driver.execute_script(SELECTED) == [point])

    def point(self, x: float, y: float) -> None:
        """Moves the mouse."""
        actions = webdriver.ActionChains(self.driver)
        actions.w3c_actions.pointer_action.move_to_location(int(x), int(y))
        actions.perform()

    def lasso(self, x: float, y: float, half: float) -> np.ndarray:
        """A square about a place; the points in it."""
        where = self.points()[0]
        self.drag([(x + a * half, y + b * half) for a, b in ((-1, -1), (1, -1), (1, 1), (-1, 1), (-1, -1))])
        return np.flatnonzero((abs(where - [[x], [y]]) < half - 1).all(axis=0))

    def middle(self) -> tuple[float, float]:
        """Where the point nearest to the middle of all is."""
        x, y = self.points()[0]
        i = int(np.argmin(np.hypot(x - np.median(x), y - np.median(y))))
        return int(x[i]), int(y[i])


def test_lasso_assign_drag_undo_kill_and_reopen(browser: Any, serve: Serve, tmp_path: Path) -> None:
    output = tmp_path / "annotated"
    process, address = serve(output)
    window = Window(browser, address)
    name = window.shown()

    # a lasso around some points, given to a new mover
    before, (left, top) = window.points()[2], window.middle()
    inside = window.lasso(left, top, 30)
    assert len(inside) > 0
    window.press("n")
    until(lambda: saved_file(output, name).exists())
    first = saved(output, name)
    beams = read_pair(saved_file(output, name)).source.beam[inside]
    mover = first.body[beams[0]]
    assert mover > 0
    assert np.flatnonzero(first.body == mover).tolist() == sorted(beams.tolist())
    assert np.isfinite(first.motions[mover]).all()

    # dragged by hand: 40 pixels to the right
    window.press("m")
    (x, _), (metres, _), _ = window.points()
    scale = np.ptp(metres) / np.ptp(x)
    window.drag([(left, top), (left + 20, top), (left + 40, top)])
    until(lambda: not np.array_equal(saved(output, name).motions, first.motions, equal_nan=True))
    turn, shift = se2.distance(saved(output, name).motions[mover], first.motions[mover])
    assert turn < 1e-9
    assert shift == pytest.approx(40 * scale, rel=0.1)

    # undone, then moved by a key
    window.press("z")
    until(lambda: np.array_equal(saved(output, name).motions, first.motions, equal_nan=True))
    window.press("\ue014")  # arrow right
    moved = until(lambda: (a := saved(output, name)) and not np.array_equal(a.motions, first.motions, equal_nan=True) and a)
    assert moved.motions[mover] - first.motions[mover] == pytest.approx([0, 0.01, 0], abs=1e-9)
    assert browser.save_screenshot(str(tmp_path / "page.png"))

    # the window is loaded again: the history is still there
    browser.refresh()
    window.wait()
    window.press("z")
    until(lambda: np.array_equal(saved(output, name).motions, first.motions, equal_nan=True))
    colours = window.points()[2]
    assert [i for i, (a, b) in enumerate(zip(before, colours, strict=True)) if a != b] == inside.tolist()

    # the server is killed and begins anew
    process.kill()
    process.join()
    window = Window(browser, serve(output)[1])
    assert name == window.shown()
    assert window.points()[2] == colours
    window.press("\ue007")  # Enter
    until((output / f"{name}.npz").exists)
    until(lambda: window.shown() != name)
    assert Store(output).read_progress().done == [name]
    assert np.array_equal(saved(output, name).body, first.body)


def test_the_keys_alone_and_a_click(browser: Any, serve: Serve, tmp_path: Path) -> None:
    window = Window(browser, serve(tmp_path)[1])
    name = window.shown()
    width = np.ptp(window.points()[0][0])
    window.press("+")
    until(lambda: np.ptp(window.points()[0][0]) > 1.1 * width)
    x, _ = window.points()[0]
    for key in "p\ue014l":  # mode pan, arrow right
        window.press(key)
    until(lambda: (window.points()[0][0] < x - 10).all())
    window.press("h")
    until(lambda: np.ptp(window.points()[0][0]) == pytest.approx(width, rel=0.01))

    window.press(".")  # the first point
    window.press("u")
    until(lambda: saved_file(tmp_path, name).exists())
    pair = read_pair(saved_file(tmp_path, name))
    assert saved(tmp_path, name).ignore[pair.source.beam[0]]
    assert not saved(tmp_path, name).ignore[pair.source.beam[1:]].any()

    association = saved(tmp_path, name).association[pair.source.beam]
    where = np.flatnonzero(association >= 0)[0]
    for _ in range(where + 1):
        window.press(".")
    window.press("x")  # no counterpart
    until(lambda: saved(tmp_path, name).association[pair.source.beam[where]] == -1)
    assert saved(tmp_path, name).body[pair.source.beam[where]] >= 0

    x, y = window.points()[0]
    alone = int(np.argmax([np.sort(np.hypot(x - a, y - b))[1] for a, b in zip(x, y, strict=True)]))
    window.click(alone)
    window.press("n")
    until(lambda: saved(tmp_path, name).body[pair.source.beam[alone]] > 0)

    before = saved(tmp_path, name)
    window.press("\ue00f")  # page down
    until(lambda: window.shown() != name)
    window.press("\ue00e")  # page up
    until(lambda: window.shown() == name)
    assert np.array_equal(saved(tmp_path, name).body, before.body)


SHIFT = "\ue008"
RINGS = POINTS.replace('"source"', '"target"').replace("const {x, y, color}", "const {x, y, color = []}")


def loneliest(places: np.ndarray, others: np.ndarray, is_meant: np.ndarray | bool = True) -> int:
    """The place (2, N) in the picture, in pixels, that is farthest from the nearest of all others (2, M)."""
    pixels = np.hypot(*(places[:, :, None] - np.concatenate([places, others], axis=1)[:, None]))
    apart = np.where(pixels > 0, pixels, np.inf).min(axis=1)
    is_shown = (abs(places - [[500], [350]]) < [[400], [300]]).all(axis=0)
    return int(np.argmax(np.where(is_shown & is_meant, apart, -1)))


def test_shift_turns_a_body_and_a_ties_to_the_ring_at_the_mouse(browser: Any, serve: Serve, tmp_path: Path) -> None:
    window = Window(browser, serve(tmp_path)[1])
    name = window.shown()
    x, y = window.middle()
    assert len(window.lasso(x, y, 40)) > 1
    window.press("n")
    first = until(lambda: saved_file(tmp_path, name).exists() and saved(tmp_path, name))
    (mover,) = {*first.body.tolist()} - {*range(-1, len(first.motions) - 1)}
    pair = read_pair(saved_file(tmp_path, name))
    is_mover = first.body[pair.source.beam] == mover
    points = pair.source.points[is_mover]

    # turned about its centre, which stays where it is
    window.press("m")
    window.drag([(x + 50, y), (x + 50, y - 20), (x + 50, y - 50)], SHIFT)
    turned = until(lambda: (a := saved(tmp_path, name)) and not np.array_equal(a.motions, first.motions, equal_nan=True) and a)
    moved, before = (se2.apply(a.motions[mover], points) for a in (turned, first))
    np.testing.assert_allclose(moved.mean(axis=0), before.mean(axis=0), atol=1e-6)
    assert 0.2 < se2.wrap(turned.motions[mover, 0] - first.motions[mover, 0]) < 1.4  # anticlockwise, by about 45 degrees
    window.press("z")
    until(lambda: np.array_equal(saved(tmp_path, name).motions, first.motions, equal_nan=True))
    until(lambda: np.allclose(window.points()[1].T[is_mover], se2.apply(first.motions[mover], points)))  # drawn after it is saved

    # a point is tied to the ring at the mouse
    window.press("l")
    dots, rings = window.points()[0], np.array(browser.execute_script(RINGS)[:2], float)
    is_body = saved(tmp_path, name).body[pair.source.beam] >= 0
    point, ring = loneliest(dots, rings, is_body), loneliest(rings, dots)
    window.click(point)
    window.point(*rings[:, ring])
    window.press("a")
    until(lambda: saved(tmp_path, name).association[pair.source.beam[point]] == pair.target.beam[ring])


def test_two_windows_show_the_same_and_lose_nothing(browser: Any, serve: Serve, tmp_path: Path) -> None:
    _, address = serve(tmp_path)
    first = Window(browser, address)
    browser.switch_to.new_window("window")
    second, name = Window(browser, address), first.shown()
    handles = browser.window_handles
    second.press(".")
    second.press("u")
    pair = until(lambda: saved_file(tmp_path, name).exists() and read_pair(saved_file(tmp_path, name)))
    browser.switch_to.window(handles[0])
    until(lambda: first.points()[2] == ["#FFFFFF", *first.points()[2][1:]])
    first.press(".")
    first.press(",")  # the last point
    first.press("u")
    until(lambda: saved(tmp_path, name).ignore[pair.source.beam].tolist() == [True, *[False] * (len(pair.source) - 2), True])
    browser.switch_to.window(handles[1])
    until(lambda: second.points()[2][-1] == "#FFFFFF")
    second.press("\ue007")
    until((tmp_path / f"{name}.npz").exists)
    browser.switch_to.window(handles[0])
    assert until(lambda: first.shown() != name)


def test_a_full_disk_is_told_on_the_page(browser: Any, serve: Serve, tmp_path: Path) -> None:
    full, output = tmp_path / "full", tmp_path / "annotated"
    window = Window(browser, serve(output, full=full)[1])
    name = window.shown()
    window.press(".")
    window.press("o")
    until(lambda: saved_file(output, name).exists())
    before = saved_file(output, name).read_bytes()
    full.touch()
    window.press(".")
    window.press("u")
    until(lambda: "Not saved" in window.shown("error"))
    assert "No space left on device" in window.shown("error")
    window.press("\ue007")  # Enter
    time.sleep(1)
    assert window.shown() == name
    assert saved_file(output, name).read_bytes() == before
    assert [path for path in output.rglob("*.npz*") if path.name != f"{name}.npz"] == [*output.rglob("00001.npz")]
    full.unlink()
    until(lambda: not window.shown("error"))
    pair = read_pair(saved_file(output, name))
    assert saved(output, name).ignore[pair.source.beam[0]]
    window.press("\ue007")
    until((output / f"{name}.npz").exists)
