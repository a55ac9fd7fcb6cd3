"""Everything that is compared: every row answers, and only the rows that say so have seen the truth."""

import copy
import itertools
from collections.abc import Sequence
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest
import torch
from scenes import make_batch, make_start

from torchcrf_scan.baselines.register import BASELINES, Baseline, installed
from torchcrf_scan.batch import Truth
from torchcrf_scan.config import EncoderConfig
from torchcrf_scan.experiment.methods import METHODS, Answer, answer, true_start, with_motions_given
from torchcrf_scan.experiment.models import ENCODED, EXACT, JOINT, LATTICE, LATTICE_EXACT, Models, fit_models
from torchcrf_scan.experiment.settings import RunConfig
from torchcrf_scan.experiment.study import Study
from torchcrf_scan.geometry import se2
from torchcrf_scan.learning.calibration_fit import calibrate
from torchcrf_scan.learning.settings import GradientConfig
from torchcrf_scan.model import JointScanCRF, with_config
from torchcrf_scan.scan import PairPrediction, ScanPair

ORACLES = ("joint, true motions", "joint, true associations")
OWN = ("association_weights", "clustering_weights", "cluster_potential", "calibration")  # of every joint model


@pytest.fixture(scope="module")
def answers(models: Models, small_pairs: list[ScanPair]) -> dict[str, Answer]:
    """Of the last pair, which no model has seen."""
    return answer(models, small_pairs[5])


def test_every_row_that_can_be_there_is_there(answers: dict[str, Answer]) -> None:
    assert len(set(METHODS)) == len(METHODS)
    assert set(answers) == set(METHODS) - {ENCODED} - (set(BASELINES) - set(installed()))


def test_a_library_has_its_row_where_it_is_installed(
    answers: dict[str, Answer], models: Models, small_pairs: list[ScanPair], monkeypatch: pytest.MonkeyPatch
) -> None:
    still = answers["all background"].prediction
    libraries = {row: Baseline(lambda case: still) for row, baseline in BASELINES.items() if baseline.requires}
    monkeypatch.setattr("torchcrf_scan.experiment.methods.installed", lambda: {**BASELINES, **libraries})
    found = answer(models, small_pairs[5])
    assert list(found) == [row for row in METHODS if row != ENCODED]
    assert len(libraries) == 2
    assert all(found[row].prediction is still for row in libraries)


def test_answers_are_of_the_pair_and_took_time(answers: dict[str, Answer], small_pairs: list[ScanPair]) -> None:
    beams = small_pairs[5].source.n_beams
    for name, one in answers.items():
        assert one.seconds > 0, name
        assert one.prediction.association.shape == one.prediction.cluster.shape == (beams,), name
        assert np.isfinite(one.prediction.motions).all(), name
    for name in ("K-Means (ICP)", "K-Means (ICP), ego removed"):  # what they are fed with counts
        assert answers[name].seconds > answers["ICP, tuned"].seconds
        assert (answers[name].prediction.association == answers["ICP, tuned"].prediction.association).all()
    assert answers["K-Means (CRF-Matching)"].seconds > answers["CRF-Matching"].seconds
    assert (answers["CRF-Clustering"].prediction.association == answers["CRF-Matching"].prediction.association).all()


def scrambled(pair: ScanPair) -> ScanPair:
    """The same scans with another annotation of the same shape."""
    truth = pair.annotation
    assert truth is not None
    association = np.where(truth.association >= 0, truth.association[::-1].clip(min=0), -1)
    cluster = np.where(truth.cluster >= 0, (truth.cluster + 1) % len(truth.motions), -1)
    other = replace(truth, association=association, cluster=cluster, motions=truth.motions + 0.3, body=np.maximum(cluster, 0))
    return replace(pair, annotation=other)


def differing(one: PairPrediction, other: PairPrediction) -> bool:
    pairs = [(np.asarray(getattr(one, f.name)), np.asarray(getattr(other, f.name))) for f in fields(one)]
    return any(a.shape != b.shape or not np.array_equal(a, b, equal_nan=a.dtype.kind == "f") for a, b in pairs)


