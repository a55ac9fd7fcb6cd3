"""Survey of one pair before the learned score: background, leftover, hypotheses; nearly all the time of InitialiseRT."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from torchcrf_scan.loops.jit import Array, Booleans
from torchcrf_scan.loops.pair import Pair
from torchcrf_scan.search.expected import Expected, with_expected
from torchcrf_scan.search.feature_points import AT
from torchcrf_scan.search.grid import ScanGrid, grid_of
from torchcrf_scan.search.hypotheses import Hypotheses, hypothesise
from torchcrf_scan.search.hypothesis_features import hypothesis_features
from torchcrf_scan.search.leftover import Leftover, leftover_of
from torchcrf_scan.search.sides import Sides, sliding_sides
from torchcrf_scan.search.surface import surface_of

NEW = 0.3  # share of a group's new places that what stands leaves unexplained, below which it may stand if
HIDDEN = 0.5  # this share or more of it is hidden from the second scan where it stood


class Survey(NamedTuple):
    """What is found of a pair before the score.

    Attributes:
        leftover: of the background's motion. hypotheses: H motions of movers. features: (H, F) of these.
        sides: that slide along themselves.
    """

    leftover: Leftover
    hypotheses: Hypotheses
    features: Array
    sides: Sides


def grids_of(pair: Pair) -> tuple[ScanGrid, ScanGrid]:
    """Grids of source and target, of at least one point each."""
    source = surface_of(pair.source, pair.noise, pair.source_closed, np.zeros(2))
    target = surface_of(pair.target, pair.noise, pair.target_closed, pair.target_origin)
    return grid_of(source), grid_of(target)


def survey_at(source: ScanGrid, target: ScanGrid, background: Array, dt: float, expected: Expected | None = None) -> Survey:
    """Leftover of a background motion (3,), hypotheses of movers and their features.

    dt: seconds between the scans. expected: movers known from before.
    """
    leftover = leftover_of(source, target, background)
    hypotheses = hypothesise(leftover, dt)
    if expected is not None and len(expected.motions) > 0:
        hypotheses = with_expected(hypotheses, expected, leftover)
    return Survey(leftover, hypotheses, hypothesis_features(leftover, hypotheses), sliding_sides(leftover))


def without_standing(seen: Survey) -> Survey:
    """The survey without the hypotheses whose groups may as well stand."""
    moves, hypotheses = ~may_stand(seen.features), seen.hypotheses
    hypotheses = hypotheses._replace(motions=hypotheses.motions[moves], group=hypotheses.group[moves])
    return seen._replace(hypotheses=hypotheses, features=seen.features[moves])


def may_stand(features: Array) -> Booleans:
    """(H,) whether a group may as well stand: whatever is found at its new place was there before. features: (H, F).

    The edge of a shadow runs along a wall like a mover.
    """
    return (features[:, AT.landing_open] < NEW) & (features[:, AT.occluded_before] >= HIDDEN)
