"""Validation pairs: losses per known node of all of them, answers in their order, whoever looked at which part."""

import pytest
import small_run
import torch

from torchcrf_scan.batch import ScanPairBatch
from torchcrf_scan.evaluation.metrics import score_pair
from torchcrf_scan.evaluation.summary import summarise
from torchcrf_scan.learning.objectives import known_nodes, make_objective, pseudo_likelihood
from torchcrf_scan.learning.portions import as_portion
from torchcrf_scan.learning.ranks import ALONE, Ranks
from torchcrf_scan.learning.validation import BASELINE, Validation, evaluating
from torchcrf_scan.model import JointScanCRF
from torchcrf_scan.scan import ScanPair


@pytest.fixture(scope="module")
def model() -> JointScanCRF:
    return JointScanCRF(small_run.small_config().model)


@pytest.fixture(scope="module")
def pairs() -> list[ScanPair]:
    return small_run.small_pairs()[0][:3]


@pytest.fixture(scope="module")
def validation(pairs: list[ScanPair]) -> Validation:
    return Validation.of(pairs, 2, ALONE)


def test_the_loss_is_that_of_all_pairs_at_once(model: JointScanCRF, pairs: list[ScanPair], validation: Validation) -> None:
    whole = as_portion(pairs)
    loss = pseudo_likelihood(model, whole)["total"]
    assert loss.item() == pytest.approx(-model.pseudo_log_likelihood(whole.batch).sum().item() / int(known_nodes(whole.batch)))
    assert validation.losses(model, pseudo_likelihood, ALONE) == {"total": pytest.approx(loss.item(), rel=1e-5)}


def test_unrolled_losses_have_their_terms(model: JointScanCRF, validation: Validation) -> None:
    found = validation.losses(model, make_objective(small_run.small_config(objective="unrolled")), ALONE)
    assert set(found) == {"association", "cluster", "rotation", "translation", "total"}


def test_processes_look_at_every_part_once(pairs: list[ScanPair]) -> None:
    shares = [Validation.of(pairs, 1, Ranks(rank, 2)).places for rank in range(2)]
    assert shares == [((0,), (2,)), ((1,),)]


def test_answers_are_the_models(model: JointScanCRF, pairs: list[ScanPair], validation: Validation) -> None:
    answers = validation.answers(model, ALONE)
    assert answers is not None
    assert answers.pairs == tuple(pairs)
    own = model.match_pairs(pairs)
    for answer, expected in zip(answers.predictions["joint"], own, strict=True):
        assert (answer.cluster == expected.cluster).mean() > 0.95  # other padding, other rounding
    assert len(answers.predictions[BASELINE]) == 3
    assert summarise([score_pair(*of) for of in zip(pairs, answers.predictions[BASELINE], strict=True)])["cluster_accuracy"] > 0
    for pair, sure in zip(pairs, answers.moving, strict=True):
        assert sure.shape == (len(pair.source),)
        assert ((sure >= 0) & (sure <= 1 + 1e-6)).all()
    assert isinstance(answers.example[0], ScanPairBatch)


def test_a_module_is_in_training_again_after_an_evaluation(model: JointScanCRF) -> None:
    model.train()
    with pytest.raises(ZeroDivisionError), evaluating(model):
        _ = 1 / int(model.training)
    assert model.training
    model.eval()
    with evaluating(model), torch.no_grad():
        pass
    assert not model.training
