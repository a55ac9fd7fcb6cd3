"""The conditional random field over two scans as a torch module (van de Ven, Ramos, Tipaldi, ICRA 2010)."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from torchcrf_scan.adjoint import layer as adjoint
from torchcrf_scan.adjoint.layer import Unrolled
from torchcrf_scan.batch import ScanPairBatch, batches
from torchcrf_scan.choices import STARTS
from torchcrf_scan.config import ModelConfig
from torchcrf_scan.encoder.encoder import ScanEncoder
from torchcrf_scan.errors import TorchCRFScanError
from torchcrf_scan.evaluation.causes.trace import SearchTrace
from torchcrf_scan.fast.arrays import fitted_of, settings_of
from torchcrf_scan.fast.choice import can_decode
from torchcrf_scan.fast.pairs import by_beam, decode_pairs, extras_of, predict
from torchcrf_scan.features.learned import EMBEDDING_WEIGHTS, Embeddings, ExtraLogUnary, LearnedInputs
from torchcrf_scan.features.potentials import Boosters, PairView
from torchcrf_scan.features.scales import Scales, has_weight, live_weights
from torchcrf_scan.inference import joint, pseudo_likelihood
from torchcrf_scan.inference.start import Start
from torchcrf_scan.inference.state import ClusterPotential, Parameters
from torchcrf_scan.inference.uncertainty import Calibration
from torchcrf_scan.inputs import check_batch, check_inputs, check_plugins, check_start, full_precision
from torchcrf_scan.loops.choice import is_in_transform
from torchcrf_scan.loops.pair import pair_of_scans
from torchcrf_scan.names import ASSOCIATION_WEIGHTS, CLUSTERING_WEIGHTS, SCALED_EDGES
from torchcrf_scan.prediction import Prediction
from torchcrf_scan.pretrained import PRETRAINED, find_weights, load_state, read_config, write_model
from torchcrf_scan.scan import PairPrediction, Scan, ScanPair
from torchcrf_scan.search.accept import score_of
from torchcrf_scan.search.expected import Expected
from torchcrf_scan.search.pairs import initialise, start_pairs
from torchcrf_scan.search.score import HypothesisScore
from torchcrf_scan.search.survey import Survey
from torchcrf_scan.search.trace import trace_of
from torchcrf_scan.variants import sweep
from torchcrf_scan.variants.register import BEGINNINGS, DECODERS, LIKELIHOODS

BothEmbeddings = tuple[Tensor | None, Tensor | None]  # of source and target


class JointScanCRF(nn.Module):
    """Data association, clustering and motions of B scan pairs by a log-linear conditional random field.

    Parameters: one named weight per feature. Thirty are of the features that the paper describes, 18 of the association chain and
    12 of the clustering chain: as many as it counts, but which they are is a reconstruction (spec 5.2). Enabled extensions
    (`FeatureConfig`) and embeddings (`features.learned`) add theirs. Buffers: boosters, scales of the features and the score of
    hypothesised movers, which are fitted before the weights (`torchcrf_scan.learning`); with `features.learn_stumps` the boosters
    are parameters. With `encoder` a `ScanEncoder` adds log potentials and embeddings.

    Gradients: log-beliefs are differentiable in the weights, the points and the optional inputs of `forward`, and so are the
    motions with `inference.motion_weights = soft`; at fixed candidates and away from kinks (ties, clipped errors). Labels, start,
    candidates, unit of length, free space and boosted scores (steps unless `features.smooth` is above 0) have none. The schedule
    `flooding` has no gradient and fits its motions by Eq. 6 on hard labels, whatever the metric and the weights.

    Args:
        config: settings; None: the defaults. The weights are those of `reset_parameters`; `from_pretrained` loads fitted ones.
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
        """One parameter for every weight of the model."""
        own = [name for name in names if has_weight(self.config.features, f"{chain}.{name}")]
        return nn.ParameterDict([(name, nn.Parameter(torch.zeros(()))) for name in own])

    @torch.no_grad()
    def reset_parameters(self) -> None:
        """Sets hand-chosen weights that decode reasonably without training: near in motion, in sequence, similar in shape."""
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
        """The settings that determine the shapes."""
        c = self.config.inference
        return f"chains={self.config.chains}, clusters={c.clusters}, candidates={c.candidates or 'dense'}, schedule={c.schedule}"

    @property
    def weight_vectors(self) -> tuple[Tensor, Tensor]:
        """(23,) and (21,): the weights in the order of `ASSOCIATION_WEIGHTS` and `CLUSTERING_WEIGHTS`, 0 for left-out features."""
        none = torch.zeros_like(self.association_weights["sequence"])
        own = dict(self.association_weights.named_parameters()), dict(self.clustering_weights.named_parameters())
        association = torch.stack([own[0].get(name, none) for name in ASSOCIATION_WEIGHTS])
        clustering = torch.stack([own[1].get(name, none) for name in CLUSTERING_WEIGHTS])
        live = live_weights(self.config.features)
        return association * live[0].to(association), clustering * live[1].to(clustering)

    @property
    def fitted(self) -> Parameters:
        """All fitted quantities, as the inference functions take them."""
        return Parameters(*self.weight_vectors, self.scales, self.boosters, self.calibration, self.cluster_potential)

    def view(
        self, batch: ScanPairBatch, learned: LearnedInputs | None = None, outlier_distance: float | Tensor | None = None
    ) -> PairView:
        """The batch prepared for the features, computed once.

        Args:
            learned: output of `learned_inputs`. outlier_distance: as in `forward`.
        """
        features = self.config.features
        limit = self.config.inference.outlier_distance if outlier_distance is None else outlier_distance
        has_lengths = not {f"association.{name}" for name in SCALED_EDGES} <= {*features.left_out}
        return PairView.of(batch, features.wrap_closed, features.length_unit, learned, features.reach, has_lengths, limit)

    def learned_inputs(
        self,
        batch: ScanPairBatch,
        start: Start | None = None,
        *,
        source_embedding: Tensor | None = None,
        target_embedding: Tensor | None = None,
        extra_log_unary: ExtraLogUnary | None = None,
    ) -> LearnedInputs | None:
        """The optional inputs of `forward`, checked and combined with the output of the encoder; None if there are none.

        start: motions under which the encoder aligns the batch; None: the encoder is not applied.
        """
        extra, embeddings = extra_log_unary or ExtraLogUnary(), (source_embedding, target_embedding)
        self._check(batch, start)
        check_inputs(batch, extra, embeddings)
        if self.encoder is not None and start is not None:
            extra, embeddings = self._with_encoder(self.encoder, batch, start, extra, embeddings)
        if all(value is None for value in (*embeddings, extra.outlier, extra.moving)):
            return None
        self.config.require("takes_extras", "with embeddings or extra_log_unary")
        outlier, moving = (None if of is None else torch.where(batch.source_mask, of, 0.0) for of in (extra.outlier, extra.moving))
        return LearnedInputs(self._embeddings(batch, *embeddings), outlier, moving)

    def _with_encoder(
        self, encoder: ScanEncoder, batch: ScanPairBatch, start: Start, extra: ExtraLogUnary, embeddings: BothEmbeddings
    ) -> tuple[ExtraLogUnary, BothEmbeddings]:
        """The optional inputs combined with the output of the encoder."""
        encoded = encoder(batch, start, self.config.inference.backend)
        if encoded.source_embedding is None:
            return extra.plus(encoded.extra), embeddings
        if any(of is not None for of in embeddings):
            raise TorchCRFScanError("source_embedding: expected none for a model whose encoder makes embeddings, got one")
        return extra.plus(encoded.extra), (encoded.source_embedding, encoded.target_embedding)

    def _embeddings(self, batch: ScanPairBatch, source: Tensor | None, target: Tensor | None) -> Embeddings | None:
        if source is None and target is None:
            return None
        kind = self.config.features.embedding
        if kind == "none":
            raise TorchCRFScanError("source_embedding: expected none for a model with features.embedding none, got one")
        if source is None or target is None or source.shape[2] != target.shape[2]:
            got = [None if of is None else tuple(of.shape) for of in (source, target)]
            raise TorchCRFScanError(f"target_embedding: expected both embeddings with the same C, got {got[0]} and {got[1]}")
        weights = self.association_weights["embedding"], self.association_weights["embedding_data"]
        return Embeddings.of(source, target, (batch.source_mask, batch.target_mask), kind, weights)

    def _check(self, batch: ScanPairBatch, start: Start | None = None) -> None:
        """Raises TorchCRFScanError unless batch and start fit each other in shape, and the model in dtype and device."""
        check_batch(batch, self.association_weights["sequence"])
        if start is not None:
            check_start(start, batch)

    def initialise(self, batch: ScanPairBatch) -> Start:
        """InitialiseRT: initial motions of the batch (Algorithm 1, line 1). No gradient."""
        self._check(batch)
        found = initialise(batch, score_of(self.hypothesis_score), self.config.motions)
        begin = BEGINNINGS.get(self.config.start)
        if begin is None:
            return found
        with full_precision(batch.source.device.type):  # centimetres decide which movers are found
            view = replace(self.view(batch), limit=None)  # of the motions to be found from here
            return view.in_metres(begin(view, view.in_unit(found), self.fitted, self.config.inference))

    def forward(
        self,
        batch: ScanPairBatch,
        start: Start | None = None,
        *,
        source_embedding: Tensor | None = None,
        target_embedding: Tensor | None = None,
        extra_log_unary: ExtraLogUnary | None = None,
        outlier_distance: float | Tensor | None = None,
    ) -> Prediction:
        """Labels, motions and log-beliefs of every pair.

        Args:
            batch: B pairs.
            start: initial motions; None: from InitialiseRT. For `ClusteringCRF` its association is the fixed one.
            source_embedding, target_embedding: (B, N, C), (B, M, C) of the points, for a model with `features.embedding`: similar
                ones are associated. InitialiseRT does not use them. None: the term is left out.
            extra_log_unary: (B, N) learned log potentials of outliers and of moving points.
            outlier_distance: metres; a point is an outlier where its nearest target point under its own motion is farther, and
                only there (`features.limit`). None: `InferenceConfig.outlier_distance`, by default as learned. A tensor () may
                have a gradient, computed by the rounds in tensors.

        Raises:
            TorchCRFScanError: an input whose shape, dtype or device does not fit the batch or the model, or that it does not take.
        """
        start = start or self.initialise(batch)  # InitialiseRT
        learned = self.learned_inputs(  # of the encoder and of the caller
            batch, start, source_embedding=source_embedding, target_embedding=target_embedding, extra_log_unary=extra_log_unary
        )
        return self.decode(batch, start, learned, outlier_distance)

    def decode(
        self,
        batch: ScanPairBatch,
        start: Start,
        learned: LearnedInputs | None = None,
        outlier_distance: float | Tensor | None = None,
    ) -> Prediction:
        """The rounds from a start, with the output of `learned_inputs`: `forward` without its first two steps."""
        limit = outlier_distance.item() if isinstance(outlier_distance, Tensor) else outlier_distance
        config = self.config.with_limit(limit)
        if self._suits_loops(config, batch, start, learned, outlier_distance):  # the engine
            return self._in_loops(config, batch, start, learned)  # potentials, messages, motions, repeated until convergence
        return self._in_tensors(batch, start, learned, outlier_distance)  # likewise

    def _suits_loops(
        self,
        config: ModelConfig,
        batch: ScanPairBatch,
        start: Start,
        learned: LearnedInputs | None,
        outlier_distance: float | Tensor | None = None,
    ) -> bool:
        """Whether the loops can compute the rounds: on a CPU, for supported settings and gradients."""
        inputs = {"batch.source": batch.source, "batch.target": batch.target, "batch.initial_motion": batch.initial_motion}
        inputs |= {"start.motions": start.motions} | ({} if start.reach is None else {"start.reach": start.reach})
        inputs |= dict(self.boosters.named_parameters(prefix="boosters"))
        inputs |= {"outlier_distance": outlier_distance} if isinstance(outlier_distance, Tensor) else {}
        slopes = [name for name, tensor in inputs.items() if torch.is_grad_enabled() and tensor.requires_grad]
        has_embeddings = learned is not None and learned.embeddings is not None
        is_transformed = is_in_transform(*self.parameters(), *inputs.values())
        return can_decode(config, batch.source.device, slopes=slopes, has_embeddings=has_embeddings, is_transformed=is_transformed)

    def _in_loops(self, config: ModelConfig, batch: ScanPairBatch, start: Start, learned: LearnedInputs | None) -> Prediction:
        """The rounds in machine code, one pair per thread, there and back."""
        if self._needs_gradient(learned) and config.inference.iterations > 0:
            return adjoint.predict(batch, start, self.fitted, config, learned)
        return predict(batch, start, fitted_of(self.fitted), settings_of(config), learned)

    def _needs_gradient(self, learned: LearnedInputs | None) -> bool:
        extra = () if learned is None else (learned.outlier, learned.moving)
        wanted = (*self.association_weights.values(), *self.clustering_weights.values(), *extra)
        return torch.is_grad_enabled() and any(tensor is not None and tensor.requires_grad for tensor in wanted)

    def _in_tensors(
        self, batch: ScanPairBatch, start: Start, learned: LearnedInputs | None, outlier_distance: float | Tensor | None
    ) -> Prediction:
        """The rounds in tensors, all pairs at once, with a gradient if the schedule supports it; in full precision, as in loops."""
        with full_precision(batch.source.device.type):
            view = self.view(batch, learned, outlier_distance)  # features, in their unit of length
            decode = DECODERS[self.config.inference.schedule]
            found = decode(view, view.in_unit(start), self.fitted, self.config)
            return view.in_metres(found)  # metres

    def unroll(self, batch: ScanPairBatch, start: Start, learned: LearnedInputs | None, config: ModelConfig, last: int) -> Unrolled:
        """The states after the last rounds, with a gradient: what losses on them are computed from.

        Args:
            start: metres. learned: output of `learned_inputs`. config: settings of the rounds, with the schedule `sweep`.
            last: number of rounds, at most `iterations`.
        """
        if config.inference.iterations > 0 and self._suits_loops(config, batch, start, learned):
            return adjoint.unroll(batch, start, self.fitted, config, learned, last)
        with full_precision(batch.source.device.type):
            view = self.view(batch, learned, config.inference.outlier_distance)
            rounds = sweep.rounds(view, view.in_unit(start), self.fitted, config)[-last:]
            distance, looks = self.scales.cluster_distance, config.inference.backend != "eager"
            merged = [replace(done, state=joint.merge_alike(view, done.state, distance, looks=looks)) for done in rounds]
            return Unrolled(view.batch, view.factor, merged)

    def pseudo_log_likelihood(
        self,
        batch: ScanPairBatch,
        plugins: pseudo_likelihood.PlugIns | None = None,
        *,
        start: Start | None = None,
        source_embedding: Tensor | None = None,
        target_embedding: Tensor | None = None,
        extra_log_unary: ExtraLogUnary | None = None,
    ) -> Tensor:
        """(B,) log pseudo-likelihood of the annotation: every label given its true neighbours (spec 6.2). Needs `batch.truth`.

        Args:
            plugins: motions and labels taken as observed in the features, in the unit of `view`; None: the annotated ones.
            start: motions under which the model's encoder aligns the batch, and nothing else; None: from InitialiseRT.
            source_embedding, target_embedding, extra_log_unary: as in `forward`.

        Raises:
            TorchCRFScanError: no annotation, or an input that does not fit as in `forward`.
        """
        if batch.truth is None:
            raise TorchCRFScanError("batch.truth: expected annotated pairs, got a batch without truth")
        if self.encoder is not None:
            start = start or self.initialise(batch)
        learned = self.learned_inputs(
            batch, start, source_embedding=source_embedding, target_embedding=target_embedding, extra_log_unary=extra_log_unary
        )
        if plugins is not None:
            check_plugins(plugins, batch)
        view = self.view(batch, learned)
        plugins = plugins or pseudo_likelihood.true_plugins(view.batch, self.config.inference.clusters - 1)
        if not self.config.has_clusters:
            plugins = pseudo_likelihood.for_background_alone(plugins, view.batch)
        return LIKELIHOODS[self.config.coupling](view, plugins, self.fitted, self.config)

    @torch.no_grad()
    def match(
        self,
        source: Scan,
        target: Scan,
        dt: float = 0.1,
        *,
        initial_motion: Sequence[float] | None = None,
        expected: Expected | None = None,
        outlier_distance: float | None = None,
    ) -> PairPrediction:
        """Association, cluster and motions of one pair, by beam of `source`.

        Args:
            initial_motion: a guess (theta, tx, ty) of the background's motion, e.g. from odometry; used as one more initial
                hypothesis, never taken unchecked.
            expected: what is known of the movers from before; likewise. Used where the loops answer, on a CPU.
            outlier_distance: metres, as in `forward`.
        """
        pair = ScanPair(source, target, dt, initial_motion=None if initial_motion is None else np.asarray(initial_motion))
        return self._match([pair], expected, outlier_distance)[0]

    @torch.no_grad()
    def match_pairs(
        self, pairs: Sequence[ScanPair], batch_size: int = 16, *, outlier_distance: float | None = None
    ) -> list[PairPrediction]:
        """Predictions of many pairs, in batches of `batch_size`. outlier_distance: metres, as in `forward`."""
        parts = batches(pairs, batch_size)
        return [answer for part in parts for answer in self._match(part, outlier_distance=outlier_distance)]

    @torch.no_grad()
    def trace_pairs(self, pairs: Sequence[ScanPair], batch_size: int = 16) -> list[tuple[PairPrediction, SearchTrace]]:
        """Predictions as those of `match_pairs`, each with what became of the search's hypotheses.

        Raises:
            TorchCRFScanError: settings or a device for which the loops do not answer (`inference.backend`).
        """
        found: list[tuple[PairPrediction, SearchTrace]] = []
        for part in batches(pairs, batch_size):
            record: list[SearchTrace] = []
            found += zip(self._match(part, record=record), record, strict=True)
        return found

    def _match(
        self,
        pairs: Sequence[ScanPair],
        expected: Expected | None = None,
        outlier_distance: float | None = None,
        record: list[SearchTrace] | None = None,
    ) -> list[PairPrediction]:
        """Predictions of one batch of pairs: in arrays throughout where the loops compute the rounds, else in padded tensors.

        expected: of a single pair. record: gets the trace of every pair's search.
        """
        reference = self.association_weights["sequence"]
        config = self.config.with_limit(outlier_distance)
        has_embeddings = config.encoder.embedding > 0
        if not (STARTS[config.start].in_loops and can_decode(config, reference.device, has_embeddings=has_embeddings)):
            if record is not None:
                raise TorchCRFScanError("trace: expected a model whose start and rounds the loops compute, on a CPU, got another")
            batch = ScanPairBatch.collate(pairs, reference.dtype).without_truth().to(reference.device)
            prediction = self(batch, outlier_distance=outlier_distance)
            return prediction.of_pairs(pairs)
        scans = [pair_of_scans(pair, reference.dtype) for pair in pairs]
        score, surveys = score_of(self.hypothesis_score), None if record is None else list[Survey | None]()
        starts = start_pairs(scans, score, self.config.motions, expected, surveys)
        extras = extras_of(
            [len(pair.source) for pair in scans], None if self.encoder is None else self.encoder.of_pairs(scans, starts)
        )
        if expected is not None:
            extras = [extras[0].plus_moving(expected.log_moving)]
        answers = decode_pairs(scans, starts, extras, fitted_of(self.fitted), settings_of(config))
        if record is not None and surveys is not None:
            seen = zip(scans, surveys, answers, strict=True)
            record += [trace_of(scan, survey, score, answer.active) for scan, survey, answer in seen]
        return [by_beam(answer, pair) for answer, pair in zip(answers, pairs, strict=True)]

    def save_pretrained(self, folder: str | Path) -> None:
        """Writes `config.json` and `model.safetensors` into a folder, see `pretrained`."""
        write_model(Path(folder), self.config, self.state_dict())

    @classmethod
    def from_pretrained(
        cls, name_or_path: str | Path = PRETRAINED, *, features: dict[str, Any] | None = None, **inference: Any
    ) -> JointScanCRF:
        """Loads a model from a folder written by `save_pretrained`, or a model shipped with the package, by name.

        Args:
            name_or_path: a folder, or a name under `torchcrf_scan/weights`.
            features: `smooth`, `learn_stumps`, `embedding` or `reach` of `FeatureConfig` to change; weights missing in the saved
                model are initialised as in a new one.
            inference: fields of `InferenceConfig` to change, e.g. `candidates=0`, `backend="eager"`.

        Raises:
            TorchCRFScanError: no such model, a damaged one, weights that are not finite, or a value that is out of bounds.
        """
        folder = find_weights(name_or_path)
        model = cls(read_config(folder, features or {}, inference))
        load_state(model, folder, model.optional_state if features else {})
        return model.eval()

    @property
    def optional_state(self) -> dict[str, Tensor]:
        """The part of the model's state that exists only with embeddings or `reach` soft."""
        optional = (*EMBEDDING_WEIGHTS, "reach")
        return {name: value for name, value in self.state_dict().items() if name.rpartition(".")[2] in optional}


class MatchingCRF(JointScanCRF):
    """CRF-Matching: the association chain alone, with one motion for the whole scan (A-25).

    It uses the weights of that chain only: 18 of the paper's features and, by default, five of the extensions.

    Args:
        config: as in `JointScanCRF`, but for `chains` and `coupling`.
    """

    def __init__(self, config: ModelConfig | None = None) -> None:
        super().__init__(replace(config or ModelConfig(), chains="matching", coupling="motions"))


class ClusteringCRF(JointScanCRF):
    """CRF-Clustering: the clustering chain alone, on the fixed associations of the start.

    It uses the weights of that chain only: 12 of the paper's features and, by default, eight of the extensions.

    Args:
        config: as in `JointScanCRF`, but for `chains` and `coupling`.
    """

    def __init__(self, config: ModelConfig | None = None) -> None:
        super().__init__(replace(config or ModelConfig(), chains="clustering", coupling="motions"))


def with_config(model: JointScanCRF, config: ModelConfig) -> JointScanCRF:
    """The same model, with the same weights, under another config."""
    other = copy.copy(model)
    other.config = config
    return other
