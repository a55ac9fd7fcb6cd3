"""Everything that the experiment compares: fitted on the training pairs of one fold, asked about a pair it has not seen."""

from __future__ import annotations

import copy
import json
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import torch
from joblib import Parallel, delayed

from torchcrf_scan.baselines.cascade import Cascade
from torchcrf_scan.baselines.icp import GATES, choose_gate, found_shares, match_background, match_icp
from torchcrf_scan.baselines.kmeans import cluster_displacements
from torchcrf_scan.baselines.libraries import LIBRARIES, installed_libraries
from torchcrf_scan.baselines.ransac import match_ransac
from torchcrf_scan.baselines.start import label_nearest
from torchcrf_scan.batch import ScanPairBatch
from torchcrf_scan.choices import SCHEDULES
from torchcrf_scan.config import EncoderConfig, ModelConfig
from torchcrf_scan.experiment.settings import RunConfig
from torchcrf_scan.inference.pseudo_likelihood import true_plugins
from torchcrf_scan.inference.start import Start, nearest_association
from torchcrf_scan.learning.calibration_fit import calibrate
from torchcrf_scan.learning.cascade_fit import fit_cascade
from torchcrf_scan.learning.checkpoint import Store, load_weights
from torchcrf_scan.learning.fit import Margins, fit
from torchcrf_scan.learning.gradient import train_by_gradient
from torchcrf_scan.learning.material import Collection, Material, collect
from torchcrf_scan.learning.plugins import reach_of_truth
from torchcrf_scan.learning.ranks import ALONE
from torchcrf_scan.learning.selection_fit import fit_potential
from torchcrf_scan.learning.settings import LearningConfig
from torchcrf_scan.model import JointScanCRF
from torchcrf_scan.names import LOCAL_CHANNELS
from torchcrf_scan.scan import Floats, PairPrediction, ScanPair

JOINT, EXACT = "joint", "joint, exact likelihood"
LATTICE, LATTICE_EXACT = "joint, lattice", "joint, lattice, exact likelihood"
ENCODED = "joint, encoder"
HELD_ROUNDS = 10  # of the model whose motions are given
METHODS = (
    *("all background", "ICP", "ICP, tuned", *LIBRARIES, "trimmed ICP + RANSAC"),
    *("K-Means (ICP)", "K-Means (ICP), ego removed", "CRF-Matching"),
    *("K-Means (CRF-Matching)", "K-Means (CRF-Matching), ego removed", "CRF-Clustering", "start + gated NN"),
    *(JOINT, ENCODED, EXACT, LATTICE, LATTICE_EXACT, "joint, true motions", "joint, true associations"),
)  # rows of every table, in this order

_fitted_features: dict[str, tuple[JointScanCRF, Margins]] = {}  # of this process, by `features_key`


@dataclass(frozen=True, slots=True)
class Study:
    """The pairs of an experiment and what is found in them once for all folds.

    Attributes:
        pairs: P annotated pairs. collection: the same, as learning sees them.
        icp_shares: (P, G) outliers that ICP finds with every one of its `GATES`.
    """

    pairs: tuple[ScanPair, ...]
    collection: Collection
    icp_shares: Floats

    @classmethod
    def of(cls, pairs: Sequence[ScanPair], config: RunConfig, jobs: int) -> Study:
        """Looks at the pairs, on `jobs` cores. Raises ValueError for pairs without annotation."""
        collection = collect(pairs, config.learning, jobs)
        if config.experiment.joint_alone:
            return cls(tuple(pairs), collection, np.zeros((len(pairs), len(GATES))))
        shares = Parallel(n_jobs=jobs)(delayed(found_shares)(pair, GATES) for pair in pairs)
        return cls(tuple(pairs), collection, np.stack(shares))


@dataclass(frozen=True, slots=True)
class Models:
    """What was fitted on one fold. The joint models by the name of their row; the cascade and the gate only beside baselines."""

    joint: dict[str, JointScanCRF]
    cascade: Cascade | None = None
    icp_gate: float = np.inf


@dataclass(frozen=True, slots=True)
class Answer:
    """A method's prediction and the seconds that it took, the shared start included."""

    prediction: PairPrediction
    seconds: float


def fit_models(study: Study, train: Sequence[int], config: RunConfig, variants: bool) -> Models:
    """Refits everything on the pairs `train`: the movers' score, scales, boosters, weights, confidences, and ICP's gate.

    Models for ablations are not calibrated: nobody asks how sure they are, and some take minutes a pair.

    variants: of the joint model as well, see `joint_variants`.
    """
    score = study.collection.fit_score(train)
    material = study.collection.material(train, score, config.model.inference.clusters - 1, config.learning)
    joint = JointScanCRF(replace(config.model, encoder=EncoderConfig()))
    joint.hypothesis_score = score
    key = features_key(study, train, config)
    margins = fit(joint, material, config.learning, features_of=_fitted_features.get(key))
    models = {JOINT: joint}
    if config.model.encoder.width > 0:
        models[ENCODED] = fit_encoded(joint, [study.pairs[k] for k in train], material, config)
    if config.experiment.joint_alone:
        _fitted_features.setdefault(key, (joint, margins))
        return Models(models)
    bare = replace(config, model=joint.config)
    for name, variant, learning in joint_variants(bare) if variants else []:
        models[name] = JointScanCRF(variant)
        models[name].hypothesis_score = score
        fit(models[name], material, learning, features_of=(joint, margins))
    for model in models.values():
        calibrate(model, material)
    cascade = fit_cascade(material, config)
    return Models(models, cascade, choose_gate(study.icp_shares[list(train)], GATES))


