"""Staged fit of a model to annotated pairs: scales, boosters, association weights, clustering weights, potential of movers.

Everything is fitted on the given pairs only, so a fold of a cross-validation is one call.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor
from tqdm import tqdm

from torchcrf_scan.features.potentials import Boosters, PairView
from torchcrf_scan.features.scales import live_weights
from torchcrf_scan.inference import joint, pseudo_likelihood
from torchcrf_scan.inference.pseudo_likelihood import Chain, PlugIns
from torchcrf_scan.inference.start import Start
from torchcrf_scan.learning.boosting_fit import fit_boosters
from torchcrf_scan.learning.losses import LOSSES
from torchcrf_scan.learning.material import Material
from torchcrf_scan.learning.plugins import mix_associations, training_plugins
from torchcrf_scan.learning.scales_fit import fit_scales
from torchcrf_scan.learning.selection_fit import fit_potential
from torchcrf_scan.learning.settings import LearningConfig
from torchcrf_scan.learning.weights_fit import Watch, fit_chain
from torchcrf_scan.model import JointScanCRF
from torchcrf_scan.names import ASSOCIATION_WEIGHTS, CLUSTERING_WEIGHTS, LOCAL_CHANNELS
from torchcrf_scan.variants.register import ONE_CHAINS, OneChain

Margins = dict[int, Boosters]  # by fold, boosters fitted without it


@dataclass(frozen=True, slots=True)
class Lesson:
    """Training material with its plug-ins, prepared for one model. counts: (B,) how much every pair counts."""

    view: PairView
    start: Start
    plugins: PlugIns
    fold: int
    counts: Tensor


def fit(
    model: JointScanCRF,
    material: Sequence[Material],
    config: LearningConfig,
    watch: dict[str, Watch] | None = None,
    *,
    features_of: tuple[JointScanCRF, Margins] | None = None,
) -> Margins:
    """Fits scales, boosters and weights of `model`, in place.

    Args:
        watch: callbacks of the weight fits, by chain: `association`, `clustering`; or of the single fit, by coupling: `lattice`.
        features_of: a model with both chains that was fitted on the same material, and the return value of its fit: scales and
            boosters are then taken from there.

    Returns:
        By fold, boosters fitted without it; empty for the clustering chain alone.
    """
    watch = watch or {}
    generator = torch.Generator().manual_seed(config.seed)
    has_association, has_clusters = model.config.has_association, model.config.has_clusters
    lessons = [prepare(model, part, config, generator) for part in material]
    margins = fit_features(model, lessons, config, generator, features_of)
    if one_chain := ONE_CHAINS.get(model.config.coupling):
        fit_one_chain(model, one_chain, lessons, margins, config, watch.get(model.config.coupling))
        return margins
    predicted = [lesson.start.association for lesson in lessons]
    if has_association:
        fit_association(model, lessons, margins, config, watch.get("association"))
        predicted = [predict_association(model, lesson, margins[lesson.fold]) for lesson in lessons]
    if has_clusters:
        fit_clustering(model, lessons, predicted, config, generator, watch.get("clustering"))
    if has_association and has_clusters:
        model.cluster_potential.load_state_dict(fit_potential(model, material).state_dict())
    return margins


def refit(model: JointScanCRF, material: Sequence[Material], config: LearningConfig) -> None:
    """Fits the weights of a model with both chains anew, in place, around its own: they are the mean of the prior.

    Scales, boosters, encoder and the worth of movers stay.
    """
    generator = torch.Generator().manual_seed(config.seed)
    association, clustering = (of.detach().double() for of in model.weight_vectors)
    lessons = [prepare(model, part, config, generator) for part in material]
    margins = {lesson.fold: model.boosters for lesson in lessons}
    fit_association(model, lessons, margins, config, None, association)
    predicted = [predict_association(model, lesson, model.boosters) for lesson in lessons]
    fit_clustering(model, lessons, predicted, config, generator, None, clustering)


def fit_features(
    model: JointScanCRF,
    lessons: Sequence[Lesson],
    config: LearningConfig,
    generator: torch.Generator,
    features_of: tuple[JointScanCRF, Margins] | None,
) -> Margins:
    """Scales and boosters, fitted or taken from `features_of`."""
    if features_of is not None:
        other, margins = features_of
        model.scales.load_state_dict(other.scales.state_dict())
        model.boosters.load_state_dict(other.boosters.state_dict())
        return margins
    fitted = fit_scales([lesson.view for lesson in lessons], [lesson.plugins for lesson in lessons])
    model.scales.load_state_dict(fitted.state_dict())
    return fit_all_boosters(model, lessons, config, generator) if model.config.has_association else {}


def fit_association(
    model: JointScanCRF,
    lessons: Sequence[Lesson],
    margins: Margins,
    config: LearningConfig,
    watch: Watch | None,
    around: Tensor | None = None,
) -> None:
    """Fits the weights of the association chain, with out-of-fold margins. around: as in `fit_chain`."""
    make = pseudo_likelihood.association_chain if LOSSES[config.objective].is_exact else pseudo_likelihood.association_design
    features = (make(of.view, of.plugins, model.scales, margins[of.fold], model.config.inference) for of in lessons)
    live, counts = live_weights(model.config.features)[0], [lesson.counts for lesson in lessons]
    set_weights(model, "association", fit_chain(features, live, config, watch, around, counts))


def fit_clustering(
    model: JointScanCRF,
    lessons: Sequence[Lesson],
    predicted: Sequence[Tensor],
    config: LearningConfig,
    generator: torch.Generator,
    watch: Watch | None,
    around: Tensor | None = None,
) -> None:
    """Fits the weights of the clustering chain. predicted: (B, N) associations of every lesson. around: as in `fit_chain`."""
    features = (clustering_chain(model, of, own, config, generator) for of, own in zip(lessons, predicted, strict=True))
    live, counts = live_weights(model.config.features)[1], [lesson.counts for lesson in lessons]
    set_weights(model, "clustering", fit_chain(features, live, config, watch, around, counts))


def fit_one_chain(
    model: JointScanCRF,
    one_chain: OneChain,
    lessons: Sequence[Lesson],
    margins: Margins,
    config: LearningConfig,
    watch: Watch | None,
) -> None:
    """Fits all weights jointly, for a coupling that decides both labels together; no association plug-ins (`predicted_share`)."""
    inference = model.config.inference
    features = (one_chain(of.view, of.plugins, model.scales, margins[of.fold], inference) for of in lessons)
    live = torch.cat(live_weights(model.config.features))
    weights = fit_chain(features, live, config, watch, counts=[lesson.counts for lesson in lessons])
    association, clustering = weights.split([len(ASSOCIATION_WEIGHTS), len(CLUSTERING_WEIGHTS)])
    set_weights(model, "association", association)
    set_weights(model, "clustering", clustering)


def prepare(model: JointScanCRF, part: Material, config: LearningConfig, generator: torch.Generator) -> Lesson:
    """The training plug-ins of one batch; for CRF-Matching every point moves with the background."""
    with torch.no_grad():
        view = model.view(part.batch, model.learned_inputs(part.batch, part.start))
    start = view.in_unit(part.start)
    plugins = training_plugins(view.batch, start, config, generator)
    if not model.config.has_clusters:
        plugins, start = pseudo_likelihood.for_background_alone(plugins, view.batch), start.background_alone()
    return Lesson(view, start, plugins, part.fold, part.counts)


def fit_all_boosters(model: JointScanCRF, lessons: Sequence[Lesson], config: LearningConfig, generator: torch.Generator) -> Margins:
    """Fits the model's boosters on all pairs; returns by fold those fitted on the other folds (out-of-fold margins, spec 2.5)."""

    def fit_on(part: Sequence[Lesson]) -> Boosters:
        return fit_boosters(
            [lesson.view for lesson in part],
            [lesson.plugins for lesson in part],
            model.scales,
            stumps=model.config.features.stumps,
            negatives=config.negatives,
            inference=model.config.inference,
            most=config.booster_examples,
            hidden=[k for k, name in enumerate(LOCAL_CHANNELS) if f"association.{name}" in model.config.features.left_out],
            generator=generator,
        )

    numbers = sorted({lesson.fold for lesson in lessons})
    jobs = {number: [lesson for lesson in lessons if lesson.fold != number] for number in numbers}
    everything = fit_on(lessons)
    model.boosters.load_state_dict(everything.state_dict())
    if len(numbers) == 1:
        return {numbers[0]: everything}
    return {number: fit_on(part) for number, part in tqdm(jobs.items(), desc="boosters", unit="fold", leave=False)}


