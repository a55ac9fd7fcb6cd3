"""Which readings of a recording are processed."""

from collections.abc import Sequence

import numpy as np
import pytest

from torchcrf_scan.commands.recording import Options, chosen
from torchcrf_scan.data.reading import Reading
from torchcrf_scan.scan import Scan

SCAN = Scan.from_ranges(np.ones(3), np.arange(3.0))


def kept(stamps: Sequence[float], options: Options) -> list[float]:
    return [reading.stamp for reading in chosen((Reading(SCAN, stamp) for stamp in stamps), options)]


@pytest.mark.parametrize("stamps", [[5.0, 4.0, 3.0], [5.0, 5.0, 5.0], [5.0, 1e300, 6.0], [0.0, 1.7e9, 1.7e9 + 1]])
def test_no_stamp_drops_a_reading(stamps: list[float]) -> None:
    assert kept(stamps, Options()) == stamps


def test_a_stamp_that_is_far_off_does_not_end_the_recording() -> None:
    assert kept([0.0, 0.1, 1e300, 0.3, 0.4], Options(end=1.0)) == [0.0, 0.1, 1e300, 0.3, 0.4]


def test_start_end_and_every() -> None:
    assert kept(list(np.arange(10.0)), Options(every=2, start=3.0, end=8.0)) == [3.0, 5.0, 7.0]
