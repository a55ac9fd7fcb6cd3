"""Learning-rate schedule and early stopping."""

from __future__ import annotations

import math
from dataclasses import dataclass

from torch.optim import Optimizer
from torch.optim.lr_scheduler import LambdaLR

from torchcrf_scan.learning.settings import GradientConfig


def rate_at(step: int, config: GradientConfig) -> float:
    """Share of the highest learning rate at a step: rising to 1 in `warmup` steps, then along a cosine to `final_rate`."""
    if step < config.warmup:
        return (step + 1) / (config.warmup + 1)
    done = min(1.0, (step - config.warmup) / max(1, config.steps - config.warmup))
    return config.final_rate + (1 - config.final_rate) * (1 + math.cos(math.pi * done)) / 2


def make_schedule(optimiser: Optimizer, config: GradientConfig) -> LambdaLR:
    """The scheduler of a run; its rate is a function of the step alone, so it resumes exactly."""
    return LambdaLR(optimiser, lambda step: rate_at(step, config))


@dataclass(slots=True)
class EarlyStopping:
    """Early stopping by the validation loss.

    Attributes:
        patience: validations without improvement after which training ends; 0: never.
        best: least loss so far, `step` at which it occurred. stale: validations since then.
    """

    patience: int
    best: float = math.inf
    step: int = 0
    stale: int = 0

    def look(self, step: int, loss: float) -> bool:
        """Takes a loss into account; returns whether it is the best so far. NaN never is."""
        if loss < self.best:
            self.best, self.step, self.stale = loss, step, 0
            return True
        self.stale += 1
        return False

    @property
    def is_over(self) -> bool:
        """Whether to stop."""
        return 0 < self.patience <= self.stale

    def state_dict(self) -> dict[str, float]:
        """The variable state."""
        return {"best": self.best, "step": self.step, "stale": self.stale}

    def load_state_dict(self, state: dict[str, float]) -> None:
        """Restores a state."""
        self.best, self.step, self.stale = state["best"], int(state["step"]), int(state["stale"])
