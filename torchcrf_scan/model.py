"""The layer: a conditional random field over two scans (van de Ven, Ramos, Tipaldi, ICRA 2010)."""

from __future__ import annotations

import json
import os
from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from torchcrf_scan.batch import ScanPairBatch, scale_motions
from torchcrf_scan.config import ModelConfig
from torchcrf_scan.encoder.encoder import ScanEncoder
from torchcrf_scan.fast.arrays import fitted_of, settings_of
from torchcrf_scan.fast.choice import can_decode
from torchcrf_scan.fast.pairs import by_beam, decode_pairs, extras_of, predict
from torchcrf_scan.features.learned import EMBEDDING_WEIGHTS, Embeddings, ExtraLogUnary, LearnedInputs
from torchcrf_scan.features.potentials import Boosters, PairView
from torchcrf_scan.features.scales import ASSOCIATION_WEIGHTS, CLUSTERING_WEIGHTS, Scales, has_weight, live_weights
from torchcrf_scan.inference import joint, pseudo_likelihood
from torchcrf_scan.inference.selection import ClusterPotential
from torchcrf_scan.inference.start import Start
from torchcrf_scan.inference.state import Parameters
from torchcrf_scan.inference.uncertainty import Calibration
from torchcrf_scan.loops.pair import pair_of_scans
from torchcrf_scan.prediction import Prediction
from torchcrf_scan.pretrained import PRETRAINED, find_weights, model_config
from torchcrf_scan.scan import PairPrediction, Scan, ScanPair
from torchcrf_scan.search.accept import score_of
from torchcrf_scan.search.pairs import initialise, start_pairs
from torchcrf_scan.search.score import HypothesisScore
from torchcrf_scan.variants import flooding, lattice_likelihood
from torchcrf_scan.variants.paper_start import paper_start
from torchcrf_scan.variants.points_start import points_start


