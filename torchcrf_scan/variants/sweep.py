"""The schedule `sweep` with the model's coupling: `inference.joint` with its update."""

from __future__ import annotations

from collections.abc import Mapping

from torchcrf_scan.choices import COUPLINGS, load
from torchcrf_scan.config import ModelConfig
from torchcrf_scan.features.potentials import PairView
from torchcrf_scan.inference import joint
from torchcrf_scan.inference.start import Start
from torchcrf_scan.inference.state import Parameters, Round
from torchcrf_scan.prediction import Prediction

UPDATES: Mapping[str, joint.Update] = {name: load(coupling.function) for name, coupling in COUPLINGS.items()}


def decode(view: PairView, start: Start, parameters: Parameters, model: ModelConfig) -> Prediction:
    """Labels and motions of a batch, see `joint.decode`."""
    return joint.decode(view, start, parameters, model, UPDATES[model.coupling])


def settle(view: PairView, start: Start, parameters: Parameters, model: ModelConfig) -> Round:
    """The state after the last round, see `joint.settle`."""
    return joint.settle(view, start, parameters, model, UPDATES[model.coupling])


def rounds(view: PairView, start: Start, parameters: Parameters, model: ModelConfig) -> list[Round]:
    """The start and every round after it, see `joint.rounds`."""
    return joint.rounds(view, start, parameters, model, UPDATES[model.coupling])
