"""What a staged fit shows of itself: objectives and weights while it runs, then the answers that it would have given on its way.

The accuracy cannot be told while a fit runs, as both chains are fitted one after the other: the weights of every step are kept,
and when all is fitted a few steps of both chains together are looked at.
"""

from __future__ import annotations

import copy
from collections.abc import Sequence

import torch
from torch import Tensor

from torchcrf_scan.baselines.start import label_nearest
from torchcrf_scan.batch import ScanPairBatch
from torchcrf_scan.evaluation.metrics import score_pairs
from torchcrf_scan.evaluation.summary import summarise
from torchcrf_scan.learning.fit import set_weights
from torchcrf_scan.learning.run_log import RunLog
from torchcrf_scan.learning.validation import BASELINE
from torchcrf_scan.learning.weights_fit import Watch
from torchcrf_scan.model import JointScanCRF
from torchcrf_scan.names import ASSOCIATION_WEIGHTS, CLUSTERING_WEIGHTS
from torchcrf_scan.scan import ScanPair
from torchcrf_scan.variants.register import ONE_CHAINS

LOOKS = (1, 4, 16)  # steps that are looked at, and the last one
MOST = 16  # pairs


class StagedWatch:
    """The steps of a model's staged fit. run: of the run folder."""

    def __init__(self, run: RunLog) -> None:
        self.run = run
        self.paths: dict[str, list[Tensor]] = {}

    def watches(self) -> dict[str, Watch]:
        """Callbacks of the weight fits, by chain."""

        def watch(chain: str) -> Watch:
            def look(step: int, loss: float, slope: float, weights: Tensor) -> None:
                self.run.objective(f"joint/{chain}", step, loss, slope)
                self.run.weights(step, weights)
                self.paths.setdefault(chain, []).append(weights.clone())

            return look

        return {chain: watch(chain) for chain in ("association", "clustering", *ONE_CHAINS)}

    @property
    def last(self) -> int:
        """The last step of the longest fit."""
        return max((len(path) for path in self.paths.values()), default=0)

    @torch.no_grad()
    def look_back(self, model: JointScanCRF, pairs: Sequence[ScanPair]) -> None:
        """Curves of the accuracy at a few steps, on some of the pairs, beside the start's, which has nothing to learn."""
        some = pairs[:: -(-len(pairs) // MOST)] if pairs else []
        if not some or not self.paths:
            return
        batch = ScanPairBatch.collate(some).without_truth()
        start = model.initialise(batch)
        rival = label_nearest(batch, start)
        for step in (0, self.last):
            self.run.curves(summarise(score_pairs(some, rival.of_pairs(some))), step, BASELINE)
        for step in sorted({*(look for look in LOOKS if look < self.last), self.last}):
            found = self.at(step, model)(batch, start)
            self.run.curves(summarise(score_pairs(some, found.of_pairs(some))), step)

    def at(self, step: int, model: JointScanCRF) -> JointScanCRF:
        """The model with the weights of a step of both chains; those of the last one for a chain that was done before."""
        other = copy.deepcopy(model)
        for chain, path in self.paths.items():
            weights = path[min(step, len(path)) - 1]
            if chain in ONE_CHAINS:
                both = weights.split([len(ASSOCIATION_WEIGHTS), len(CLUSTERING_WEIGHTS)])
                for name, part in zip(("association", "clustering"), both, strict=True):
                    set_weights(other, name, part)
            else:
                set_weights(other, chain, weights)
        return other