@torch.no_grad()
def predict_association(model: JointScanCRF, lesson: Lesson, margins: Boosters) -> Tensor:
    """(B, N) labels of one exact pass over the association chain at the training motions."""
    parameters, plugins = replace(model.fitted, boosters=margins), lesson.plugins
    start = replace(lesson.start, motions=plugins.motions, active=plugins.active, reach=None)
    return joint.associate(lesson.view, start, plugins.cluster, parameters, model.config.inference)


def clustering_chain(
    model: JointScanCRF, lesson: Lesson, predicted: Tensor, config: LearningConfig, generator: torch.Generator
) -> Chain:
    """The lesson's clustering features, with predicted associations for some pairs; for all without the other chain (A-28)."""
    share = config.predicted_share if model.config.has_association else 1.0
    plugins = mix_associations(lesson.plugins, predicted, share, generator)
    return pseudo_likelihood.clustering_chain(lesson.view, plugins, model.scales)


@torch.no_grad()
def set_weights(model: JointScanCRF, chain: str, values: Tensor) -> None:
    """Writes (23,) or (21,) weights into the named parameters; those of left-out features are skipped."""
    names, weights = {
        "association": (ASSOCIATION_WEIGHTS, model.association_weights),
        "clustering": (CLUSTERING_WEIGHTS, model.clustering_weights),
    }[chain]
    for name, value in zip(names, values, strict=True):
        if name in weights:
            weights[name].copy_(value)
