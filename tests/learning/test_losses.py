"""What the register of the losses declares is so."""

from dataclasses import replace

import pytest
import torch

from torchcrf_scan import InferenceConfig, JointScanCRF, ModelConfig, ScanPairBatch
from torchcrf_scan.data.simulate import simulate_pairs
from torchcrf_scan.data.worlds import SimulatorConfig
from torchcrf_scan.learning.losses import LOSSES, NO_STEPS, STAGED
from torchcrf_scan.learning.objectives import make_objective
from torchcrf_scan.learning.portions import Portion
from torchcrf_scan.learning.settings import Config, GradientConfig, LearningConfig, UnrolledConfig


def config_of(name: str) -> Config:
    return Config(gradient=GradientConfig(objective=name), unrolled=UnrolledConfig(iterations=1))


@pytest.mark.parametrize("name", LOSSES)
def test_a_loss_can_be_descended(name: str) -> None:
    model = JointScanCRF(ModelConfig(inference=InferenceConfig(clusters=3, candidates=3, backend="eager")))
    portion = Portion(ScanPairBatch.collate(simulate_pairs(SimulatorConfig(beams=21), 1, 1, 3)))
    loss = make_objective(config_of(name))(model, portion)["total"]
    assert loss.shape == ()
    loss.backward()
    gradients = [weight.grad for weight in model.parameters() if weight.grad is not None]
    assert torch.cat([gradient.flatten() for gradient in gradients]).abs().sum() > 0


@pytest.mark.parametrize("name", LOSSES)
def test_what_the_staged_fit_does_not_know_goes_on_from_what_it_knows(name: str) -> None:
    config = Config(learning=LearningConfig(objective=name))
    assert config.staged.objective == (name if LOSSES[name].is_staged else STAGED)
    assert config.first_order == (NO_STEPS if LOSSES[name].is_staged else name)
    assert config.has_steps != LOSSES[name].is_staged


@pytest.mark.parametrize("name", LOSSES)
def test_only_some_losses_look_for_a_start(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Where none is needed none is looked for, with surveys or without."""
    asked = []
    initialise = JointScanCRF.initialise
    monkeypatch.setattr(JointScanCRF, "initialise", lambda self, batch: asked.append(1) or initialise(self, batch))
    model = JointScanCRF(ModelConfig(inference=InferenceConfig(clusters=3, candidates=3, backend="eager")))
    portion = Portion(ScanPairBatch.collate(simulate_pairs(SimulatorConfig(beams=21), 1, 1, 3)))
    make_objective(config_of(name))(model, portion)
    assert not asked or LOSSES[name].needs_start


def test_no_other_loss_is_known() -> None:
    with pytest.raises(ValueError, match=f"expected one of {NO_STEPS}, {', '.join(LOSSES)}, got luck"):
        GradientConfig(objective="luck")
    with pytest.raises(ValueError, match=f"expected one of {', '.join(LOSSES)}, got luck"):
        replace(LearningConfig(), objective="luck")
