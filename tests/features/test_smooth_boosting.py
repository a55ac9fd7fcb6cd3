"""Stumps with sigmoids for steps: equal to the fitted ensemble in the limit, and differentiable in all they have."""

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from support import assert_close, generator, normal
from torch import Tensor

from torchcrf_scan.config import FeatureConfig, ModelConfig
from torchcrf_scan.features.boosting import StumpEnsemble
from torchcrf_scan.model import JointScanCRF

STUMPS = 9
SEEDS = st.integers(0, 10_000)


def fill(ensemble: StumpEnsemble, T: int, seed: int) -> StumpEnsemble:
    """T random stumps, some at the same threshold; thresholds are whole numbers."""
    feature = torch.randint(len(ensemble.thresholds), (T,), generator=generator(seed))
    threshold = -torch.randint(0, 10, (T,), generator=generator(seed + 1)).double()
    ensemble.set_stumps(feature, threshold, *normal(2, T, seed=seed))
    return ensemble


def pair_of(F: int, T: int, seed: int, width: float, *, is_learned: bool = False) -> tuple[StumpEnsemble, StumpEnsemble]:
    """The same stumps with steps and with sigmoids."""
    smooth = StumpEnsemble(F, STUMPS, width=width, is_learned=is_learned).double()
    return fill(StumpEnsemble(F, STUMPS).double(), T, seed), fill(smooth, T, seed)


def between_thresholds(*shape: int, seed: int) -> Tensor:
    """Numbers at least a tenth off every whole one."""
    return (
        -torch.randint(0, 10, shape, generator=generator(seed)) + 0.1 + 0.8 * torch.rand(shape, generator=generator(seed)).double()
    )


@given(st.integers(1, 5), st.integers(0, STUMPS), st.integers(0, 6), SEEDS)
def test_narrow_sigmoids_are_the_steps(F: int, T: int, examples: int, seed: int) -> None:
    steps, smooth = pair_of(F, T, seed, width=1e-3)
    phi = between_thresholds(examples, 2, F, seed=seed)
    assert_close(smooth(phi), steps(phi))


@given(st.integers(1, 5), st.integers(0, STUMPS), SEEDS)
def test_the_difference_falls_with_the_width(F: int, T: int, seed: int) -> None:
    phi = between_thresholds(8, F, seed=seed)
    gaps = []
    for width in (0.5, 0.1, 0.02):
        steps, smooth = pair_of(F, T, seed, width)
        gaps.append(float((smooth(phi) - steps(phi)).abs().sum()))
        bound = 2 * normal(2, max(T, 1), seed=seed).abs().sum() * torch.sigmoid(torch.tensor(-0.1 / width)) * len(phi)
        assert gaps[-1] <= float(bound) + 1e-12
    assert gaps[2] <= gaps[0] + 1e-12


def test_a_wide_sigmoid_by_hand() -> None:
    ensemble = StumpEnsemble(2, stumps=3, width=0.5).double()
    left, right = torch.tensor([1.0, -1.0]).double(), torch.tensor([3.0, 0.5]).double()
    ensemble.set_stumps(torch.tensor([1, 0]), torch.tensor([-2.0, -1.0]).double(), left, right)
    phi = torch.tensor([-0.5, -3.0]).double()
    expected = 1 + 2 * torch.sigmoid(torch.tensor(-2.0).double()) - 1 + 1.5 * torch.sigmoid(torch.tensor(1.0).double())
    assert_close(ensemble(phi), expected)


@given(st.integers(2, 6), st.integers(1, 5), SEEDS)
def test_margins_of_some_channels_add_up(F: int, cut: int, seed: int) -> None:
    cut = min(cut, F - 1)
    _, smooth = pair_of(F, STUMPS, seed, width=0.3)
    phi = normal(3, 4, F, seed=seed)
    assert_close(smooth.margins(phi[..., :cut]) + smooth.margins(phi[..., cut:], first=cut), smooth(phi))


def test_gradcheck_in_inputs_thresholds_and_table() -> None:
    _, smooth = pair_of(3, 5, 2, width=0.4, is_learned=True)
    names, values = zip(
        *((name, value.detach().clone().requires_grad_()) for name, value in smooth.named_parameters()), strict=True
    )

    def margin(phi: Tensor, *own: Tensor) -> Tensor:
        return torch.func.functional_call(smooth, dict(zip(names, own, strict=True)), (phi,))

    assert set(names) == {"thresholds", "table"}
    assert torch.autograd.gradcheck(margin, (normal(2, 4, 3).requires_grad_(), *values))


def test_padding_stays_padding_while_stumps_are_learned() -> None:
    _, smooth = pair_of(3, 5, 2, width=0.4, is_learned=True)
    before = smooth.thresholds.detach().clone()
    optimiser = torch.optim.AdamW(smooth.parameters(), lr=0.1)
    for _ in range(3):
        optimiser.zero_grad()
        smooth(normal(6, 3)).square().sum().backward()
        optimiser.step()
    moved = smooth.thresholds.detach()
    assert torch.equal(moved.isinf(), before.isinf())
    assert (moved != before)[before.isfinite()].all()
    assert smooth.table.isfinite().all()


def test_steps_have_no_gradient_and_sigmoids_have() -> None:
    steps, smooth = pair_of(3, STUMPS, 1, width=0.4)
    phi = normal(5, 3).requires_grad_()
    assert not steps(phi).requires_grad
    smooth(phi).sum().backward()
    assert phi.grad is not None
    assert phi.grad.any()


def test_the_same_keys_whether_learned_or_not() -> None:
    kinds = [StumpEnsemble(3), StumpEnsemble(3, width=0.1), StumpEnsemble(3, width=0.1, is_learned=True)]
    assert len({tuple(kind.state_dict()) for kind in kinds}) == 1
    kinds[2].load_state_dict(fill(StumpEnsemble(3), STUMPS, 4).state_dict())
    assert kinds[2].table.any()
    assert [len(list(kind.parameters())) for kind in kinds] == [0, 0, 2]


def test_a_model_learns_its_stumps_when_asked_to() -> None:
    plain, learned = (
        JointScanCRF(ModelConfig(features=f)) for f in (FeatureConfig(), FeatureConfig(smooth=0.1, learn_stumps=True))
    )
    assert set(plain.state_dict()) == set(learned.state_dict())
    names = {name for name, _ in learned.named_parameters()} - {name for name, _ in plain.named_parameters()}
    assert names == {f"boosters.{which}.{what}" for which in ("data", "outlier") for what in ("thresholds", "table")}
    fill(learned.boosters.data, 50, 1)
    before = learned.boosters.data.table.detach().clone()
    learned.reset_parameters()
    assert torch.equal(learned.boosters.data.table, before)  # they were fitted before the weights


@pytest.mark.parametrize(
    "wrong", [{"smooth": -0.1}, {"smooth": float("inf")}, {"learn_stumps": True}, {"embedding": "length"}], ids=str
)
def test_bad_settings_name_the_field(wrong: dict[str, object]) -> None:
    with pytest.raises(ValueError, match=next(iter(wrong))):
        FeatureConfig(**wrong)  # type: ignore[arg-type]
