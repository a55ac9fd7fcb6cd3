"""The pairs to time: simulated streets at any angular resolution, with simulated odometry."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from torchcrf_scan.data.simulate import simulate_pairs
from torchcrf_scan.data.worlds import WORLDS
from torchcrf_scan.scan import BACKGROUND, ScanPair

MODES = ("cold", "warm")  # without and with a prior motion
SEED = 20_000  # far from the seeds of training and test pairs
ODOMETRY_SHIFT, ODOMETRY_TURN = 0.02, math.radians(0.3)  # metres, radians: standard deviations of the prior


def street_pairs(beams: int, count: int) -> list[ScanPair]:
    """Pairs of as many drives."""
    return simulate_pairs(replace(WORLDS["street"], beams=beams), count, count, SEED)


def in_mode(pairs: Sequence[ScanPair], mode: str) -> list[ScanPair]:
    """The pairs without a prior motion (`cold`), or with the annotated one plus odometry errors (`warm`); unannotated: none."""
    if mode == "cold":
        return [replace(pair, initial_motion=None) for pair in pairs]
    generator = np.random.default_rng(SEED)
    found = []
    for pair in pairs:
        noise = generator.normal(scale=[ODOMETRY_TURN, ODOMETRY_SHIFT, ODOMETRY_SHIFT])
        if pair.annotation is not None and np.isfinite(pair.annotation.motions[BACKGROUND]).all():
            found.append(replace(pair, initial_motion=pair.annotation.motions[BACKGROUND] + noise))
    return found


def cycle(pairs: Sequence[ScanPair], first: int, count: int) -> list[ScanPair]:
    """`count` pairs from index `first` on, cyclically."""
    return [pairs[(first + k) % len(pairs)] for k in range(count)]
