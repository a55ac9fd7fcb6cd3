"""The examples that tell what machine code is built for: they call every entry, and each always in the same way."""

import numpy as np
import pytest

from torchcrf_scan.loops import jit
from torchcrf_scan.prepare import record
from torchcrf_scan.prepare.record import record_layouts


def probe(values: np.ndarray) -> None:
    """No entry, made one by the tests."""


def test_an_entry_without_an_example_is_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(record, "answer_examples", lambda: None)
    monkeypatch.setitem(jit.ENTRIES, "some.entry", jit.Entry(probe))
    with pytest.raises(TypeError, match=r"got none for .*some\.entry"):
        record_layouts()


def test_an_entry_that_is_called_in_two_ways_is_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    entry = jit.Entry(probe)
    monkeypatch.setattr(record, "answer_examples", lambda: [entry(np.zeros(2)), entry(np.zeros((2, 2)))])
    with pytest.raises(TypeError, match="probe: expected always the same layouts"):
        record_layouts()
    assert jit.Entry.watch is None