def fit_encoded(joint: JointScanCRF, pairs: Sequence[ScanPair], material: Sequence[Material], config: RunConfig) -> JointScanCRF:
    """A model with an encoder, trained first order on the pairs and fresh ones, from `config.init` or a fitted joint model on.

    Raises:
        ValueError: the config names no objective for it.
    """
    if config.first_order == "none":
        raise ValueError("gradient.objective: expected one for a model with an encoder, got none")
    model = JointScanCRF(config.model)
    load_weights(model, config.init or joint)
    alone = replace(config, gradient=replace(config.gradient, workers=0))  # a fold's process starts no others; same pairs
    with TemporaryDirectory() as folder:
        train_by_gradient(model, alone, pairs, (), Store(Path(folder), {}), ALONE)
    model.cluster_potential.load_state_dict(fit_potential(model, material).state_dict())
    return model


def features_key(study: Study, train: Sequence[int], config: RunConfig) -> str:
    """Names everything that scales and boosters depend on: most ablations share them."""
    learning, features, inference = (asdict(part) for part in (config.learning, config.model.features, config.model.inference))
    for name in ("objective", "predicted_share", "prior", "max_steps", "tolerance"):
        learning.pop(name)
    features["left_out"] = [name for name in features["left_out"] if name.removeprefix("association.") in LOCAL_CHANNELS]
    features.pop("raw_channels")
    states = [inference[name] for name in ("clusters", "candidates", "candidate_search")]
    return json.dumps([study.collection.names, list(train), learning, features, states])


def joint_variants(config: RunConfig) -> list[tuple[str, ModelConfig, LearningConfig]]:
    """Name, model and learning of the joint model fitted exactly, with both labels in one lattice, and both, where they differ."""
    exactly = replace(config.learning, objective="likelihood", predicted_share=0.5)
    variants = [] if config.learning.objective == "likelihood" else [(EXACT, config.model, exactly)]
    if SCHEDULES[config.model.inference.schedule].takes_couplings:
        lattice = replace(config.model, coupling="lattice")
        learned = {LATTICE: config.learning} if not variants else {LATTICE: config.learning, LATTICE_EXACT: exactly}
        variants += [(name, lattice, learning) for name, learning in learned.items()]
    return variants


@torch.no_grad()
def answer(models: Models, pair: ScanPair) -> dict[str, Answer]:
    """Every method's answer for an annotated pair, timed one by one. The truth is told to the two rows that name it alone."""
    found: dict[str, Answer] = {}

    def ask(name: str, run: Callable[[], PairPrediction], before: float = 0.0) -> Answer:
        began = time.perf_counter()
        prediction = run()
        found[name] = Answer(prediction, before + time.perf_counter() - began)
        return found[name]

    if models.cascade is not None:
        ask("all background", lambda: match_background(pair))
        ask("ICP", lambda: match_icp(pair))
        icp = ask("ICP, tuned", lambda: match_icp(pair, gate=models.icp_gate))
        for name, method in installed_libraries().items():
            ask(name, lambda method=method: method(pair))  # type: ignore[misc]
        ask("trimmed ICP + RANSAC", lambda: match_ransac(pair))
        ask("K-Means (ICP)", lambda: cluster_displacements(pair, icp.prediction), icp.seconds)
        ask("K-Means (ICP), ego removed", lambda: cluster_displacements(pair, icp.prediction, remove_motion=True), icp.seconds)

    annotated = ScanPairBatch.collate([pair])
    batch = annotated.without_truth()
    began = time.perf_counter()
    start = models.joint[JOINT].initialise(batch)
    before = time.perf_counter() - began
    if models.cascade is not None:
        cascade = models.cascade
        matched = ask("CRF-Matching", lambda: cascade.matching(batch, start.background_alone()).pair(0, pair), before)
        ask("K-Means (CRF-Matching)", lambda: cluster_displacements(pair, matched.prediction), matched.seconds)
        ask(
            "K-Means (CRF-Matching), ego removed",
            lambda: cluster_displacements(pair, matched.prediction, remove_motion=True),
            matched.seconds,
        )
        ask("CRF-Clustering", lambda: cascade(batch, start).pair(0, pair), before)
        ask("start + gated NN", lambda: label_nearest(batch, start).pair(0, pair), before)
    for name, model in models.joint.items():
        ask(name, lambda model=model: model(batch, start).pair(0, pair), before)  # type: ignore[misc]
    if models.cascade is not None:
        joint = models.joint[JOINT]
        at_truth = with_motions_given(joint)
        ask("joint, true motions", lambda: at_truth(batch, true_start(annotated, start)).pair(0, pair))
        told = with_config(joint, replace(joint.config, chains="clustering", coupling="motions"))
        associated = replace(start, association=annotated.truth.association)  # type: ignore[union-attr]
        ask("joint, true associations", lambda: told(batch, associated).pair(0, pair), before)
    return found


def with_config(model: JointScanCRF, config: ModelConfig) -> JointScanCRF:
    """The same weights under another config."""
    other = copy.copy(model)
    other.config = config
    return other


def with_motions_given(model: JointScanCRF) -> JointScanCRF:
    """The same model, its motions held where they start; labels that swing have no motions to be damped, so its rounds are few."""
    rounds = min(model.config.inference.iterations, HELD_ROUNDS)
    inference = replace(model.config.inference, motion_metric="given", schedule="sweep", iterations=rounds)
    return with_config(model, replace(model.config, inference=inference))


def true_start(batch: ScanPairBatch, found: Start) -> Start:
    """The annotated motions of as many movers as there is room for, `batch` being annotated."""
    truth = true_plugins(batch, found.motions.shape[1])
    reach = reach_of_truth(truth, batch)
    association = nearest_association(batch, truth.motions, truth.active, reach)
    return Start(truth.motions, truth.active, association, found.target_tangents, reach)
