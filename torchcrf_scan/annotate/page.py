"""The page: picture, buttons and keys of one browser window, and what they do to the desk."""

from __future__ import annotations

import math
from collections.abc import Callable
from html import escape
from typing import Any

import numpy as np
from bokeh.document import Document as BokehDocument
from bokeh.events import ConnectionLost, DocumentReady, Pan, PanEnd, PanStart
from bokeh.layouts import column, row
from bokeh.models import CustomJS
from bokeh.models.widgets.buttons import Button
from bokeh.models.widgets.groups import RadioButtonGroup
from bokeh.models.widgets.markups import Div

from torchcrf_scan.annotate import document as edit
from torchcrf_scan.annotate.desk import Desk
from torchcrf_scan.annotate.document import UNKNOWN, Document
from torchcrf_scan.annotate.fit import FOLLOWS
from torchcrf_scan.annotate.keys import ACTIONS, legend
from torchcrf_scan.annotate.picture import Picture, look
from torchcrf_scan.errors import TorchCRFScanError
from torchcrf_scan.geometry.velocity import ground_velocity
from torchcrf_scan.scan import BACKGROUND, OUTLIER, Floats, Ints
from torchcrf_scan.viz.marks import NOTE, WRONG

MODES = ("select", "move", "pan")
MODE_KEYS = {"l": 0, "m": 1, "p": 2}
WIDTH = 390  # pixels of what stands beside the picture
NUDGE, TURN, FAST = 0.01, math.radians(0.1), 10.0  # metres, radians; with Shift so many times more
AGAIN = 5000  # milliseconds after which what could not be saved is tried once more
ARROWS = {"ArrowLeft": (-1, 0), "ArrowRight": (1, 0), "ArrowUp": (0, 1), "ArrowDown": (0, -1)}
TABLE = """
td { padding: 1px 7px 1px 0; white-space: nowrap } div { line-height: 1.35 }
kbd { background: #EEF0F2; border-radius: 3px; padding: 0 4px }
"""
PRESS = """
document.addEventListener("keydown", (event) => {
  if (event.altKey || event.metaKey) return
  const key = (event.ctrlKey ? "ctrl+" : "") + event.key
  if (!known.includes(key)) return
  event.preventDefault()
  if (key in modes) return group.active = modes[key]
  const look = zooms[key] ?? (group.active == 2 ? pans[key] : undefined)
  if (look !== undefined) return look.do.emit()
  box.tags = [key, event.shiftKey, (box.tags[2] ?? 0) + 1]
})
"""
MODE = "lasso.active = group.active == 0; pan.active = group.active == 2"
LOST = (
    "error.text = 'The server is gone. Everything up to the last change is saved: start the command again, then reload this page.'"
)

BUTTONS = (  # label, key
    (("background", "0"), ("active body", "g"), ("new mover", "n")),
    (("outlier", "o"), ("unknown", "u"), ("fit again", "f")),
    (("undo", "z"), ("redo", "y"), ("other view", "v")),
    (("previous", "PageUp"), ("next", "PageDown"), ("done, next", "Enter")),
)


