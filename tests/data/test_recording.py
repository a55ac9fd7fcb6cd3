"""A recording as pairs, read anew as they are asked for."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from torchcrf_scan.data.reading import Reading
from torchcrf_scan.data.recording import Recording, motions_between
from torchcrf_scan.geometry import se2
from torchcrf_scan.scan import Scan


class Counted:
    """Readings 0, 1, 2 ... metres before a wall, counted as they are read."""

    def __init__(self, count: int, fault: int | None = None) -> None:
        self.count, self.fault, self.reads = count, fault, 0

    def __call__(self) -> Iterator[Reading]:
        for k in range(self.count):
            if k == self.fault:
                raise ValueError(f"fault at {k}")
            self.reads += 1
            yield Reading(Scan.from_ranges([1.0 + k], [0.0]), 0.1 * k, np.array([0.0, float(k), 0.0]))


@given(st.lists(st.integers(-9, 8), max_size=6))
def test_any_pair_is_the_right_one(indices: list[int]) -> None:
    log = Recording(Path("run.log"), Counted(10))
    for index in indices:
        pair = log[index]
        assert pair.source.ranges[0] == 1 + index % 9
        assert pair.target.ranges[0] == pair.source.ranges[0] + 1
        assert pair.name == f"run_{index % 9:05d}"
        assert pair.initial_motion.tolist() == [0, -1, 0]
    assert [pair.source.ranges[0] for pair in log[2:5]] == [3, 4, 5]


def test_reading_forward_reads_twice() -> None:
    source = Counted(10)
    log = Recording("run.log", source)
    assert source.reads == 10
    assert len(list(log)) == 9
    assert source.reads == 20


def test_pairs_before_a_fault_are_there(caplog: pytest.LogCaptureFixture) -> None:
    log = Recording("run.log", Counted(10, fault=4))
    assert len(list(log)) == 3
    assert str(log.fault) == "fault at 4"
    assert "fault at 4; the 4 scans before that are read" in caplog.text
    with pytest.raises(ValueError, match="fault at 1"):
        Recording("run.log", Counted(10, fault=1))


@pytest.mark.parametrize("count", [0, 1])
def test_fewer_than_two_scans_are_refused(count: int) -> None:
    with pytest.raises(ValueError, match=f"run.log: expected at least two scans, got {['none', 'one'][count]}"):
        Recording("run.log", Counted(count))


def test_motions_between_poses() -> None:
    poses = [np.array([0.1, 1.0, 2.0]), np.array([0.4, 1.5, 2.5]), None, np.array([0.0, 0.0, 0.0])]
    first, *rest = motions_between(poses)
    np.testing.assert_allclose(se2.compose(poses[1], first), poses[0])
    assert rest == [None, None]
    assert motions_between([np.ones(3)] * 3) == [None, None]
    assert motions_between([None] * 3) == [None, None]
    assert motions_between([np.zeros(3), np.array([0.0, 1e9, 0.0])]) == [None]
