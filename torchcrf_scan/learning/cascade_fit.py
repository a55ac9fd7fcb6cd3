"""Fits the two chains separately: CRF-Matching, then CRF-Clustering on its associations, with out-of-fold boosters."""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from dataclasses import replace

from torchcrf_scan.baselines.cascade import Cascade
from torchcrf_scan.config import EncoderConfig
from torchcrf_scan.learning.fit import fit
from torchcrf_scan.learning.material import Material
from torchcrf_scan.learning.settings import Config
from torchcrf_scan.learning.weights_fit import Watch
from torchcrf_scan.model import ClusteringCRF, MatchingCRF


def fit_cascade(material: Sequence[Material], config: Config, watch: Mapping[str, dict[str, Watch]] | None = None) -> Cascade:
    """The fitted cascade. watch: callbacks of the weight fits, of `matching` and of `clustering`, see `fit`."""
    watch = watch or {}
    bare = replace(config.model, encoder=EncoderConfig())  # its potentials are learned for both chains together
    matching, clustering = MatchingCRF(bare), ClusteringCRF(bare)
    margins = fit(matching, material, config.learning, watch.get("matching"))
    fed = []
    for part in material:
        unseen = copy.deepcopy(matching)
        unseen.boosters = margins[part.fold]
        start = Cascade(unseen, clustering).feed(part.batch, part.start)
        fed.append(replace(part, start=start))
    fit(clustering, fed, config.learning, watch.get("clustering"))
    return Cascade(matching, clustering)
