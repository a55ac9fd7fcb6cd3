"""The models of one fold, fitted on its training pairs."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from torchcrf_scan.baselines.cascade import Cascade
from torchcrf_scan.baselines.icp import GATES, choose_gate
from torchcrf_scan.choices import SCHEDULES
from torchcrf_scan.config import EncoderConfig, ModelConfig
from torchcrf_scan.errors import TorchCRFScanError
from torchcrf_scan.experiment.settings import RunConfig
from torchcrf_scan.experiment.study import Study
from torchcrf_scan.learning.calibration_fit import calibrate
from torchcrf_scan.learning.cascade_fit import fit_cascade
from torchcrf_scan.learning.checkpoint import Store, load_weights
from torchcrf_scan.learning.fit import fit
from torchcrf_scan.learning.gradient import train_by_gradient
from torchcrf_scan.learning.losses import LOSSES
from torchcrf_scan.learning.material import Material
from torchcrf_scan.learning.own_start import own_starts
from torchcrf_scan.learning.ranks import ALONE
from torchcrf_scan.learning.selection_fit import fit_potential
from torchcrf_scan.learning.settings import LearningConfig
from torchcrf_scan.model import JointScanCRF
from torchcrf_scan.names import LOCAL_CHANNELS
from torchcrf_scan.scan import ScanPair

JOINT, EXACT = "joint", "joint, exact likelihood"
LATTICE, LATTICE_EXACT = "joint, lattice", "joint, lattice, exact likelihood"
ENCODED = "joint, encoder"


@dataclass(frozen=True, slots=True)
class Models:
    """The models of one fold: joint models by the name of their row; the cascade and the gate only if baselines are compared."""

    joint: dict[str, JointScanCRF]
    cascade: Cascade | None = None
    icp_gate: float = np.inf


def fit_models(study: Study, train: Sequence[int], config: RunConfig, variants: bool) -> Models:
    """Fits everything on the pairs `train`: the movers' score, scales, boosters, weights, calibration, and ICP's gate.

    Models for ablations are not calibrated: their confidences are not evaluated, and some take minutes a pair.

    Args:
        variants: fit the variants of the joint model too, see `joint_variants`.
    """
    score = study.collection.fit_score(train)
    material = study.collection.material(train, score, config.model.inference.clusters - 1, config.learning)
    joint = JointScanCRF(replace(config.model, encoder=EncoderConfig()))
    joint.hypothesis_score = score
    key = features_key(study, train, config)
    material = own_starts(joint, material, config.learning)
    margins = fit(joint, material, config.learning, features_of=study.features_of(key))
    models = {JOINT: joint}
    if config.model.encoder.width > 0:
        models[ENCODED] = fit_encoded(joint, [study.pairs[k] for k in train], material, config)
    if config.experiment.joint_alone:
        study.keep(key, (joint, margins))
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
    """A model with an encoder, trained by first-order steps on the pairs and fresh ones, from `config.init` or the joint model.

    Raises:
        TorchCRFScanError: the config has no first-order objective.
    """
    if not config.has_steps:
        raise TorchCRFScanError("gradient.objective: expected one for a model with an encoder, got none")
    model = JointScanCRF(config.model)
    load_weights(model, config.init or joint)
    alone = replace(config, gradient=replace(config.gradient, workers=0))  # no workers in a fold's process; same pairs
    with TemporaryDirectory() as folder:
        train_by_gradient(model, alone, pairs, (), Store(Path(folder), {}), ALONE)
    model.cluster_potential.load_state_dict(fit_potential(model, material).state_dict())
    return model


def joint_variants(config: RunConfig) -> list[tuple[str, ModelConfig, LearningConfig]]:
    """Name, model and learning of the variants fitted exactly, with both labels in one lattice, and both, where they differ."""
    exactly = replace(config.learning, objective="likelihood", predicted_share=0.5)
    variants = [] if LOSSES[config.learning.objective].is_exact else [(EXACT, config.model, exactly)]
    if SCHEDULES[config.model.inference.schedule].takes_couplings:
        lattice = replace(config.model, coupling="lattice")
        learned = {LATTICE: config.learning} if not variants else {LATTICE: config.learning, LATTICE_EXACT: exactly}
        variants += [(name, lattice, learning) for name, learning in learned.items()]
    return variants


def features_key(study: Study, train: Sequence[int], config: RunConfig) -> str:
    """A key of all inputs of scales and boosters: most ablations share them."""
    learning, features, inference = (asdict(part) for part in (config.learning, config.model.features, config.model.inference))
    for name in ("objective", "predicted_share", "prior", "max_steps", "tolerance"):
        learning.pop(name)
    features["left_out"] = [name for name in features["left_out"] if name.removeprefix("association.") in LOCAL_CHANNELS]
    features.pop("raw_channels")
    features.pop("reach")
    states = [inference[name] for name in ("clusters", "candidates", "candidate_search")]
    return json.dumps([study.collection.names, list(train), config.model.start, learning, features, states])
