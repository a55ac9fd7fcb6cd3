"""Random work on a small folder of annotations, the same for the same seed, and what it leaves."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from torchcrf_scan.annotate.desk import Case, Desk
from torchcrf_scan.annotate.document import assign, drag
from torchcrf_scan.annotate.store import Store
from torchcrf_scan.scan import PairPrediction, Scan, ScanPair

NAMES = ("sure", "unsure", "middling")
Action = tuple[str, np.ndarray]


def case(name: str, confidence: float, shift: float = 0.0) -> Case:
    """A wall seen twice, of which the model is as sure as told."""
    scan = Scan.from_ranges(np.linspace(3, 4, 30) + shift, np.linspace(-0.5, 0.5, 30), range_noise=0.01)
    beams, sure = np.arange(30), np.full(30, confidence)
    answer = PairPrediction(beams, np.zeros(30, np.int64), np.zeros((1, 3)), sure, sure, True)
    return Case(ScanPair(scan, scan, 0.1, name=name, sequence="wall"), answer)


def cases() -> list[Case]:
    return [case(name, confidence) for name, confidence in zip(NAMES, (0.9, 0.2, 0.5), strict=True)]


def a_change(desk: Desk, label: int = -1) -> None:
    desk.change(assign(desk.document, np.arange(5), label))


def actions(seed: int) -> Iterator[Action]:
    random = np.random.default_rng(seed)
    while True:
        kind = str(random.choice(["assign", "drag", "undo", "redo", "go", "finish"], p=[0.35, 0.25, 0.1, 0.05, 0.1, 0.15]))
        yield kind, random.uniform(-1, 1, 6)


def act(desk: Desk, action: Action) -> None:
    kind, numbers = action
    if kind == "assign":
        desk.change(assign(desk.document, np.flatnonzero(np.resize(numbers > 0, 30)), int(numbers[0] < 0) - 1))
    elif kind == "drag":
        desk.change(drag(desk.document, 0, numbers[:3] / 10))
    elif kind == "go":
        desk.go(1 if numbers[0] > 0 else -1)
    else:
        getattr(desk, kind)()


def state_of(folder: Path) -> dict[str, bytes]:
    """What is saved of every pair, finished or not."""
    store = Store(folder)
    paths = {name: path for name in NAMES for path in (store.finished(name), store.unfinished(name)) if path.exists()}
    return {name: path.read_bytes() for name, path in paths.items()}
