"""Learning a model from annotated pairs, stage by stage: start, scales, boosters, association weights, clustering weights.

Everything that is fitted is fitted on the given pairs alone, so a fold of a cross-validation is one call.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor
from tqdm import tqdm

from torchcrf_scan.batch import ScanPairBatch
from torchcrf_scan.config import LearningConfig
from torchcrf_scan.features.potentials import Boosters, PairView
from torchcrf_scan.features.scales import ASSOCIATION_WEIGHTS, CLUSTERING_WEIGHTS, LOCAL_CHANNELS
from torchcrf_scan.inference import joint, pseudo_likelihood
from torchcrf_scan.inference.initialise import Start
from torchcrf_scan.inference.motion import Motions
from torchcrf_scan.inference.pseudo_likelihood import Chain, PlugIns
from torchcrf_scan.learning.boosting_fit import fit_boosters
from torchcrf_scan.learning.disturb import disturb
from torchcrf_scan.learning.plugins import mix_associations, training_plugins
from torchcrf_scan.learning.scales_fit import fit_scales
from torchcrf_scan.learning.weights_fit import Watch, fit_chain
from torchcrf_scan.model import JointScanCRF
from torchcrf_scan.scan import ScanPair


@dataclass(frozen=True, slots=True)
class Material:
    """A batch of annotated pairs with its start; `fold` is its part of the out-of-fold margins."""

    batch: ScanPairBatch
    start: Start
    fold: int


@dataclass(frozen=True, slots=True)
class Lesson:
    """Material as one model sees it, with all that is taken as observed."""

    view: PairView
    start: Start
    plugins: PlugIns
    fold: int


def gather_material(model: JointScanCRF, pairs: Sequence[ScanPair], config: LearningConfig) -> list[Material]:
    """Batches of one fold each, with the start that `model` finds; several models may learn from them.

    Raises:
        ValueError: a pair without annotation, or no pair.
    """
    bare = [pair.name for pair in pairs if pair.annotation is None]
    if bare or not pairs:
        raise ValueError(f"pairs: expected annotated pairs, got {bare[:3] or 'none'}")
    folds = assign_folds(pairs, config.folds)
    parts = {fold: [pair for pair, of in zip(pairs, folds, strict=True) if of == fold] for fold in sorted(set(folds))}
    step = config.batch_size
    batches = [(fold, part[k : k + step]) for fold, part in parts.items() for k in range(0, len(part), step)]
    material = []
    generator = torch.Generator().manual_seed(config.seed)
    for fold, part in tqdm(batches, desc="InitialiseRT", unit="batch", leave=False):
        batch = ScanPairBatch.collate(part)
        if config.disturbance > 0:
            batch = disturb(batch, config.disturbance, generator)
        material.append(Material(batch, model.initialise(batch), fold))
    return material


def fit(model: JointScanCRF, material: Sequence[Material], config: LearningConfig, watch: dict[str, Watch] | None = None) -> None:
    """Fits scales, boosters and weights of `model`, in place.

    Args:
        watch: callbacks of the two weight fits, by chain: `association`, `clustering`.
    """
    watch = watch or {}
    generator = torch.Generator().manual_seed(config.seed)
    chains = model.config.chains
    lessons = [prepare(model, part, config, generator) for part in material]
    views, plugins = [lesson.view for lesson in lessons], [lesson.plugins for lesson in lessons]
    model.scales.load_state_dict(fit_scales(views, plugins).state_dict())
    predicted = [lesson.start.association for lesson in lessons]
    if chains != "clustering":
        margins = fit_all_boosters(model, lessons, config, generator)
        features = [association_chain(model, lesson, margins[lesson.fold]) for lesson in lessons]
        set_weights(model, "association", fit_chain(features, live_weights(model), config, watch.get("association")))
        predicted = [predict_association(model, lesson, margins[lesson.fold]) for lesson in lessons]
    if chains != "matching":
        features = [clustering_chain(model, lesson, p, config, generator) for lesson, p in zip(lessons, predicted, strict=True)]
        live = torch.ones(len(CLUSTERING_WEIGHTS), dtype=torch.float64)
        set_weights(model, "clustering", fit_chain(features, live, config, watch.get("clustering")))


def prepare(model: JointScanCRF, part: Material, config: LearningConfig, generator: torch.Generator) -> Lesson:
    """The training plug-ins of one batch; for CRF-Matching every point moves with the background."""
    view = model.view(part.batch)
    start = part.start.scaled(view.factor)
    plugins = training_plugins(view.batch, start, config, generator)
    if model.config.chains == "matching":
        plugins, start = pseudo_likelihood.for_background_alone(plugins), start.background_alone()
    return Lesson(view, start, plugins, part.fold)


def assign_folds(pairs: Sequence[ScanPair], folds: int) -> list[int]:
    """A fold for every pair; sequences stay whole and are dealt out in turn by size. One fold where there is nothing to deal."""
    sizes: dict[str, int] = {}
    for pair in pairs:
        sizes[pair.sequence] = sizes.get(pair.sequence, 0) + 1
    load = [0] * max(1, min(folds, len(sizes)))
    fold_of = {}
    for sequence in sorted(sizes, key=lambda name: (-sizes[name], name)):
        fold_of[sequence] = load.index(min(load))
        load[fold_of[sequence]] += sizes[sequence]
    return [fold_of[pair.sequence] for pair in pairs]


def fit_all_boosters(
    model: JointScanCRF, lessons: Sequence[Lesson], config: LearningConfig, generator: torch.Generator
) -> dict[int, Boosters]:
    """Fits the model's boosters on all pairs; returns by fold those of the other folds (margins of unseen pairs, spec 2.5)."""

    def fit_on(part: Sequence[Lesson]) -> Boosters:
        return fit_boosters(
            [lesson.view for lesson in part],
            [lesson.plugins for lesson in part],
            model.scales,
            stumps=model.config.features.stumps,
            negatives=config.negatives,
            candidates=model.config.inference.candidates,
            generator=generator,
        )

    numbers = sorted({lesson.fold for lesson in lessons})
    jobs = {number: [lesson for lesson in lessons if lesson.fold != number] for number in numbers}
    everything = fit_on(lessons)
    model.boosters.load_state_dict(everything.state_dict())
    if len(numbers) == 1:
        return {numbers[0]: everything}
    return {number: fit_on(part) for number, part in tqdm(jobs.items(), desc="boosters", unit="fold", leave=False)}


