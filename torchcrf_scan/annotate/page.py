"""The page: picture, buttons and keys of one browser window, and what they do to the desk."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from html import escape
from typing import Any

import numpy as np
from bokeh.document import Document as BokehDocument
from bokeh.events import ConnectionLost, DocumentReady, MouseMove, Pan, PanEnd, PanStart
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
from torchcrf_scan.safe_names import one_line
from torchcrf_scan.scan import BACKGROUND, OUTLIER, Floats, Ints
from torchcrf_scan.viz.marks import NOTE, WRONG

MODES = ("select", "move", "pan")
MODE_KEYS = {"l": 0, "m": 1, "p": 2}
WIDTH = 390  # pixels of what stands beside the picture
NUDGE, TURN, FAST = 0.01, math.radians(0.1), 10.0  # metres, radians; with Shift so many times more
AGAIN = 5000  # milliseconds after which what could not be saved is tried once more
ARROWS = {"ArrowLeft": (0, -1, 0), "ArrowRight": (0, 1, 0), "ArrowUp": (0, 0, 1), "ArrowDown": (0, 0, -1)}
TURNS = {"[": (1, 0, 0), "{": (1, 0, 0), "]": (-1, 0, 0), "}": (-1, 0, 0)}
TABLE = """
table { border-collapse: collapse } td { padding: 1px 7px 1px 0; white-space: nowrap } div { line-height: 1.35 }
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
  box.tags = [key, event.shiftKey, (box.tags[2] ?? 0) + 1, window.mouse ?? null]
})
"""
MOVED = "window.mouse = [cb_obj.x, cb_obj.y]"  # metres
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
        self._grabbed: Floats | None = None  # where a drag began
        self.mouse: Sequence[float] | None = None
        self.picture = Picture()
        self.mode = RadioButtonGroup(labels=list(MODES), active=0, width=WIDTH)
        parts = (Div(width=WIDTH, stylesheets=[TABLE], name=name) for name in ("title", "error", "bodies"))
        self.title, self.error, self.bodies = parts
        self.error.styles = {"color": WRONG, "font-weight": "bold", "min-height": "34px"}  # nothing below jumps
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
        plot.js_on_event(MouseMove, CustomJS(code=MOVED))
        self.box.on_change("tags", lambda _attribute, _old, new: self.press(*new[:2], *new[3:]))
        self.mode.js_on_change("active", CustomJS(args={"group": self.mode, "lasso": picture.lasso, "pan": picture.pan}, code=MODE))
        press = {"known": list(ACTIONS), "modes": MODE_KEYS, "group": self.mode, "box": self.box}
        press |= {"zooms": picture.zooms, "pans": picture.pans}
        self.doc.js_on_event(DocumentReady, CustomJS(args=press, code=PRESS))
        self.doc.js_on_event(ConnectionLost, CustomJS(args={"error": self.error}, code=LOST))
        self.doc.add_periodic_callback(self._retry, AGAIN)

    def _button(self, label: str, key: str) -> Button:
        button = Button(label=label, width=WIDTH // 3 - 8, button_type="primary" if key == "Enter" else "default")
        button.on_click(lambda: self.press(key))
        return button

    def press(self, key: str, is_fast: bool = False, mouse: Sequence[float] | None = None) -> None:
        """Does what a key stands for. is_fast: with Shift. mouse: where it is, metres; None: not over the picture so far."""
        if key not in ACTIONS:
            return
        self.message, self.mouse = "", mouse
        try:
            if self._shown != self.desk.name:  # what is selected here is of another pair
                raise TorchCRFScanError("another window has opened this pair")
            self._act(ACTIONS[key], key, is_fast)
        except ValueError as error:
            self.message = one_line(error)
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
        told = f"<b>{len(done)} of {len(ring)} done</b>, {desk.minutes:.1f} minutes a pair"
        here = f"number {ring.index(name) + 1} in line, confidence {desk.confidences[name]:.2f}"
        self.title.text = f"{told}<br><b>{escape(name)}</b>{' (done)' if name in done else ''}: {here}"
        saved = f"Not saved, tried again every {AGAIN // 1000} s: {desk.error}" if desk.error else ""
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
        if k >= BACKGROUND and document.held[k]:
            is_models = self.desk.prediction is not None and (document.motions[k] == self.desk.prediction.motions).all(-1).any()
            cells[4] = "model's motion" if is_models else "moved by hand"
        shape = {"x": "&#10005;", "square": "&#9632;", "diamond": "&#9670;", "triangle": "&#9650;", "inverted_triangle": "&#9660;"}
        color, marker = look(k)
        mark = f"<span style='color:{color};-webkit-text-stroke:0.5px {NOTE}'>{shape.get(marker, '&#9679;')}</span>"
        weight = "background:#DDE6EE" if k == self.active else ""
        return f"<tr style='{weight}'><td>{mark}</td>" + "".join(f"<td>{cell}</td>" for cell in cells) + "</tr>"

    @property
    def chosen(self) -> Ints:
        """The selected points of the source."""
        n = len(self.desk.document.label)
        return np.array(sorted(i for i in self.picture.source.selected.indices if 0 <= i < n), dtype=np.int64)

    def _act(self, action: str, key: str, is_fast: bool) -> None:
        """One action of `KEYS`; those of the browser have been done there."""
        desk, document = self.desk, self.desk.document
        bodies = [BACKGROUND, *document.movers]
        active = self.active if self.active in bodies else BACKGROUND  # another window may have emptied it
        step, angle = (size * (FAST if is_fast or key in "{}" else 1.0) for size in (NUDGE, TURN))
        actions: Mapping[str, Callable[[], object]] = {
            "browser": lambda: None,
            "digit": lambda: self._digit(int(key), bodies),
            "give_new": lambda: self._give(edit.new_mover(document), is_new=True),
            "give_active": lambda: self._give(active),
            "give_outlier": lambda: self._give(OUTLIER),
            "give_unknown": lambda: self._give(UNKNOWN),
            "step": lambda: self._step(1 if key == "." else -1),
            "extend": lambda: self.picture.choose(edit.surface(document, self.chosen)),
            "select_active": lambda: self.picture.choose(document.of(active)),
            "clear": lambda: self.picture.choose(np.zeros(0, np.int64)),
            "cycle": lambda: setattr(self, "active", bodies[(bodies.index(active) + 1) % len(bodies)]),
            "arrow": lambda: desk.change(edit.drag(document, active, step * np.array(ARROWS[key]))),
            "turn": lambda: desk.change(edit.drag(document, active, angle * np.array(TURNS[key]))),
            "fit": lambda: desk.change(edit.fit_again(document, active)),
            "metric": lambda: desk.change(edit.with_metric(document, not document.is_line)),
            "associate": lambda: self._mend(self._ring()),
            "shift": lambda: self._mend(edit.beside(document, self.chosen, 1 if key == ">" else -1)),
            "part": lambda: self._mend(np.array([OUTLIER])),
            "release": lambda: self._mend(np.array([FOLLOWS])),
            "undo": desk.undo,
            "redo": desk.redo,
            "whole": lambda: self.picture.show_whole(document),
            "closer": lambda: self.picture.show_body(document, active),
            "view": lambda: setattr(self, "is_own", not self.is_own),
            "finish": desk.finish,
            "turn_page": lambda: desk.go(1 if key == "PageDown" else -1),
        }
        actions[action]()

    def _digit(self, label: int, bodies: list[int]) -> None:
        if len(self.chosen):
            self._give(label)
        elif label in bodies:
            self.active = label

    def _step(self, step: int) -> None:
        """Selects the point after or before those selected."""
        n, chosen = len(self.desk.document.label), self.chosen
        if n:
            self.picture.choose(np.array([(int(chosen[0 if step < 0 else -1]) + step) % n if len(chosen) else 0]))

    def _give(self, label: int, is_new: bool = False) -> None:
        self.desk.change(edit.assign(self.desk.document, self._points(), label))
        self.active = label if is_new else self.active
        self.picture.choose(np.zeros(0, np.int64))

    def _mend(self, targets: Ints) -> None:
        points = self._points()
        if not (self.desk.document.label[points] >= BACKGROUND).any():
            raise TorchCRFScanError("give these points to a body first: outliers and unknown ones are tied to nothing")
        self.desk.change(edit.mend(self.desk.document, points, targets))

    def _points(self) -> Ints:
        """Those selected, at least one."""
        if not len(self.chosen):
            raise TorchCRFScanError("select points first: by lasso, click, or the keys , and .")
        return self.chosen

    def _ring(self) -> Ints:
        """(1,) the target point nearest to the mouse."""
        target = self.desk.document.scans.target
        if target is None or self.mouse is None:
            raise TorchCRFScanError("point at a ring with the mouse")
        return target.nearest(np.array([self.mouse]))[1]

    # The mouse

    def _grab(self, event: Any) -> None:
        if self.mode.active == MODES.index("move") and self._shown == self.desk.name:
            self._grabbed = np.array([event.x, event.y])

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
        document, here = self.desk.document, np.array([event.x, event.y])  # another window may have changed it meanwhile
        if not (event.modifiers or {}).get("shift"):
            return edit.drag(document, self.active, np.append(0.0, here - self._grabbed))
        points = document.moved[document.of(self.active)]
        if not len(points):
            return document
        (before_x, before_y), (x, y) = self._grabbed - points.mean(axis=0), here - points.mean(axis=0)
        turn = math.atan2(y, x) - math.atan2(before_y, before_x)
        return edit.drag(document, self.active, np.array([turn, 0.0, 0.0]))

    def _retry(self) -> None:
        if self.desk.error:
            self.desk.save()
            self._changed(self)
            self.draw()
