"""An infinite stream of training pairs, generated on demand.

Pair k is a function of (seed, k) alone and depends neither on the number of worker processes or machines nor on interruptions.
So there are no seeds of workers to store, and a run is resumed from the next k.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch.utils.data import Dataset

from torchcrf_scan.data.simulate import simulate_pairs
from torchcrf_scan.data.worlds import NAMED_WORLDS
from torchcrf_scan.errors import TorchCRFScanError
from torchcrf_scan.learning.augment import augment, frame_offset
from torchcrf_scan.learning.settings import GradientConfig
from torchcrf_scan.scan import Floats, ScanPair


@dataclass(frozen=True, slots=True)
class Sample:
    """Pair `index` of a stream; `offset` (3,) displaces its target's frame."""

    index: int
    pair: ScanPair
    offset: Floats


def seed_of(*numbers: int) -> int:
    """A seed in [0, 2^63) from a tuple of non-negative integers, practically independent of the seeds of other tuples."""
    return int(np.random.SeedSequence(numbers).generate_state(1, np.uint64)[0] >> np.uint64(1))


class PairStream(Dataset[Sample]):
    """Pair k for every k: simulated, or drawn from given ones, then augmented.

    Args:
        config: worlds, shares, augmentation and seed.
        pairs: annotated pairs that `1 - config.fresh` of the samples are drawn from, each as often as its weight says.
    """

    def __init__(self, config: GradientConfig, pairs: Sequence[ScanPair] = ()) -> None:
        if config.fresh < 1 and not pairs:
            raise TorchCRFScanError(f"gradient.fresh: expected 1 without training pairs, got {config.fresh}")
        self.config = config
        self.pairs = tuple(pairs) if config.fresh < 1 else ()
        weights = torch.tensor([pair.annotation.weight for pair in self.pairs if pair.annotation], dtype=torch.float64)
        self.weights = weights if bool((weights != 1).any()) else None  # equal ones draw as they always did

    def __getitem__(self, index: int) -> Sample:
        generator = torch.Generator().manual_seed(seed_of(self.config.seed, index))
        pair = self._draw(index, generator)
        offset = frame_offset(pair, self.config.augment, generator)
        return Sample(index, augment(pair, self.config.augment, generator), offset)

    def _draw(self, index: int, generator: torch.Generator) -> ScanPair:
        is_fresh = float(torch.rand((), generator=generator)) < self.config.fresh
        places = self.config.worlds if is_fresh else self.pairs
        if not is_fresh and self.weights is not None:
            return self.pairs[int(torch.multinomial(self.weights, 1, generator=generator))]
        place = int(torch.randint(len(places), (), generator=generator))
        if not is_fresh:
            return self.pairs[place]
        return simulate_pairs(NAMED_WORLDS[self.config.worlds[place]], 1, 1, seed_of(self.config.seed, index, 1))[0]


@dataclass(frozen=True, slots=True)
class Parts:
    """The sample indices of every part of this process, step after step from `first` to `last`.

    A step has `batch_size` consecutive indices in `batch_size / part` parts, distributed to `world` processes in turn.
    """

    batch_size: int
    part: int
    first: int
    last: int
    rank: int = 0
    world: int = 1

    def __iter__(self) -> Iterator[list[int]]:
        for step in range(self.first, self.last):
            begin = step * self.batch_size
            for place in range(self.rank, self.batch_size // self.part, self.world):
                yield list(range(begin + place * self.part, begin + (place + 1) * self.part))

    def __len__(self) -> int:
        return (self.last - self.first) * len(range(self.rank, self.batch_size // self.part, self.world))