def association_chain(model: JointScanCRF, lesson: Lesson, margins: Boosters) -> Chain:
    """The lesson's association features with margins of boosters that have not seen it."""
    count = model.config.inference.candidates
    return pseudo_likelihood.association_chain(lesson.view, lesson.plugins, model.scales, margins, count)


def predict_association(model: JointScanCRF, lesson: Lesson, margins: Boosters) -> Tensor:
    """(B, N) labels of one exact pass over the association chain at the training motions."""
    parameters = replace(model.fitted, boosters=margins)
    plugins, config = lesson.plugins, model.config.inference
    with torch.no_grad():
        start = replace(lesson.start, motions=plugins.motions, active=plugins.active, reach=None)
        state = joint.first_state(lesson.view, start, parameters, config)
        one_hot = torch.nn.functional.one_hot(plugins.cluster.clamp(min=0), plugins.motions.shape[1] + 1).to(plugins.motions)
        state = replace(state, motions=Motions.start(plugins.motions, plugins.active), log_cluster=one_hot)
        found = joint.find_candidates(lesson.view, plugins.motions, plugins.active, config)
        return joint.update_association(lesson.view, state, found, parameters, config).association


def clustering_chain(
    model: JointScanCRF, lesson: Lesson, predicted: Tensor, config: LearningConfig, generator: torch.Generator
) -> Chain:
    """The lesson's clustering features, with predicted associations for some pairs; for all where the chain stands alone (A-28)."""
    share = config.predicted_share if model.config.chains == "joint" else 1.0
    plugins = mix_associations(lesson.plugins, predicted, share, generator)
    return pseudo_likelihood.clustering_chain(lesson.view, plugins, model.scales)


def live_weights(model: JointScanCRF) -> Tensor:
    """(18,) 1 for the association weights that are learned; 0 for the raw channels in W-B."""
    live = torch.ones(len(ASSOCIATION_WEIGHTS), dtype=torch.float64)
    if not model.config.features.raw_channels:
        live[: len(LOCAL_CHANNELS)] = 0
    return live


@torch.no_grad()
def set_weights(model: JointScanCRF, chain: str, values: Tensor) -> None:
    """Writes (18,) or (12,) weights into the named parameters."""
    names, weights = {
        "association": (ASSOCIATION_WEIGHTS, model.association_weights),
        "clustering": (CLUSTERING_WEIGHTS, model.clustering_weights),
    }[chain]
    for name, value in zip(names, values, strict=True):
        weights[name].copy_(value)
