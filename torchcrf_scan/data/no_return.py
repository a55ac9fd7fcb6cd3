"""The reading by which a log says that nothing came back, found in the readings themselves."""

from __future__ import annotations

import numpy as np

from torchcrf_scan.scan import Floats

WIDTH = 0.02  # metres: 32.767 is written as 32.76 or 32.77
BESIDE = 1.0  # metres below it that are compared
LEAST = 10  # readings
OFTENER = 10  # times as often as the most frequent reading beside it


def find_no_return(readings: Floats) -> float | None:
    """The least reading that means "no return", metres: the greatest one, if it comes far more often than any near it.

    A sensor that clips its readings has a peak there, and nothing beyond; walls are spread by noise and by their slant.

    Args:
        readings: (R,) metres of many beams, those known to be no returns left out.
    """
    values = np.sort(readings[np.isfinite(readings) & (readings > 0)])
    if len(values) == 0:
        return None
    first = int(np.searchsorted(values, values[-1] - WIDTH))
    beside = values[int(np.searchsorted(values, values[-1] - BESIDE)) : first]
    last = np.searchsorted(beside, beside + WIDTH, side="right")
    most = int((last - np.arange(len(beside))).max(initial=0))
    count = len(values) - first
    return float(values[first]) if count >= max(LEAST, OFTENER * most) and first > 0 else None
