"""Separate reasoning: CRF-Matching first, then CRF-Clustering on its associations, without feedback (spec 9.2, 9.4)."""

from __future__ import annotations

import torch

from torchcrf_scan.batch import ScanPairBatch
from torchcrf_scan.inference.start import Start
from torchcrf_scan.model import ClusteringCRF, MatchingCRF
from torchcrf_scan.prediction import Prediction
from torchcrf_scan.variants.paper_start import movers_from_associations, paper_start


class Cascade:
    """CRF-Clustering on the associations of CRF-Matching, without feedback (spec 9.4)."""

    def __init__(self, matching: MatchingCRF, clustering: ClusteringCRF) -> None:
        self.matching, self.clustering = matching, clustering

    @torch.no_grad()
    def match_from_own_start(self, batch: ScanPairBatch, start: Start) -> Prediction:
        """CRF-Matching from the motion that it finds itself, by shape alone (spec 7.3). start: its motions are not used."""
        view = self.matching.view(batch)
        own = paper_start(view, view.in_unit(start.background_alone()), self.matching.fitted, self.matching.config.inference)
        return self.matching(batch, view.in_metres(own))

    @torch.no_grad()
    def feed(self, batch: ScanPairBatch, start: Start) -> Start:
        """CRF-Matching's associations, its motion as background, movers from the runs of its residuals."""
        matched = self.matching(batch, start.background_alone())
        clusters = self.clustering.config.inference.clusters - 1
        view, fitted = self.clustering.view(batch), self.matching.fitted
        background = view.in_unit(matched.motions[:, 0])
        fed = movers_from_associations(view, background, matched.association, fitted, clusters, start.target_tangents)
        return view.in_metres(fed)

    def __call__(self, batch: ScanPairBatch, start: Start) -> Prediction:
        """Decodes a batch."""
        return self.clustering(batch, self.feed(batch, start))
