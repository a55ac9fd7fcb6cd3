"""The learning rate over the steps, and when training stops."""

import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from torchcrf_scan.learning.schedule import EarlyStopping, make_schedule, rate_at
from torchcrf_scan.learning.settings import GradientConfig


@given(steps=st.integers(1, 60), warmup=st.integers(0, 80), final=st.floats(0, 1))
def test_the_rate_rises_then_falls(steps: int, warmup: int, final: float) -> None:
    config = GradientConfig(steps=steps, warmup=warmup, final_rate=final)
    rates = [rate_at(k, config) for k in range(steps + 1)]
    assert all(0 <= rate <= 1 for rate in rates)
    top = min(warmup, steps)
    assert rates[: top + 1] == sorted(rates[: top + 1])
    assert rates[top:] == sorted(rates[top:], reverse=True)
    if warmup < steps:
        assert rates[warmup] == 1
        assert rates[-1] == pytest.approx(final)


def test_the_scheduler_says_the_same_and_resumes() -> None:
    config = GradientConfig(steps=10, warmup=3, learning_rate=0.2)
    optimiser = torch.optim.AdamW([torch.nn.Parameter(torch.zeros(()))], lr=0.2)
    schedule = make_schedule(optimiser, config)
    for k in range(10):
        assert schedule.get_last_lr()[0] == pytest.approx(0.2 * rate_at(k, config))
        optimiser.step()
        schedule.step()
        if k == 4:
            kept = schedule.state_dict()
    again = make_schedule(optimiser, config)
    again.load_state_dict(kept)
    assert again.last_epoch == 5


def test_training_stops_after_looks_without_a_better_one() -> None:
    stopping = EarlyStopping(patience=2)
    assert [stopping.look(k, loss) for k, loss in enumerate([3.0, 2.0, 2.0])] == [True, True, False]
    assert not stopping.is_over
    assert not stopping.look(3, math.nan)
    assert stopping.is_over
    assert (stopping.best, stopping.step) == (2.0, 1)
    other = EarlyStopping(patience=2)
    other.load_state_dict(stopping.state_dict())
    assert other == stopping


def test_without_patience_it_never_stops() -> None:
    stopping = EarlyStopping(patience=0)
    for k in range(50):
        stopping.look(k, float(k))
    assert not stopping.is_over
