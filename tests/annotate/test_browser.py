"""The page in a browser without a window: what mouse and keys do is read from the saved files."""

import json
import shutil
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from serving import Serve

from torchcrf_scan.data.pair_file import read_pair
from torchcrf_scan.geometry import se2
from torchcrf_scan.scan import Annotation

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

    def press(self, key: str) -> None:
        webdriver.ActionChains(self.driver).send_keys(key).perform()

    def drag(self, path: Sequence[tuple[float, float]]) -> None:
        """Along a path of pixels with the button down."""
        actions = webdriver.ActionChains(self.driver, duration=50)
        pointer = actions.w3c_actions.pointer_action
        pointer.move_to_location(*map(int, path[0]))
        pointer.pointer_down()
        for place in path[1:]:
            pointer.move_to_location(*map(int, place))
        pointer.pointer_up()
        actions.perform()


def saved(output: Path, name: str) -> Annotation:
    annotation = read_pair(output / f"{name}.npz").annotation
    assert annotation is not None
    return annotation


def test_lasso_assign_drag_undo_kill_and_reopen(browser: Any, serve: Serve, tmp_path: Path) -> None:
    output = tmp_path / "annotated"
    process, address = serve(output)
    window = Window(browser, address)
    (name,) = (name for name in until(lambda: shown(browser)))

    # a lasso around some points, given to a new mover
    (x, y), _, before = window.points()
    middle = np.argsort(np.hypot(x - np.median(x), y - np.median(y)))[:1]
    left, top = x[middle][0] - 30, y[middle][0] - 30
    inside = np.flatnonzero((abs(x - left - 30) < 29) & (abs(y - top - 30) < 29))
    assert len(inside) > 0
    window.drag([(left, top), (left + 60, top), (left + 60, top + 60), (left, top + 60), (left, top)])
    window.press("n")
    until((output / f"{name}.npz").exists)
    first = saved(output, name)
    beams = read_pair(output / f"{name}.npz").source.beam[inside]
    mover = first.body[beams[0]]
    assert mover > 0
    assert np.flatnonzero(first.body == mover).tolist() == sorted(beams.tolist())
    assert np.isfinite(first.motions[mover]).all()

    # dragged by hand: 40 pixels to the right
    window.press("m")
    (x, _), (metres, _), _ = window.points()
    scale = np.ptp(metres) / np.ptp(x)
    window.drag([(left + 30, top + 30), (left + 50, top + 30), (left + 70, top + 30)])
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
    process.wait()
    window = Window(browser, serve(output)[1])
    assert (name,) == tuple(shown(browser))
    assert window.points()[2] == colours
    window.press("\ue007")  # Enter
    until(lambda: json.loads((output / "progress.json").read_text())["done"] == [name])
    until(lambda: tuple(shown(browser)) != (name,))
    assert np.array_equal(saved(output, name).body, first.body)


def test_the_keys_alone_and_a_click(browser: Any, serve: Serve, tmp_path: Path) -> None:
    window = Window(browser, serve(tmp_path)[1])
    (name,) = shown(browser)
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
    until((tmp_path / f"{name}.npz").exists)
    pair = read_pair(tmp_path / f"{name}.npz")
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
    window.drag([(x[alone], y[alone]), (x[alone], y[alone])])
    window.press("n")
    until(lambda: saved(tmp_path, name).body[pair.source.beam[alone]] > 0)

    before = saved(tmp_path, name)
    window.press("\ue00f")  # page down
    until(lambda: shown(browser) != [name])
    window.press("\ue00e")  # page up
    until(lambda: shown(browser) == [name])
    assert np.array_equal(saved(tmp_path, name).body, before.body)


def shown(browser: Any) -> list[str]:
    """The name of the pair on the page."""
    title = browser.execute_script("return Bokeh.documents[0].get_model_by_name('title').text")
    return [title.split("<b>")[2].split("</b>")[0]] if title else []
