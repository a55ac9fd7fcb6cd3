"""Entries: all that Python calls are some, each has machine code, and what machine code is not made for never reaches it."""

import ast
import logging
from pathlib import Path

import numpy as np
import pytest

import torchcrf_scan
from torchcrf_scan import JointScanCRF
from torchcrf_scan.data.simulate import simulate_pairs
from torchcrf_scan.data.worlds import SimulatorConfig
from torchcrf_scan.loops import machine
from torchcrf_scan.loops.jit import ENTRIES, Entry, in_python
from torchcrf_scan.loops.layout import fits
from torchcrf_scan.prepare.record import record_layouts

PACKAGE = Path(torchcrf_scan.__file__).parent


def decorators(node: ast.AST) -> set[str]:
    return {of.id for of in getattr(node, "decorator_list", []) if isinstance(of, ast.Name)}


def marked(tree: ast.Module) -> dict[str, str]:
    """Function: kernel or entry."""
    kinds = {node.name: decorators(node) & {"kernel", "entry"} for node in tree.body if isinstance(node, ast.FunctionDef)}
    return {name: kind.pop() for name, kind in kinds.items() if kind}


def names_in_python(node: ast.AST) -> set[str]:
    """The names that are read outside of kernels, where no other function of that name is defined."""
    found: set[str] = set()
    for child in ast.iter_child_nodes(node):
        if decorators(child) & {"kernel", "entry"}:
            continue
        inside = [] if isinstance(child, ast.expr) else ast.walk(child)  # an expression defines no function
        own = {inner.name for inner in inside if isinstance(inner, ast.FunctionDef)}
        found |= names_in_python(child) - own
        if isinstance(child, ast.Name) and isinstance(child.ctx, ast.Load):
            found.add(child.id)
    return found


def test_every_kernel_that_python_calls_is_an_entry() -> None:
    trees = {path: ast.parse(path.read_text()) for path in PACKAGE.rglob("*.py")}
    marks = {path.relative_to(PACKAGE).with_suffix("").as_posix().replace("/", "."): marked(tree) for path, tree in trees.items()}
    called: set[tuple[str, str, str]] = set()
    for path, tree in trees.items():
        own = path.relative_to(PACKAGE).with_suffix("").as_posix().replace("/", ".")
        known = {name: (own, name) for name in marks[own]}
        for node in ast.walk(tree):
            if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("torchcrf_scan."):
                module = str(node.module).partition(".")[2]
                known |= {of.asname or of.name: (module, of.name) for of in node.names if of.name in marks.get(module, {})}
        called |= {(*known[name], marks[known[name][0]][known[name][1]]) for name in names_in_python(tree) & known.keys()}
    assert len(called) > 30
    assert [of for of in called if of[2] != "entry"] == []


def test_every_entry_has_machine_code() -> None:
    assert {name: machine.part_of(name) for name in ENTRIES if machine.part_of(name) is None} == {}
    level = machine.processor_level()
    built = {name: code for part in machine.PARTS for name, code in (machine.load(part, level) or {}).items()}
    assert built.keys() == ENTRIES.keys()
    assert {name: code.layouts for name, code in built.items()} == record_layouts()


@pytest.mark.parametrize("model", ["simulated", "encoder"])
def test_python_gives_the_answer_of_machine_code(model: str, caplog: pytest.LogCaptureFixture) -> None:
    pair = simulate_pairs(SimulatorConfig(beams=61), 1, 1, 4)[0]
    network = JointScanCRF.from_pretrained(model)
    calls: list[str] = []
    with in_python(lambda entry, arguments: calls.append(entry.name)):
        expected = network.match(pair.source, pair.target, pair.dt)
    answer = network.match(pair.source, pair.target, pair.dt)
    assert len(calls) > 20
    assert caplog.records == []  # machine code was not refused anything
    np.testing.assert_array_equal(answer.association, expected.association)
    np.testing.assert_array_equal(answer.cluster, expected.cluster)
    np.testing.assert_allclose(answer.motions, expected.motions, rtol=0, atol=1e-12)


def test_machine_code_gets_no_other_arguments(caplog: pytest.LogCaptureFixture) -> None:
    def total(values: np.ndarray) -> float:
        return float(values.sum())

    entry, compiled = Entry(total), []
    entry._checks = (fits("float64:1"),)
    entry._code = lambda values: compiled.append(values) or -1.0
    values = np.arange(6.0)
    assert entry(values) == -1.0
    frozen = values.copy()
    frozen.flags.writeable = False
    with caplog.at_level(logging.WARNING):
        for other in (values[::2], values.astype(np.float32), values.astype(np.int64), values.reshape(2, 3), frozen):
            assert entry(other) == other.sum()
        with pytest.raises(TypeError):
            entry(values, values)
        with pytest.raises(AttributeError):
            entry([1.0])
    assert len(compiled) == 1
    assert len(caplog.records) == 1  # says so once


def test_uncompiled_loops_warn_no_more_than_machine_code() -> None:
    assert np.isinf(Entry(lambda values: (1 / values)[0])(np.zeros(1)))
