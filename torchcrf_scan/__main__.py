"""`python -m torchcrf_scan`, and under `torchrun`: the command `torchcrf-scan`."""

import sys

from torchcrf_scan.cli import main

if __name__ == "__main__":  # not in the processes that import it to begin
    sys.exit(main())
