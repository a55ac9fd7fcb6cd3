"""Pair k of a stream is pair k, whoever asks for it and when."""

from collections import Counter
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from torchcrf_scan.data.simulate import simulate_pairs
from torchcrf_scan.data.worlds import SimulatorConfig
from torchcrf_scan.learning.settings import GradientConfig
from torchcrf_scan.learning.stream import PairStream, Parts, Sample, seed_of


def same(a: Sample, b: Sample) -> bool:
    scans = [(of.pair.source.ranges, of.pair.target.ranges, of.offset) for of in (a, b)]
    return all(np.array_equal(x, y) for x, y in zip(*scans, strict=True))


def test_a_pair_depends_on_seed_and_index_alone() -> None:
    stream = PairStream(GradientConfig(worlds=("street", "indoor")))
    first = stream[7]
    _ = stream[3]
    assert same(stream[7], first)
    assert same(PairStream(GradientConfig(worlds=("street", "indoor")))[7], first)
    assert not same(stream[8], first)
    assert not same(PairStream(GradientConfig(worlds=("street", "indoor"), seed=1))[7], first)
    assert first.index == 7
    assert first.pair.annotation is not None


def test_given_pairs_are_drawn_where_not_all_are_fresh() -> None:
    pairs = simulate_pairs(SimulatorConfig(beams=31), 4, 2, 0)
    stream = PairStream(GradientConfig(fresh=0.0), pairs)
    drawn = Counter((stream[k].pair.sequence, stream[k].pair.name) for k in range(40))
    assert set(drawn) == {(pair.sequence, pair.name) for pair in pairs}
    mixed = PairStream(GradientConfig(fresh=0.5), pairs)
    sequences = {pair.sequence for pair in pairs}
    share = np.mean([mixed[k].pair.sequence in sequences for k in range(24)])
    assert 0.2 < share < 0.8


def test_uncertain_pairs_are_drawn_as_often_as_their_weight_says() -> None:
    one, other = simulate_pairs(SimulatorConfig(beams=31), 2, 2, 0)
    assert one.annotation is not None
    never = replace(one, annotation=replace(one.annotation, weight=0.0))
    rarely = replace(one, annotation=replace(one.annotation, weight=0.25))
    assert {PairStream(GradientConfig(fresh=0.0), [never, other])[k].pair.name for k in range(20)} == {other.name}
    stream = PairStream(GradientConfig(fresh=0.0), [rarely, other])
    share = np.mean([stream[k].pair.name == one.name for k in range(200)])
    assert 0.1 < share < 0.3


def test_no_given_pairs_is_an_error_where_they_are_needed() -> None:
    with pytest.raises(ValueError, match=r"gradient.fresh: expected 1 without training pairs, got 0.5"):
        PairStream(GradientConfig(fresh=0.5))


@given(parts=st.integers(1, 6), part=st.integers(1, 4), first=st.integers(0, 5), steps=st.integers(0, 4), world=st.integers(1, 6))
def test_processes_share_every_step_out(parts: int, part: int, first: int, steps: int, world: int) -> None:
    size = parts * part
    by_rank = [list(Parts(size, part, first, first + steps, rank, world)) for rank in range(world)]
    assert sorted(k for of_rank in by_rank for row in of_rank for k in row) == list(range(first * size, (first + steps) * size))
    for rank, rows in enumerate(by_rank):
        assert len(rows) == len(Parts(size, part, first, first + steps, rank, world))
        assert all(len(row) == part for row in rows)
    alone = list(Parts(size, part, 0, first + steps))
    assert list(Parts(size, part, first, first + steps)) == alone[first * parts :]  # going on is asking for the rest


@given(a=st.tuples(st.integers(0, 100), st.integers(0, 100)), b=st.tuples(st.integers(0, 100), st.integers(0, 100)))
def test_seeds_differ(a: tuple[int, int], b: tuple[int, int]) -> None:
    assert (seed_of(*a) == seed_of(*b)) == (a == b)
    assert 0 <= seed_of(*a) < 2**63
