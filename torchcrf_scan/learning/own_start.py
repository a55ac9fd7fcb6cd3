"""Training starts of models with a start of their own (`ModelConfig.start`), which needs fitted association weights."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import torch

from torchcrf_scan.features.potentials import Boosters
from torchcrf_scan.learning.fit import fit_association, fit_features, prepare
from torchcrf_scan.learning.material import Material
from torchcrf_scan.learning.settings import LearningConfig
from torchcrf_scan.model import JointScanCRF
from torchcrf_scan.variants.register import BEGINNINGS


def own_starts(model: JointScanCRF, material: Sequence[Material], config: LearningConfig) -> list[Material]:
    """The material with the start that the model would find itself, by an association chain fitted on the same material.

    That chain is fitted at the true motions with noise, and every batch is started by boosters fitted without its fold: no
    motion of the search reaches the fit. The material itself for a model that starts by the search.
    """
    if model.config.start not in BEGINNINGS or not model.config.has_association:
        return list(material)
    first, generator = JointScanCRF(model.config), torch.Generator().manual_seed(config.seed)
    known, at_truth = [replace(part, start=part.start.background_alone()) for part in material], replace(config, start_share=0.0)
    lessons = [prepare(first, part, at_truth, generator) for part in known]
    margins = fit_features(first, lessons, at_truth, generator, None)
    fit_association(first, lessons, margins, at_truth, None)
    return start_anew(first, material, margins)


def start_anew(model: JointScanCRF, material: Sequence[Material], margins: Mapping[int, Boosters]) -> list[Material]:
    """The material with the start of a fitted model. margins: by fold, boosters to use instead of the model's."""
    begin = BEGINNINGS.get(model.config.start)
    if begin is None:
        return list(material)
    parts = []
    for part in material:
        view = model.view(part.batch)
        parameters = replace(model.fitted, boosters=margins.get(part.fold, model.boosters))
        start = begin(view, view.in_unit(part.start), parameters, model.config.inference)
        parts.append(replace(part, start=view.in_metres(start)))
    return parts