class JointScanCRF(nn.Module):
    """Joint association, clustering and motion of B scan pairs.

    Named weights: the paper's thirty, 18 of the association chain and 12 of the clustering chain (spec 5.1), and those of the
    extensions that are on (`FeatureConfig`). The boosters, the features' scales and the score of the start's hypotheses are
    buffers, fitted before the weights (`torchcrf_scan.learning`).

    Gradients reach the weights, the points and what `forward` is given beside them through log-beliefs and, with
    `inference.motion_weights = soft`, through the motions, at fixed candidates and away from kinks (ties, capped errors). Without
    gradient: the labels, the start, the choice of candidates, the unit of length, what beams measured, and the boosted scores,
    which are steps unless `features.smooth` is above 0. The `flooding` schedule has no gradient at all and fits its motions by
    Eq. 6 on hard labels whatever `motion_metric` and `motion_weights` say.

    With `features.embedding` there are two weights more in `association_weights`, `embedding` and `embedding_data` (see
    `features.learned`), and with `features.learn_stumps` the boosters are parameters. With `encoder` there is a `ScanEncoder`,
    asked once, under the motions of the start; what it says is added to what `forward` is given.
    """

    association_weights: nn.ParameterDict
    clustering_weights: nn.ParameterDict

    def __init__(self, config: ModelConfig | None = None) -> None:
        super().__init__()
        self.config = config or ModelConfig()
        features = self.config.features
        embedding = EMBEDDING_WEIGHTS if features.embedding != "none" else ()
        self.association_weights = self._zeros("association", (*ASSOCIATION_WEIGHTS, *embedding))
        self.clustering_weights = self._zeros("clustering", CLUSTERING_WEIGHTS)
        self.scales = Scales()
        self.boosters = Boosters(features.stumps, width=features.smooth, is_learned=features.learn_stumps)
        self.hypothesis_score = HypothesisScore()
        self.calibration = Calibration()
        self.cluster_potential = ClusterPotential()
        self.encoder = ScanEncoder(self.config.encoder) if self.config.encoder.width > 0 else None
        self.reset_parameters()

    def _zeros(self, chain: str, names: Sequence[str]) -> nn.ParameterDict:
        """A parameter for every weight that the model has."""
        own = [name for name in names if has_weight(self.config.features, f"{chain}.{name}")]
        return nn.ParameterDict([(name, nn.Parameter(torch.zeros(()))) for name in own])

    @torch.no_grad()
    def reset_parameters(self) -> None:
        """Weights that decode something sensible before any learning: near in motion, in sequence, alike in shape."""
        for weight in (*self.association_weights.values(), *self.clustering_weights.values()):
            weight.zero_()
        if "embedding" in self.association_weights:
            self.association_weights["embedding"].fill_(1.0)
        start = {"registered_translation": 1.0, "sequence": 2.0, "pairwise_distance": 0.3, "pairwise_outlier": -1.0}
        for name, value in start.items():
            self.association_weights[name].fill_(value)
        start = {"cluster_distance": 1.0, "outlier": 2.0, "cluster_inlier_in": 1.0, "sequence": 2.0, "pairwise_outlier": -1.0}
        for name, value in start.items():
            self.clustering_weights[name].fill_(value)

    def extra_repr(self) -> str:
        """The settings that decide the shapes."""
        c = self.config.inference
        return f"chains={self.config.chains}, clusters={c.clusters}, candidates={c.candidates or 'dense'}, schedule={c.schedule}"

    @property
    def weight_vectors(self) -> tuple[Tensor, Tensor]:
        """(23,) and (20,): the weights in the order of `ASSOCIATION_WEIGHTS` and `CLUSTERING_WEIGHTS`, 0 for what is left out."""
        none = torch.zeros_like(self.association_weights["sequence"])
        own = dict(self.association_weights.named_parameters()), dict(self.clustering_weights.named_parameters())
        association = torch.stack([own[0].get(name, none) for name in ASSOCIATION_WEIGHTS])
        clustering = torch.stack([own[1].get(name, none) for name in CLUSTERING_WEIGHTS])
        live = live_weights(self.config.features)
        return association * live[0].to(association), clustering * live[1].to(clustering)

    @property
    def fitted(self) -> Parameters:
        """All that was learned, as the inference functions take it."""
        return Parameters(*self.weight_vectors, self.scales, self.boosters, self.calibration, self.cluster_potential)

    def view(self, batch: ScanPairBatch, learned: LearnedInputs | None = None) -> PairView:
        """What the features need of a batch, computed once. learned: what `learned_inputs` made of a larger network's say."""
        return PairView.of(batch, self.config.features.wrap_closed, self.config.features.length_unit, learned)

    def learned_inputs(
        self,
        batch: ScanPairBatch,
        start: Start | None = None,
        *,
        source_embedding: Tensor | None = None,
        target_embedding: Tensor | None = None,
        extra_log_unary: ExtraLogUnary | None = None,
    ) -> LearnedInputs | None:
        """The optional inputs of `forward`, checked, with what the encoder says of the batch; None where there are none.

        start: motions that the encoder is to see the batch under; None: it is not asked.
        """
        extra = extra_log_unary or ExtraLogUnary()
        if self.encoder is not None and start is not None:
            encoded = self.encoder(batch, start, self.config.inference.backend)
            extra = extra.plus(encoded.extra)
            if encoded.source_embedding is not None:
                if source_embedding is not None or target_embedding is not None:
                    raise ValueError("source_embedding: expected none for a model whose encoder makes embeddings, got one")
                source_embedding, target_embedding = encoded.source_embedding, encoded.target_embedding
        given = {"source_embedding": source_embedding, "target_embedding": target_embedding}
        given |= {"extra_log_unary.outlier": extra.outlier, "extra_log_unary.moving": extra.moving}
        if all(value is None for value in given.values()):
            return None
        if self.config.inference.schedule == "flooding":
            raise ValueError("schedule: expected sweep with embeddings or extra_log_unary, got flooding")
        for name, value in given.items():
            points = batch.target_mask if name == "target_embedding" else batch.source_mask
            wanted = (*points.shape, "C") if name.endswith("embedding") else tuple(points.shape)
            if value is not None and (value.dim() != len(wanted) or value.shape[:2] != points.shape):
                raise ValueError(f"{name}: expected shape {wanted}, got {tuple(value.shape)}")
        outlier, moving = (None if of is None else torch.where(batch.source_mask, of, 0.0) for of in (extra.outlier, extra.moving))
        return LearnedInputs(self._embeddings(batch, source_embedding, target_embedding), outlier, moving)

    def _embeddings(self, batch: ScanPairBatch, source: Tensor | None, target: Tensor | None) -> Embeddings | None:
        if source is None and target is None:
            return None
        kind = self.config.features.embedding
        if kind == "none":
            raise ValueError("source_embedding: expected none for a model with features.embedding none, got one")
        if source is None or target is None or source.shape[2] != target.shape[2]:
            got = [None if of is None else tuple(of.shape) for of in (source, target)]
            raise ValueError(f"target_embedding: expected both embeddings with the same C, got {got[0]} and {got[1]}")
        weights = self.association_weights["embedding"], self.association_weights["embedding_data"]
        return Embeddings.of(source, target, (batch.source_mask, batch.target_mask), kind, weights)

    def initialise(self, batch: ScanPairBatch) -> Start:
        """InitialiseRT: the motions to begin with (Algorithm 1, line 1). No gradient."""
        found = initialise(batch, score_of(self.hypothesis_score), self._clusters)
        if self.config.start == "search":
            return found
        look = {"paper": paper_start, "points": points_start}[self.config.start]
        with torch.autocast(batch.source.device.type, enabled=False):  # a few centimetres decide which movers there are
            view = self.view(batch)
            return look(view, found.scaled(view.factor), self.fitted, self.config.inference).scaled(1 / view.factor)

    @property
    def _clusters(self) -> int:
        """C: motions of background and movers."""
        return 1 if self.config.chains == "matching" else self.config.inference.clusters - 1

    def forward(
        self,
        batch: ScanPairBatch,
        start: Start | None = None,
        *,
        source_embedding: Tensor | None = None,
        target_embedding: Tensor | None = None,
        extra_log_unary: ExtraLogUnary | None = None,
    ) -> Prediction:
        """Labels, motions and log-beliefs of every pair.

        Args:
            batch: B pairs.
            start: motions to begin with; looked for where absent. For `ClusteringCRF` its association is the fixed one.
            source_embedding, target_embedding: (B, N, C), (B, M, C) of the points, for a model with `features.embedding`: alike
                ones are associated. The start is looked for without them. None: as if the model knew none.
            extra_log_unary: (B, N) learned log potentials of outliers and of moving points.
        """
        start = start or self.initialise(batch)
        learned = self.learned_inputs(
            batch, start, source_embedding=source_embedding, target_embedding=target_embedding, extra_log_unary=extra_log_unary
        )
        decode = self._in_loops if self._needs_no_tensors(batch, learned) else self._in_tensors
        return decode(batch, start, learned)

    def _needs_no_tensors(self, batch: ScanPairBatch, learned: LearnedInputs | None) -> bool:
        """Whether the loops answer: on a CPU, for settings that they know, where there is no gradient to follow."""
        extra = () if learned is None else (learned.outlier, learned.moving)
        tensors = (*self.parameters(), batch.source, batch.target, batch.initial_motion, *extra)
        needs_gradient = torch.is_grad_enabled() and any(tensor is not None and tensor.requires_grad for tensor in tensors)
        has_embeddings = learned is not None and learned.embeddings is not None
        return can_decode(self.config, batch.source.device, needs_gradient=needs_gradient, has_embeddings=has_embeddings)

    def _in_loops(self, batch: ScanPairBatch, start: Start, learned: LearnedInputs | None) -> Prediction:
        return predict(batch, start, fitted_of(self.fitted), settings_of(self.config), learned)

    def _in_tensors(self, batch: ScanPairBatch, start: Start, learned: LearnedInputs | None) -> Prediction:
        view = self.view(batch, learned)
        schedule = {"sweep": joint.decode, "flooding": flooding.decode}[self.config.inference.schedule]
        prediction = schedule(view, start.scaled(view.factor), self.fitted, self.config)
        uncertainty = prediction.uncertainty and prediction.uncertainty.scaled(1 / view.factor)
        return replace(prediction, motions=scale_motions(prediction.motions, 1 / view.factor), uncertainty=uncertainty)

    def pseudo_log_likelihood(self, batch: ScanPairBatch, plugins: pseudo_likelihood.PlugIns | None = None) -> Tensor:
        """(B,) log pseudo-likelihood of the annotation: every label given its true neighbours (spec 6.2). Needs `batch.truth`.

        plugins: motions and labels taken as observed in the features, in the unit of `view`; the true ones where absent.
        """
        if batch.truth is None:
            raise ValueError("batch.truth: expected annotated pairs, got a batch without truth")
        view = self.view(batch)
        plugins = plugins or pseudo_likelihood.true_plugins(view.batch, self.config.inference.clusters - 1)
        if self.config.chains == "matching":
            plugins = pseudo_likelihood.for_background_alone(plugins)
        if self.config.coupling == "lattice":
            return lattice_likelihood.pseudo_log_likelihood(view, plugins, self.fitted, self.config.inference)
        return pseudo_likelihood.pseudo_log_likelihood(view, plugins, self.fitted, self.config)

    @torch.no_grad()
    def match(
        self, source: Scan, target: Scan, dt: float = 0.1, *, initial_motion: Sequence[float] | None = None
    ) -> PairPrediction:
        """One pair, by beam: what became of every beam of `source`, which move together, and how.

        initial_motion: a guess (theta, tx, ty) of the background's motion, e.g. from odometry; one more start, never
                trusted blindly.
        """
        pair = ScanPair(source, target, dt, initial_motion=None if initial_motion is None else np.asarray(initial_motion))
        return self.match_pairs([pair])[0]

    @torch.no_grad()
    def match_pairs(self, pairs: Sequence[ScanPair], batch_size: int = 16) -> list[PairPrediction]:
        """Many pairs, in batches."""
        found: list[PairPrediction] = []
        for begin in range(0, len(pairs), batch_size):
            found += self._match(pairs[begin : begin + batch_size])
        return found

    def _match(self, pairs: Sequence[ScanPair]) -> list[PairPrediction]:
        """The answers for one batch of pairs: in arrays all the way where the loops answer, in padded tensors elsewhere."""
        reference = self.association_weights["sequence"]
        has_embeddings = self.config.encoder.embedding > 0
        if self.config.start != "search" or not can_decode(self.config, reference.device, has_embeddings=has_embeddings):
            prediction = self(ScanPairBatch.collate(pairs, reference.dtype).without_truth().to(reference.device))
            return [prediction.pair(b, pair) for b, pair in enumerate(pairs)]
        scans = [pair_of_scans(pair, reference.dtype) for pair in pairs]
        starts = start_pairs(scans, score_of(self.hypothesis_score), self._clusters)
        extras = extras_of(
            [len(pair.source) for pair in scans], None if self.encoder is None else self.encoder.of_pairs(scans, starts)
        )
        answers = decode_pairs(scans, starts, extras, fitted_of(self.fitted), settings_of(self.config))
        return [by_beam(answer, pair) for answer, pair in zip(answers, pairs, strict=True)]

    def save_pretrained(self, folder: str | Path) -> None:
        """Writes `config.json` and `model.safetensors` into a folder, each whole or not at all."""
        from safetensors.torch import save

        folder = Path(folder)
        folder.mkdir(parents=True, exist_ok=True)
        contents = {
            "config.json": (json.dumps(asdict(self.config), indent=2) + "\n").encode(),
            "model.safetensors": save({name: value.detach().cpu().contiguous() for name, value in self.state_dict().items()}),
        }
        for name, content in contents.items():
            temporary = folder / f".{name}.{os.getpid()}"
            temporary.write_bytes(content)
            os.replace(temporary, folder / name)

    @classmethod
    def from_pretrained(
        cls, name_or_path: str | Path = PRETRAINED, *, features: dict[str, Any] | None = None, **inference: Any
    ) -> JointScanCRF:
        """A model from a folder written by `save_pretrained`, or one that the package ships, by name.

        Args:
            name_or_path: a folder, or a name under `torchcrf_scan/weights`.
            features: `smooth`, `learn_stumps` or `embedding` of `FeatureConfig` to change; weights that the saved model has not
                begin as in a new one.
            inference: fields of `InferenceConfig` to change, e.g. `candidates=0`.
        """
        from safetensors.torch import load

        folder = find_weights(name_or_path)
        config = model_config(json.loads((folder / "config.json").read_text()))
        if inference:
            config = replace(config, inference=replace(config.inference, **inference))
        if features:
            config = replace(config, features=replace(config.features, **features))
        model = cls(config)
        saved = load((folder / "model.safetensors").read_bytes())
        model.load_state_dict({**model.embedding_state, **saved} if features else saved)
        return model.eval()

    @property
    def embedding_state(self) -> dict[str, Tensor]:
        """The part of the model's state that another without embeddings has not."""
        return {name: value for name, value in self.state_dict().items() if name.rpartition(".")[2] in EMBEDDING_WEIGHTS}


class MatchingCRF(JointScanCRF):
    """The association chain alone, 18 weights, one motion for the whole scan (A-25): CRF-Matching."""

    def __init__(self, config: ModelConfig | None = None) -> None:
        super().__init__(replace(config or ModelConfig(), chains="matching", coupling="motions"))


class ClusteringCRF(JointScanCRF):
    """The clustering chain alone, 12 weights, on associations that come with the start and stay: CRF-Clustering."""

    def __init__(self, config: ModelConfig | None = None) -> None:
        super().__init__(replace(config or ModelConfig(), chains="clustering", coupling="motions"))
