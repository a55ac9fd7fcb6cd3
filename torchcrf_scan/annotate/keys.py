"""The keys of the page: what a user presses, and which action of `Page` that is."""

from __future__ import annotations

from collections.abc import Mapping

# keys as the browser names them: shown, action, meaning
KEYS: Mapping[tuple[str, ...], tuple[str, str, str]] = {
    tuple("0123456789"): ("0-9", "digit", "give selection to background, mover; without one: make active"),
    ("n",): ("n", "give_new", "give to a new mover"),
    ("g",): ("g", "give_active", "give to the active body"),
    ("o",): ("o", "give_outlier", "make outliers"),
    ("u",): ("u", "give_unknown", "make unknown"),
    ("l",): ("l", "browser", "lasso or click, Shift adds"),
    ("m",): ("m", "browser", "drag the active body, Shift turns"),
    ("p",): ("p", "browser", "drag or arrows pan"),
    (",", "."): (", .", "step", "select point before, after"),
    ("e",): ("e", "extend", "extend along the surface"),
    ("s",): ("s", "select_active", "select the active body"),
    ("Escape",): ("Esc", "clear", "select nothing"),
    ("c",): ("c", "cycle", "next body becomes active"),
    ("ArrowLeft", "ArrowRight", "ArrowUp", "ArrowDown"): ("arrows", "arrow", "move it 1 cm, Shift 10 cm"),
    ("[", "]", "{", "}"): ("[ ]", "turn", "turn it 0.1&deg;, Shift 1&deg;"),
    ("f",): ("f", "fit", "fit it again, from farther off"),
    ("k",): ("k", "metric", "point-to-line or Kabsch"),
    ("a",): ("a", "associate", "tie selection to the ring at the mouse"),
    ("<", ">"): ("&lt; &gt;", "shift", "tie to ring before, after"),
    ("x",): ("x", "part", "no counterpart"),
    ("r",): ("r", "release", "tie as the motion says"),
    ("z", "ctrl+z"): ("z", "undo", "undo"),
    ("y", "ctrl+y", "ctrl+Z"): ("y", "redo", "redo"),
    ("+", "=", "-"): ("+ -", "browser", "zoom, as the wheel"),
    ("h",): ("h", "whole", "whole scan"),
    ("i",): ("i", "closer", "close-up of the active body"),
    ("v",): ("v", "view", "all under background's motion, or each its own"),
    ("Enter",): ("Enter", "finish", "done, least sure pair next"),
    ("PageDown", "PageUp"): ("PgDn PgUp", "turn_page", "next, previous pair"),
}

ACTIONS: Mapping[str, str] = {key: action for keys, (_, action, _) in KEYS.items() for key in keys}


MARKS = "Rings: second scan. Dots and crosses: first scan, moved. Dotted circles: the model is unsure. Lines: associations."


def legend() -> str:
    """The marks and keys as HTML, the keys in two columns."""
    rows = "".join(f"<div><kbd>{shown}</kbd> {meaning}</div>" for shown, _, meaning in KEYS.values())
    return f"<div style='margin-bottom:6px'>{MARKS}</div><div style='column-count:2; column-gap:12px'>{rows}</div>"
