"""From two scans to the start of the labelling, step by step."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from torchcrf_scan.compiled.decode import Pair
from torchcrf_scan.compiled.field import Field, field_of
from torchcrf_scan.compiled.hypotheses import Hypotheses, hypothesise
from torchcrf_scan.compiled.hypothesis_features import hypothesis_features
from torchcrf_scan.compiled.jit import Array
from torchcrf_scan.compiled.leftover import Leftover, leftover_of
from torchcrf_scan.compiled.movers import Score
from torchcrf_scan.compiled.shape import resolution
from torchcrf_scan.compiled.start import Start, choose_movers
from torchcrf_scan.compiled.surface import surface_of


class Surveyed(NamedTuple):
    """What the scans of one pair say before anything learned is asked; `inference.initialise.Survey`."""

    leftover: Leftover
    hypotheses: Hypotheses
    features: Array


def fields_of(pair: Pair) -> tuple[Field, Field]:
    """Source and target."""
    source = surface_of(pair.source, pair.noise, pair.source_closed, np.zeros(2))
    target = surface_of(pair.target, pair.noise, pair.target_closed, pair.target_origin)
    return field_of(source), field_of(target)


def survey_at(source: Field, target: Field, background: Array, dt: float) -> Surveyed:
    """What a motion of the background (3,) leaves, and what may have moved. dt: seconds."""
    leftover = leftover_of(source, target, background)
    hypotheses = hypothesise(leftover, dt)
    return Surveyed(leftover, hypotheses, hypothesis_features(leftover, hypotheses))


def start_at(source: Field, target: Field, background: Array, guess: Array, dt: float, score: Score, clusters: int) -> Start:
    """The start at a motion of the background (3,). guess: (3,) of clusters that are not there. dt: seconds. clusters: C."""
    seen = survey_at(source, target, background, dt)
    unit = resolution(source.scan.points, target.scan.points, source.scan.noise)
    return choose_movers(seen.leftover, guess, seen.hypotheses, seen.features, score, clusters, unit)