def test_the_truth_reaches_the_two_rows_that_name_it_alone(
    answers: dict[str, Answer], models: Models, small_pairs: list[ScanPair]
) -> None:
    lied_to = answer(models, scrambled(small_pairs[5]))
    assert lied_to.keys() == answers.keys()
    assert {name for name in answers if differing(answers[name].prediction, lied_to[name].prediction)} == set(ORACLES)


def test_true_motions_and_true_associations_stay(answers: dict[str, Answer], small_pairs: list[ScanPair]) -> None:
    pair = small_pairs[5]
    truth = pair.annotation
    assert truth is not None
    found = answers["joint, true motions"].prediction.motions
    for motion in found:
        turn, shift = se2.distance(np.broadcast_to(motion, truth.motions.shape), truth.motions)
        assert ((turn < 1e-5) & (shift < 1e-4)).any()
    told = answers["joint, true associations"].prediction.association[pair.source.beam]
    assert (told == truth.association[pair.source.beam]).all()


def test_the_true_start_ends_a_mover_at_its_reach() -> None:
    """A background point whose counterpart is missing comes to lie on another point by the motion of a mover far away."""
    apart = torch.stack([0.5 * torch.arange(26), 10 + 0.1 * torch.arange(26) ** 2 % 0.3], dim=-1).double()
    apart[20:, 0] += 20
    cluster = (torch.arange(26) >= 20).long()[None]
    motions = torch.tensor([[[0.0, 0.0, 0.0], [0.0, 0.0, 2.0]]]).double()
    moved = apart + motions[0, cluster[0], 1:]
    moved[0] = apart[0] + motions[0, 1, 1:]
    association = torch.arange(26)[None].clone()
    cluster[0, 0] = association[0, 0] = -1
    batch = make_batch(apart[None], moved[None])
    batch = replace(batch, truth=Truth(association, cluster, motions, torch.ones_like(batch.source_mask)))
    found = true_start(batch, make_start(batch, motions[0]))
    assert torch.equal(found.association, association)
    assert found.reach is not None
    assert (found.reach[0, :, 1] > 0).tolist() == (torch.arange(26) < 20).tolist()


def test_the_joint_model_alone_is_the_same_model(
    study: Study, models: Models, small_pairs: list[ScanPair], small_config: RunConfig
) -> None:
    config = replace(small_config, experiment=replace(small_config.experiment, joint_alone=True))
    alone = fit_models(study, range(4), config, variants=True)
    assert list(alone.joint) == [JOINT]
    assert alone.cascade is None
    for name, value in models.joint[JOINT].state_dict().items():
        expected = JointScanCRF().state_dict()[name] if name.startswith("calibration.") else value
        assert torch.equal(alone.joint[JOINT].state_dict()[name], expected), name
    assert list(answer(alone, small_pairs[5])) == [JOINT]


def test_the_joint_models_share_their_features(models: Models) -> None:
    assert list(models.joint) == [JOINT, EXACT, LATTICE, LATTICE_EXACT]
    states = [model.state_dict() for model in models.joint.values()]
    for name, value in states[0].items():
        same = [torch.equal(state[name], value) for state in states[1:]]
        assert all(same) or name.split(".")[0] in OWN, name
    weights = [torch.cat(model.weight_vectors).detach() for model in models.joint.values()]
    assert all(not torch.equal(one, other) for one, other in itertools.combinations(weights, 2))


