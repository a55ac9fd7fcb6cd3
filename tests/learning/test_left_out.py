"""Nothing fitted for a fold depends on the pairs that it leaves out, nor an out-of-fold booster on its own fold."""

from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

from torchcrf_scan.baselines.icp import GATES, choose_gate
from torchcrf_scan.config import InferenceConfig
from torchcrf_scan.experiment import models as of_experiment
from torchcrf_scan.experiment.cross_validation import make_folds
from torchcrf_scan.experiment.models import Models, fit_models
from torchcrf_scan.experiment.settings import RunConfig
from torchcrf_scan.experiment.study import Study
from torchcrf_scan.features.potentials import Boosters, PairView
from torchcrf_scan.features.scales import Scales
from torchcrf_scan.inference import joint
from torchcrf_scan.inference.pseudo_likelihood import Chain, PlugIns, association_design
from torchcrf_scan.inference.state import Parameters
from torchcrf_scan.learning import cascade_fit
from torchcrf_scan.learning import fit as of_fit
from torchcrf_scan.learning.cascade_fit import fit_cascade
from torchcrf_scan.learning.fit import Margins, fit
from torchcrf_scan.learning.material import Material, collect
from torchcrf_scan.model import JointScanCRF
from torchcrf_scan.names import ASSOCIATION_NODE
from torchcrf_scan.scan import ScanPair
from torchcrf_scan.variants.lattice_likelihood import LatticeChain

PROTOCOLS = ("leave_one_pair_out", "leave_one_sequence_out")


