"""`torchcrf-scan prepare`: machine code for the loops, built before it is needed."""

from __future__ import annotations

from tqdm import tqdm

from torchcrf_scan.commands.arguments import listed
from torchcrf_scan.errors import TorchCRFScanError
from torchcrf_scan.loops import machine

LEVELS = ("x86-64-v2", "x86-64-v3", "generic")


def prepare(*, levels: tuple[str, ...] | str = ()) -> int:
    """Builds the machine code that is missing, in a few minutes; needs a C compiler.

    Without it the first answers take seconds each, while the same is built in the background. To make a wheel that carries it:
    `torchcrf-scan prepare --levels [x86-64-v2,x86-64-v3]` in the source tree, then `pip wheel --no-deps .`; such a wheel is for
    this platform and Python alone.

    Args:
        levels: kinds of processors, of x86-64-v2, x86-64-v3 (AVX2) and generic; that of this machine where absent
    """
    from torchcrf_scan.prepare.build import build_missing

    for level in listed(levels):
        if level not in LEVELS:
            raise TorchCRFScanError(f"--levels: expected some of {', '.join(LEVELS)}, got {level}")
    with tqdm(unit="part", disable=None) as bar:

        def progress(done: int, count: int) -> None:
            bar.total = count
            bar.update(done - bar.n)

        folder = build_missing(listed(levels) or [machine.processor_level()], progress)
    print(f"machine code is ready in {folder}")
    return 0