class Page:
    """One browser window. All windows show the same desk.

    Args:
        doc: of the window. desk: what is worked on.
        changed: to be called with this page when the desk has changed.
    """

    def __init__(self, doc: BokehDocument, desk: Desk, changed: Callable[[Page], None]) -> None:
        self.doc, self.desk, self._changed = doc, desk, changed
        self.active, self.message, self.is_own, self._shown = BACKGROUND, "", True, ""
        self._grabbed: tuple[Document, Floats] | None = None
        self.picture = Picture()
        self.mode = RadioButtonGroup(labels=list(MODES), active=0, width=WIDTH)
        parts = (Div(width=WIDTH, stylesheets=[TABLE], name=name) for name in ("title", "error", "bodies"))
        self.title, self.error, self.bodies = parts
        self.error.styles = {"color": WRONG, "font-weight": "bold"}
        self.box = Div(visible=False, name="keys", tags=["", False, 0])
        self._connect()
        rows = [row([self._button(*button) for button in buttons]) for buttons in BUTTONS]
        legend_ = Div(text=legend(), width=WIDTH, stylesheets=[TABLE], styles={"font-size": "11px", "color": NOTE})
        beside = column(self.title, self.error, self.mode, self.bodies, *rows, legend_, self.box, width=WIDTH + 20)
        beside.styles = {"overflow": "hidden auto", "height": "100vh", "padding-left": "6px"}
        doc.add_root(row(self.picture.figure, beside, sizing_mode="stretch_both"))
        doc.title = "torchcrf-scan annotate"
        self.draw()

    def _connect(self) -> None:
        plot, picture = self.picture.figure, self.picture
        for event, answer in ((PanStart, self._grab), (Pan, self._pull), (PanEnd, self._drop)):
            plot.on_event(event, answer)
        self.box.on_change("tags", lambda _attribute, _old, new: self.press(new[0], bool(new[1])))
        self.mode.js_on_change("active", CustomJS(args={"group": self.mode, "lasso": picture.lasso, "pan": picture.pan}, code=MODE))
        press = {
            "modes": MODE_KEYS,
            "box": self.box,
            "group": self.mode,
            "zooms": picture.zooms,
            "pans": picture.pans,
            "known": list(ACTIONS),
        }
        self.doc.js_on_event(DocumentReady, CustomJS(args=press, code=PRESS))
        self.doc.js_on_event(ConnectionLost, CustomJS(args={"error": self.error}, code=LOST))
        self.doc.add_periodic_callback(self._retry, AGAIN)

    def _button(self, label: str, key: str) -> Button:
        button = Button(label=label, width=WIDTH // 3 - 8, button_type="primary" if key == "Enter" else "default")
        button.on_click(lambda: self.press(key))
        return button

    def press(self, key: str, is_fast: bool = False) -> None:
        """Does what a key stands for. is_fast: with Shift."""
        if key not in ACTIONS:
            return
        self.message, before = "", self.desk.document
        try:
            getattr(self, f"_{ACTIONS[key]}")(key, is_fast)
        except ValueError as error:
            self.message = str(error)
        if self.desk.document is not before or self.desk.name != self._shown:
            self._changed(self)
        self.draw()

    def draw(self) -> None:
        """Shows the desk as it is."""
        document = self.desk.document
        if self._shown != self.desk.name:
            self._shown, self._grabbed = self.desk.name, None
            self.active = next(iter(document.movers), BACKGROUND)
            self.picture.open(document)
        if self.active not in document.movers:
            self.active = BACKGROUND
        self.picture.draw(document, self.active, self.desk.prediction, self.is_own)
        self._tell(document)

    def _tell(self, document: Document) -> None:
        desk, name = self.desk, self.desk.name
        done, ring = desk.progress.done, desk.ring
        told = f"<b>{len(done)} of {len(ring)} pairs done</b>, {desk.minutes:.1f} minutes a pair"
        here = f"number {ring.index(name) + 1} in line, confidence {desk.confidences[name]:.2f}"
        self.title.text = f"{told}<br><b>{escape(name)}</b>{' (done)' if name in done else ''}: {here}"
        saved = f"Not saved, tried again: {desk.error}" if desk.error else ""
        self.error.text = escape(saved or self.message)
        metric = "point-to-line" if document.is_line else "Kabsch"
        rows = "".join(self._row(document, k) for k in (BACKGROUND, *document.movers, OUTLIER, UNKNOWN))
        self.bodies.text = f"<table>{rows}</table>motions: {metric}; {int((document.mended != FOLLOWS).sum())} associations mended"

    def _row(self, document: Document, k: int) -> str:
        """A body in the table: colour, name, points, residual, speed."""
        points = document.of(k)
        names = {BACKGROUND: "background", OUTLIER: "outlier", UNKNOWN: "unknown"}
        cells = [names.get(k, f"mover {k}"), f"{len(points)} points", "", "", ""]
        if k >= BACKGROUND and len(points):
            association, moved = document.association[points], document.moved[points]
            tied, target = association != OUTLIER, document.scans.target
            if target is not None and tied.any():
                apart = np.linalg.norm(moved[tied] - target.points[association[tied]], axis=-1)
                cells[2] = f"{int(tied.sum())} tied, {100 * apart.mean():.1f} cm"
            if k > BACKGROUND:
                centre, pair = document.scans.source[points].mean(axis=0), document.scans.pair
                velocity = ground_velocity(centre, document.motions[k], document.motions[BACKGROUND], pair.dt)
                cells[3] = f"{np.linalg.norm(velocity):.2f} m/s"
        cells[4] = "by hand" if k >= BACKGROUND and document.held[k] else ""
        shape = {"x": "&#10005;", "square": "&#9632;", "diamond": "&#9670;", "triangle": "&#9650;", "inverted_triangle": "&#9660;"}
        color, marker = look(k)
        mark = f"<span style='color:{color};-webkit-text-stroke:0.5px {NOTE}'>{shape.get(marker, '&#9679;')}</span>"
        weight = "background:#DDE6EE" if k == self.active else ""
        return f"<tr style='{weight}'><td>{mark}</td>" + "".join(f"<td>{cell}</td>" for cell in cells) + "</tr>"

    # Selection, modes and view

    @property
    def chosen(self) -> Ints:
        """The selected points of the source."""
        n = len(self.desk.document.label)
        return np.array(sorted(i for i in self.picture.source.selected.indices if 0 <= i < n), dtype=np.int64)

    def _browser(self, key: str, is_fast: bool) -> None:
        """Modes and zoom: the browser has changed them itself."""

    def _step(self, key: str, is_fast: bool) -> None:
        step, n, chosen = (1 if key == "." else -1), len(self.desk.document.label), self.chosen
        if n:
            self.picture.choose(np.array([(int(chosen[0 if step < 0 else -1]) + step) % n if len(chosen) else 0]))

    def _extend(self, key: str, is_fast: bool) -> None:
        self.picture.choose(edit.surface(self.desk.document, self.chosen))

    def _select_active(self, key: str, is_fast: bool) -> None:
        self.picture.choose(self.desk.document.of(self.active))

    def _clear(self, key: str, is_fast: bool) -> None:
        self.picture.choose(np.zeros(0, np.int64))

    def _cycle(self, key: str, is_fast: bool) -> None:
        bodies = [BACKGROUND, *self.desk.document.movers]
        self.active = bodies[(bodies.index(self.active) + 1) % len(bodies)]

    def _whole(self, key: str, is_fast: bool) -> None:
        chosen = self.chosen
        self.picture.open(self.desk.document)
        self.picture.choose(chosen)

    def _closer(self, key: str, is_fast: bool) -> None:
        points = self.desk.document.moved[self.desk.document.of(self.active)]
        if len(points) and np.isfinite(points).all():
            margin = 0.2 + 0.5 * np.ptp(points, axis=0).max()
            self.picture.zoom_to(np.array([points.min(axis=0) - margin, points.max(axis=0) + margin]))

    def _view(self, key: str, is_fast: bool) -> None:
        self.is_own = not self.is_own

    # Labels

    def _give(self, label: int) -> None:
        self.desk.change(edit.assign(self.desk.document, self.chosen, label))
        self.picture.choose(np.zeros(0, np.int64))

    def _digit(self, key: str, is_fast: bool) -> None:
        if len(self.chosen):
            self._give(int(key))
        elif int(key) in (BACKGROUND, *self.desk.document.movers):
            self.active = int(key)

    def _give_new(self, key: str, is_fast: bool) -> None:
        if len(self.chosen):
            self.active = edit.new_mover(self.desk.document)
            self._give(self.active)

    def _give_active(self, key: str, is_fast: bool) -> None:
        self._give(self.active)

    def _give_outlier(self, key: str, is_fast: bool) -> None:
        self._give(OUTLIER)

    def _give_unknown(self, key: str, is_fast: bool) -> None:
        self._give(UNKNOWN)

    # Motions

    def _grab(self, event: Any) -> None:
        if self.mode.active == MODES.index("move"):
            self._grabbed = self.desk.document, np.array([event.x, event.y])

    def _pull(self, event: Any) -> None:
        if self._grabbed is not None:
            self.picture.draw(self._pulled(event), self.active, self.desk.prediction, self.is_own)

    def _drop(self, event: Any) -> None:
        if self._grabbed is not None:
            self.desk.change(self._pulled(event))
            self._grabbed = None
            self._changed(self)
            self.draw()

    def _pulled(self, event: Any) -> Document:
        """The document while the active body is dragged: shifted, or turned about its centre."""
        assert self._grabbed is not None
        document, start = self._grabbed
        here = np.array([event.x, event.y])
        if not (event.modifiers or {}).get("shift"):
            return edit.drag(document, self.active, np.append(0.0, here - start))
        points = document.moved[document.of(self.active)]
        if not len(points):
            return document
        before, after = start - points.mean(axis=0), here - points.mean(axis=0)
        turn = math.atan2(after[1], after[0]) - math.atan2(before[1], before[0])
        return edit.drag(document, self.active, np.array([turn, 0.0, 0.0]))

    def _arrow(self, key: str, is_fast: bool) -> None:
        x, y = ARROWS[key]
        step = NUDGE * (FAST if is_fast else 1.0)
        self.desk.change(edit.drag(self.desk.document, self.active, np.array([0.0, step * x, step * y])))

    def _turn(self, key: str, is_fast: bool) -> None:
        step = TURN * (FAST if key in "{}" else 1.0) * (1 if key in "[{" else -1)
        self.desk.change(edit.drag(self.desk.document, self.active, np.array([step, 0.0, 0.0])))

    def _fit(self, key: str, is_fast: bool) -> None:
        self.desk.change(edit.fit_again(self.desk.document, self.active))

    def _metric(self, key: str, is_fast: bool) -> None:
        self.desk.change(edit.with_metric(self.desk.document, not self.desk.document.is_line))

    # Associations

    def _associate(self, key: str, is_fast: bool) -> None:
        target = self.picture.target.selected.indices
        if len(target) != 1 or not len(self.chosen):
            raise TorchCRFScanError("select points, and with Shift one ring to associate them with")
        self._mend(np.array(target))

    def _shift(self, key: str, is_fast: bool) -> None:
        association = self.desk.document.association[self.chosen]
        last = len(self.desk.document.scans.pair.target) - 1
        self._mend(np.where(association == OUTLIER, OUTLIER, np.clip(association + (1 if key == ">" else -1), 0, last)))

    def _part(self, key: str, is_fast: bool) -> None:
        self._mend(np.array([OUTLIER]))

    def _release(self, key: str, is_fast: bool) -> None:
        self._mend(np.array([FOLLOWS]))

    def _mend(self, targets: Ints) -> None:
        if len(self.chosen):
            self.desk.change(edit.mend(self.desk.document, self.chosen, targets))

    # Order and history

    def _undo(self, key: str, is_fast: bool) -> None:
        self.desk.undo()

    def _redo(self, key: str, is_fast: bool) -> None:
        self.desk.redo()

    def _finish(self, key: str, is_fast: bool) -> None:
        self.desk.finish()

    def _turn_page(self, key: str, is_fast: bool) -> None:
        self.desk.go(1 if key == "PageDown" else -1)

    def _retry(self) -> None:
        if self.desk.error:
            self.desk.save()
            self.draw()
