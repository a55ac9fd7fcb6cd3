"""The build that a process begins in the background: of low priority, for this machine."""

import os
import sys

from torchcrf_scan.loops.machine import processor_level
from torchcrf_scan.prepare.build import build_missing, write_progress


def main() -> int:
    """Returns the exit code; the reason of a failure is the last line on stderr."""
    if hasattr(os, "nice"):
        os.nice(10)
    build_missing([processor_level()], write_progress, wait=False)
    return 0


if __name__ == "__main__":
    sys.exit(main())
