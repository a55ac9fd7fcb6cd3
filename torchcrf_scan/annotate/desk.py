"""The work on a folder of annotations: which pair is open, its history, what is saved and what is next. No page, no server."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from torchcrf_scan.annotate.document import Document, annotated, annotation_of, blank, proposed
from torchcrf_scan.annotate.fit import Scans
from torchcrf_scan.annotate.history import History
from torchcrf_scan.annotate.queue import confidence_of, order
from torchcrf_scan.annotate.store import Store
from torchcrf_scan.errors import TorchCRFScanError
from torchcrf_scan.safe_names import one_line
from torchcrf_scan.scan import PairPrediction, Scan, ScanPair

PAUSE = 60.0  # seconds without a change after which nobody is at work


@dataclass(frozen=True, slots=True)
class Case:
    """A pair to annotate, and the model's answer; None: it has none."""

    pair: ScanPair
    prediction: PairPrediction | None


class Desk:
    """One pair open at a time; every change is saved at once, and if that fails again with the next one.

    Args:
        cases: at least one, of different names.
        gate: metres, the distance beyond which points are not associated; None: by each pair's spacing and noise.
        clock: seconds.

    Attributes:
        name: of the open pair. error: what could not be saved, one line, empty if nothing.

    Raises:
        TorchCRFScanError: the folder holds a pair of the same name with other scans.
    """

    def __init__(
        self, cases: Sequence[Case], store: Store, gate: float | None = None, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self.cases = {case.pair.name: case for case in cases}
        self.store, self.error = store, ""
        self.progress = store.read_progress()
        self.confidences = {name: confidence_of(case.pair, case.prediction) for name, case in self.cases.items()}
        self._gate, self._clock, self._last = gate, clock, clock()
        self._histories: dict[str, History[Document]] = {}
        self._unsaved = set[str]()
        for name, case in self.cases.items():
            saved = store.read(name)
            if saved is not None and not (_is_same(saved.source, case.pair.source) and _is_same(saved.target, case.pair.target)):
                raise TorchCRFScanError(
                    f"{store.folder}: expected annotations of these scans, got {store.finished(name).name} of others"
                )
            is_finished = saved is not None and saved.annotation is not None and store.finished(name).exists()
            if is_finished and name not in self.progress.done:  # killed before it was noted
                self.progress.done.append(name)
        self.name = self.ring[0]
        self._open()

    @property
    def ring(self) -> list[str]:
        """The names of all pairs in the order in which they come next."""
        return order(self.confidences, self.progress.done)

    @property
    def document(self) -> Document:
        """The open pair's annotation."""
        return self._histories[self.name].present

    @property
    def prediction(self) -> PairPrediction | None:
        """The model's answer to the open pair."""
        return self.cases[self.name].prediction

    def change(self, document: Document) -> None:
        """The next state of the open pair."""
        if document is not self.document:
            self._put(self._histories[self.name].do(document))

    def undo(self) -> None:
        """Takes the last change back."""
        self._put(self._histories[self.name].undo())

    def redo(self) -> None:
        """Makes a change once more that was taken back."""
        self._put(self._histories[self.name].redo())

    def go(self, step: int) -> None:
        """Opens a neighbour in the order of the pairs."""
        self._count()
        ring = self.ring
        self.name = ring[(ring.index(self.name) + step) % len(ring)]
        self._open()
        self.save()

    def finish(self) -> None:
        """Puts the open pair among those finished and opens the next one; stays if it cannot be saved."""
        self._count()
        if self.name not in self.progress.done:
            self._unsaved.add(self.name)
        self.save(self.name)
        if not self.error:
            self.name = self.ring[0]
            self._open()

    def save(self, finished: str | None = None) -> None:
        """Writes what is not yet written; `error` says what could not be. finished: a pair that is."""
        self.error = ""
        try:
            for name in sorted(self._unsaved):
                document = self._histories[name].present
                self.store.write(name, replace(self.cases[name].pair, annotation=annotation_of(document)))
                self._unsaved.discard(name)
            if finished is not None:
                self.store.finish(finished)
                self.progress.done = [*(name for name in self.progress.done if name != finished), finished]
            self.store.write_progress(self.progress)
        except (OSError, ValueError) as error:
            self.error = one_line(error)

    @property
    def minutes(self) -> float:
        """Mean minutes of work on the pairs that are done."""
        return sum(self.progress.seconds.get(name, 0.0) for name in self.progress.done) / max(len(self.progress.done), 1) / 60

    def _put(self, history: History[Document]) -> None:
        self._count()
        if history is not self._histories[self.name]:
            self._histories[self.name] = history
            self._unsaved.add(self.name)
            self.progress.done = [name for name in self.progress.done if name != self.name]
        self.save()

    def _count(self) -> None:
        now = self._clock()
        spent = min(now - self._last, PAUSE)
        self.progress.seconds[self.name] = self.progress.seconds.get(self.name, 0.0) + spent
        self._last = now

    def _open(self) -> None:
        """Makes the document of the pair called `name`, unless it was open before."""
        if self.name in self._histories:
            return
        case, saved = self.cases[self.name], self.store.read(self.name)
        scans = Scans.of(case.pair, self._gate)
        if saved is not None and saved.annotation is not None:
            document = annotated(scans, saved.annotation)
        else:
            document = blank(scans) if case.prediction is None else proposed(scans, case.prediction)
        self._histories[self.name] = History(document)


def _is_same(a: Scan, b: Scan) -> bool:
    return all(np.array_equal(getattr(a, key), getattr(b, key)) for key in ("ranges", "bearings", "beam", "n_beams"))
