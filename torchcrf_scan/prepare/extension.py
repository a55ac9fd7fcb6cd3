"""Extension modules of machine code, by numba's ahead-of-time compiler; whatever the package needs of numba is in this module.

`numba.pycc` is deprecated and has no successor yet. Every kernel is compiled once in a process, into the code that is linked to its
callers, and neither to an object file of its own nor with the wrappers by which Python would call it.
"""

from __future__ import annotations

import gc
import os
import sys
from collections.abc import Mapping, Sequence
from importlib import import_module
from multiprocessing import parent_process
from pathlib import Path
from threading import Thread
from typing import Any

from torchcrf_scan.loops import jit, machine
from torchcrf_scan.loops.layout import Layout, class_of

SAFE_MATH = {"reassoc", "contract", "nsz", "arcp"}  # not those that assume finite numbers: impossible states are -inf


def choose_processor(level: str) -> None:
    """Makes this process one that compiles for a processor, before numba, which reads it, is imported; ends it with its parent."""

    def follow() -> None:
        parent = parent_process()
        assert parent is not None
        parent.join()
        os._exit(1)

    Thread(target=follow, daemon=True).start()
    gc.set_threshold(200_000)  # the compiler makes millions of objects, and leaves few behind
    assert "numba" not in sys.modules
    os.environ |= {"NUMBA_CPU_NAME": level, "NUMBA_CPU_FEATURES": "", "NUMBA_DISABLE_JIT": "0"}


def compile_objects(part: str, level: str, layouts: Mapping[str, Sequence[Layout]], folder: Path) -> tuple[list[str], list[str]]:
    """The object files of some entries, and the symbols that their extension exports."""
    compiler = _compiler(level)
    compiler.output_file = f"{part}.so"
    for name, argument_layouts in layouts.items():
        signature = tuple(type_of(layout) for layout in argument_layouts)
        compiler.export(machine.symbol(name), signature)(jit.ENTRIES[name].python)
    return compiler._compile_object_files(str(folder))


def compile_common(level: str, folder: Path) -> list[str]:
    """The object files of what every extension module holds of numba's own code."""
    return _compiler(level)._compile_mixins(str(folder))


def link(objects: Sequence[str], exports: Sequence[str], level: str, path: Path) -> None:
    """Writes an extension module."""
    compiler = _compiler(level)
    tools = compiler._toolchain
    where = tools.get_python_libraries(), tools.get_python_library_dirs()
    tools.link_shared(str(path), objects, *where, export_symbols=exports, extra_ldflags=compiler._get_extra_ldflags())


def type_of(layout: Layout) -> Any:
    """The compiler's name for a layout."""
    from numba import from_dtype
    from numba.core import types
    from numpy import dtype

    if isinstance(layout, list):
        items = tuple(type_of(item) for item in layout[1:])
        return types.BaseTuple.from_types(items, class_of(layout[0]) if layout[0] else None)
    name, _, dimensions = layout.partition(":")
    if dimensions:
        return types.Array(from_dtype(dtype(name)), int(dimensions), "C")
    return {"float": types.float64, "int": types.int64, "bool": types.boolean}[name]


def _compiler(level: str) -> Any:
    import warnings

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # that it is deprecated
        from numba.pycc import CC

    _compile_as_the_loops_need()
    compiler = CC(machine.NAME, source_module=jit)
    compiler.target_cpu = "" if level == "generic" else level
    return compiler


def _compile_as_the_loops_need() -> None:
    """Sets numba and pycc up, and puts compiled functions in the place of all kernels of this process, once."""
    compiler, codegen, cpu = (_module(name) for name in ("numba.pycc.compiler", "numba.core.codegen", "numba.core.cpu"))
    Flags = _module("numba.core.compiler").Flags

    def flags() -> Any:
        made = Flags()
        made.release_gil, made.error_model = True, "numpy"  # pycc's own hold the lock, and raise where a divisor is 0
        made.fastmath = cpu.FastMathOptions(SAFE_MATH)
        return made

    if compiler.Flags is not Flags:
        return
    compiler.Flags = flags
    # What kernels are called by is never called in this process, but must differ from one to another.
    cpu.CPUContext.get_executable = lambda self, library, description, environment: [].append
    codegen.JITCodeLibrary._finalize_specific = lambda self: None
    codegen.JITCPUCodegen._add_module = lambda self, module: None
    codegen.JITCodeLibrary._optimize_final_module = _inline
    optimise = codegen.AOTCodeLibrary._optimize_final_module  # twice: again what the first time has inlined
    codegen.AOTCodeLibrary._optimize_final_module = lambda self: [optimise(self), optimise(self)]
    _compile_kernels()


def _inline(library: Any) -> None:
    """Inlines what a kernel calls, and no more: the extension that it is linked to is optimised as a whole."""
    passes, builder = library._codegen._module_pass_manager(opt=0, loop_vectorize=False, slp_vectorize=False, cost="cheap")
    passes.run(library._final_module, builder)


def _compile_kernels() -> None:
    for name in (part for parts in machine.PARTS.values() for part in parts):
        import_module("torchcrf_scan." + name.removesuffix(".py").replace("/", "."))
    options = {"nogil": True, "error_model": "numpy", "fastmath": SAFE_MATH, "no_cpython_wrapper": True, "no_cfunc_wrapper": True}
    compiled = {id(function): _module("numba").njit(**options)(function) for function in jit.KERNELS}
    for module in [module for name, module in sys.modules.items() if name.startswith("torchcrf_scan.")]:
        for name, value in list(vars(module).items()):
            function = value.python if isinstance(value, jit.Entry) else value
            if id(function) in compiled:
                setattr(module, name, compiled[id(function)])


def _module(name: str) -> Any:
    """One of numba's, whose inner names have no types."""
    return import_module(name)