def test_a_model_with_an_encoder_goes_on_from_the_joint_model(
    study: Study, models: Models, small_pairs: list[ScanPair], small_config: RunConfig
) -> None:
    config = replace(
        small_config,
        model=replace(small_config.model, encoder=EncoderConfig(width=4, dilations=(1,))),
        gradient=GradientConfig(objective="likelihood", steps=2, batch_size=2, part=2, workers=0, fresh=0.0),
        experiment=replace(small_config.experiment, joint_alone=True),
    )
    both = fit_models(study, range(4), config, variants=True)
    assert list(both.joint) == [JOINT, ENCODED]
    plain, encoded = both.joint.values()
    assert plain.encoder is None
    assert encoded.encoder is not None
    assert bool((encoded.encoder.last.weight[:2] != 0).any())
    assert torch.equal(plain.boosters.data.table, models.joint[JOINT].boosters.data.table)
    assert torch.equal(encoded.boosters.data.table, plain.boosters.data.table)
    assert not torch.equal(torch.cat(encoded.weight_vectors), torch.cat(plain.weight_vectors))
    assert list(answer(both, small_pairs[5])) == [JOINT, ENCODED]
    with pytest.raises(ValueError, match=r"gradient\.objective: expected one for a model with an encoder"):
        fit_models(study, range(4), replace(config, gradient=GradientConfig()), variants=False)


def test_every_joint_model_is_calibrated_on_what_it_was_fitted_on(study: Study, models: Models, small_config: RunConfig) -> None:
    """The fold's own pairs alone: a second calibration on them changes nothing."""
    for name, model in models.joint.items():
        again = copy.deepcopy(model)
        calibrate(again, study.collection.material(range(4), model.hypothesis_score, 4, small_config.learning))
        assert torch.equal(again.calibration.association, model.calibration.association), name
        assert torch.equal(again.calibration.cluster, model.calibration.cluster), name
        assert not torch.equal(model.calibration.association, JointScanCRF().calibration.association), name


def joint_rows(answers: dict[str, Answer]) -> Sequence[str]:
    return [name for name in answers if name.startswith("joint")]


def test_a_lattice_may_be_the_joint_model(models: Models, small_pairs: list[ScanPair]) -> None:
    lattice = replace(models, joint={JOINT: models.joint[LATTICE]})
    assert joint_rows(answer(lattice, small_pairs[4])) == [JOINT, *ORACLES]


def test_flooding_has_no_lattice_and_holds_true_motions_by_the_sweep(study: Study, small_config: RunConfig) -> None:
    inference = replace(small_config.model.inference, schedule="flooding", iterations=1)  # no answer counts here
    config = replace(small_config, model=replace(small_config.model, inference=inference))
    flooding = fit_models(study, range(4), config, variants=True)
    assert list(flooding.joint) == [JOINT, EXACT]
    given = with_motions_given(flooding.joint[JOINT]).config.inference
    assert (given.schedule, given.motion_metric) == ("sweep", "given")


def test_another_config_shares_the_weights(models: Models) -> None:
    model = models.joint[JOINT]
    before = model.config
    other = with_config(model, replace(before, chains="clustering"))
    assert (model.config, other.config.chains) == (before, "clustering")
    for (name, mine), (_, theirs) in zip(model.named_parameters(), other.named_parameters(), strict=True):
        assert mine is theirs, name
    assert other.scales is model.scales
    assert other.boosters is model.boosters


def test_variants_that_share_their_features_fit_them_once(
    study: Study, models: Models, small_config: RunConfig, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    kept = replace(study, kept=tmp_path)
    config = replace(small_config, experiment=replace(small_config.experiment, joint_alone=True))
    first = fit_models(kept, range(4), config, variants=False).joint[JOINT]
    assert len(list(tmp_path.iterdir())) == 1
    monkeypatch.setattr("torchcrf_scan.learning.fit.fit_all_boosters", lambda *_: pytest.fail("fitted again"))
    faster = replace(config, model=replace(config.model, inference=replace(config.model.inference, iterations=1)))
    again = fit_models(kept, range(4), faster, variants=False).joint[JOINT]
    assert torch.equal(again.boosters.data.table, first.boosters.data.table)
    assert torch.equal(first.boosters.data.table, models.joint[JOINT].boosters.data.table)
