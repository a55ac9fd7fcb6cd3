"""The lower median, as in `torch.median`."""

from __future__ import annotations

import numpy as np

from torchcrf_scan.loops.jit import Array, kernel


@kernel
def lower_median(values: Array) -> float:
    """The smaller of the two middle values."""
    return float(np.sort(values)[(len(values) - 1) // 2])
