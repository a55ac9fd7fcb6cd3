"""The pairs of an experiment with the results shared by all folds."""

from __future__ import annotations

import hashlib
import pickle
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from joblib import Parallel, delayed

from torchcrf_scan.baselines.icp import GATES, found_shares
from torchcrf_scan.experiment.settings import RunConfig
from torchcrf_scan.learning.fit import Margins
from torchcrf_scan.learning.material import Collection, collect
from torchcrf_scan.model import JointScanCRF
from torchcrf_scan.scan import Floats, ScanPair
from torchcrf_scan.whole_file import write_whole

Features = tuple[JointScanCRF, Margins]  # a model with fitted scales and boosters, and its out-of-fold boosters


@dataclass(frozen=True, slots=True)
class Study:
    """The pairs of an experiment with the results shared by all folds.

    Attributes:
        pairs: P annotated pairs. collection: the same, prepared for learning.
        icp_shares: (P, G) share of outliers of ICP at each of its `GATES`.
        kept: folder of fitted scales and boosters, for variants of the model that share them; None: no cache.
    """

    pairs: tuple[ScanPair, ...]
    collection: Collection
    icp_shares: Floats
    kept: Path | None = None

    @classmethod
    def of(cls, pairs: Sequence[ScanPair], config: RunConfig, jobs: int) -> Study:
        """Surveys the pairs on `jobs` cores. Raises TorchCRFScanError for pairs without annotation."""
        collection = collect(pairs, config.learning, jobs)
        if config.experiment.joint_alone:
            return cls(tuple(pairs), collection, np.zeros((len(pairs), len(GATES))))
        shares = Parallel(n_jobs=jobs)(delayed(found_shares)(pair, GATES) for pair in pairs)
        return cls(tuple(pairs), collection, np.stack(shares))

    def features_of(self, key: str) -> Features | None:
        """Cached scales and boosters of a key."""
        place = self._place(key)
        return pickle.loads(place.read_bytes()) if place is not None and place.is_file() else None

    def keep(self, key: str, features: Features) -> None:
        """Saves scales and boosters for other variants, in this or another process; written atomically."""
        place = self._place(key)
        if place is not None and not place.is_file():
            write_whole(place, pickle.dumps(features))

    def _place(self, key: str) -> Path | None:
        return self.kept and self.kept / hashlib.sha256(key.encode()).hexdigest()