def corrupted(pair: ScanPair) -> ScanPair:
    """Nonsense of the same size: points in reverse, bodies renamed, motions a metre off, most ignored, the target half as far."""
    truth = pair.annotation
    assert truth is not None
    association = truth.association[::-1].copy()
    cluster = np.where(association < 0, -1, (np.arange(len(association)) // 20) % len(truth.motions))
    ignore = np.arange(len(association)) % 3 > 0
    other = replace(
        truth, association=association, cluster=cluster, motions=truth.motions + 1.0, body=np.maximum(cluster, 0), ignore=ignore
    )
    return replace(pair, target=replace(pair.target, ranges=pair.target.ranges / 2), annotation=other)


def with_corrupted(pairs: Sequence[ScanPair], index: Iterable[int]) -> list[ScanPair]:
    chosen = set(index)
    return [corrupted(pair) if k in chosen else pair for k, pair in enumerate(pairs)]


def everything(models: Models, margins: Sequence[Margins]) -> dict[str, Tensor]:
    """All that was fitted: weights, boosters, scales, scores, potentials, calibrations, ICP's gate, out-of-fold boosters."""
    assert models.cascade is not None
    fitted = {**models.joint, "matching": models.cascade.matching, "clustering": models.cascade.clustering}
    states = {f"{name}.{key}": value for name, model in fitted.items() for key, value in model.state_dict().items()}
    for number, by_fold in enumerate(margins):
        for fold, boosters in by_fold.items():
            states |= {f"margins {number}, fold {fold}.{key}": value for key, value in boosters.state_dict().items()}
    return states | {"ICP's gate": torch.tensor(models.icp_gate)}


def fit_fold(
    study: Study, train: Sequence[int], config: RunConfig, monkeypatch: pytest.MonkeyPatch
) -> tuple[dict[str, Tensor], list[Margins]]:
    margins: list[Margins] = []

    def watched(*given: object, **named: object) -> Margins:
        margins.append(fit(*given, **named))  # type: ignore[arg-type]
        return margins[-1]

    with monkeypatch.context() as patch:
        patch.setattr(of_experiment, "fit", watched)
        return everything(fit_models(study, train, config, variants=False), margins), margins


@pytest.mark.parametrize("protocol", PROTOCOLS)
def test_no_fold_has_seen_what_it_leaves_out(
    protocol: str, study: Study, small_pairs: list[ScanPair], small_config: RunConfig, monkeypatch: pytest.MonkeyPatch
) -> None:
    gates = []
    first, *_, last = make_folds(protocol, small_pairs, len(small_pairs))  # the folds between are fitted by the same lines
    for fold in (first, last):
        lied_to = Study.of(with_corrupted(small_pairs, fold.test), small_config, jobs=1)
        clean, margins = fit_fold(study, fold.train, small_config, monkeypatch)
        other, _ = fit_fold(lied_to, fold.train, small_config, monkeypatch)
        assert margins[0]
        assert clean.keys() == other.keys()
        assert [name for name, value in clean.items() if not torch.equal(value, other[name])] == []
        gates.append(choose_gate(study.icp_shares, GATES) != choose_gate(lied_to.icp_shares, GATES))
    assert any(gates)  # so that a gate of all pairs would be noticed


def test_what_a_fold_is_trained_on_changes_everything(
    study: Study, small_pairs: list[ScanPair], small_config: RunConfig, monkeypatch: pytest.MonkeyPatch
) -> None:
    train = range(4)
    lied_to = Study.of(with_corrupted(small_pairs, train), small_config, jobs=1)
    clean, _ = fit_fold(study, train, small_config, monkeypatch)
    other, _ = fit_fold(lied_to, train, small_config, monkeypatch)
    changed = {name for name, value in clean.items() if not torch.equal(value, other[name])}
    expected = (
        *("hypothesis_score", "boosters.data.table", "boosters.outlier.table", "scales", "association_weights"),
        *("clustering_weights", "calibration"),
    )
    for part in expected:
        assert any(name.startswith(f"joint.{part}") for name in changed), part
    assert "ICP's gate" in changed
    assert any(name.startswith("margins 0, fold 0") for name in changed)


# --- out-of-fold margins ------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def material(study: Study, small_config: RunConfig) -> list[Material]:
    score = study.collection.fit_score(range(6))
    return study.collection.material(range(6), score, 4, small_config.learning)


def test_the_boosters_of_a_fold_have_not_seen_its_pairs(
    material: list[Material], small_pairs: list[ScanPair], small_config: RunConfig
) -> None:
    names = [pair.name for pair in small_pairs]
    learning = replace(small_config.learning, booster_examples=0)  # no draws that depend on how many there are
    model = JointScanCRF(small_config.model)
    clean = of_fit.fit_all_boosters(model, lessons_of(model, material, small_config), learning, generator())
    folds = sorted({part.fold for part in material})
    assert len(folds) == 2
    for fold in folds:
        own = [names.index(pair.name) for part in material if part.fold == fold for pair in part.pairs]
        collection = collect(with_corrupted(small_pairs, own), learning)
        lied_to = []
        for part in material:
            rows = torch.tensor([names.index(pair.name) for pair in part.pairs])
            lied_to.append(replace(part, batch=collection.batch.select(rows)))
        other_model = JointScanCRF(small_config.model)
        lessons = lessons_of(other_model, lied_to, small_config)
        other = of_fit.fit_all_boosters(other_model, lessons, learning, generator())
        assert same(clean[fold], other[fold]), fold
        assert not same(clean[1 - fold], other[1 - fold])
        assert not same(model.boosters, other_model.boosters)


def generator() -> torch.Generator:
    return torch.Generator().manual_seed(0)


def lessons_of(model: JointScanCRF, material: Sequence[Material], config: RunConfig) -> list[of_fit.Lesson]:
    draws = generator()
    return [of_fit.prepare(model, part, config.learning, draws) for part in material]


def same(one: torch.nn.Module, other: torch.nn.Module) -> bool:
    return all(torch.equal(a, b) for a, b in zip(one.state_dict().values(), other.state_dict().values(), strict=True))


def test_margins_are_those_of_the_folds_own_boosters(
    material: list[Material], small_config: RunConfig, monkeypatch: pytest.MonkeyPatch
) -> None:
    """In the features of the association chain, in the predictions that are plugged into the clustering chain."""
    model, learned, used = JointScanCRF(small_config.model), [], []
    real_chain, real_associate = of_fit.fit_chain, joint.associate

    def fit_chain(features: Iterable[Chain], *rest: object) -> Tensor:
        learned.append(list(features))
        return real_chain(learned[-1], *rest)  # type: ignore[arg-type]

    def associate(view: object, start: object, cluster: object, parameters: Parameters, inference: object) -> Tensor:
        used.append(parameters.boosters)
        return real_associate(view, start, cluster, parameters, inference)  # type: ignore[arg-type]

    monkeypatch.setattr(of_fit, "fit_chain", fit_chain)
    monkeypatch.setattr(joint, "associate", associate)
    learning = replace(small_config.learning, rotation_noise=0.0, translation_noise=0.0, start_share=0.0)
    margins = fit(model, material, learning)
    assert [boosters is margins[part.fold] for boosters, part in zip(used, material, strict=True)] == [True] * len(material)
    column = ASSOCIATION_NODE.index("data_boosting")
    lessons = lessons_of(model, material, replace(small_config, learning=learning))
    for chain, lesson in zip(learned[0], lessons, strict=True):
        expected, seen = (
            association_design(lesson.view, lesson.plugins, model.scales, boosters, model.config.inference)
            for boosters in (margins[lesson.fold], model.boosters)
        )
        found = chain.design().features[..., column]
        assert torch.equal(found, expected.features[..., column])
        assert not torch.equal(found, seen.features[..., column])


def test_crf_clustering_is_fed_by_boosters_without_the_fold(
    material: list[Material], small_config: RunConfig, monkeypatch: pytest.MonkeyPatch
) -> None:
    kept: list[tuple[JointScanCRF, Margins]] = []
    fed: list[JointScanCRF] = []

    def watched(model: JointScanCRF, *rest: object) -> Margins:
        kept.append((model, fit(model, *rest)))  # type: ignore[arg-type]
        return kept[-1][1]

    real = cascade_fit.Cascade.feed
    monkeypatch.setattr(cascade_fit, "fit", watched)
    monkeypatch.setattr(cascade_fit.Cascade, "feed", lambda self, *given: fed.append(self.matching) or real(self, *given))
    fit_cascade(material, small_config)
    assert [model.boosters is kept[0][1][part.fold] for model, part in zip(fed, material, strict=True)] == [True] * len(material)


def test_a_lattice_learns_from_boosters_without_the_fold(
    material: list[Material], small_config: RunConfig, monkeypatch: pytest.MonkeyPatch
) -> None:
    used: list[object] = []
    real = of_fit.ONE_CHAINS["lattice"]

    def watched(view: PairView, plugins: PlugIns, scales: Scales, boosters: Boosters, inference: InferenceConfig) -> LatticeChain:
        used.append(boosters)
        return real(view, plugins, scales, boosters, inference)

    monkeypatch.setattr(of_fit, "ONE_CHAINS", {"lattice": watched})
    model = JointScanCRF(replace(small_config.model, coupling="lattice"))
    margins = fit(model, material, replace(small_config.learning, max_steps=2))
    assert [boosters is margins[part.fold] for boosters, part in zip(used, material, strict=True)] == [True] * len(material)
