"""Functions of the variants declared in `choices`, by name."""

from __future__ import annotations

from collections.abc import Callable, Mapping

from torch import Tensor

from torchcrf_scan.choices import COUPLINGS, SCHEDULES, STARTS, load
from torchcrf_scan.config import InferenceConfig, ModelConfig
from torchcrf_scan.features.potentials import Boosters, PairView
from torchcrf_scan.features.scales import Scales
from torchcrf_scan.inference.pseudo_likelihood import PlugIns
from torchcrf_scan.inference.start import Start
from torchcrf_scan.inference.state import Parameters
from torchcrf_scan.prediction import Prediction
from torchcrf_scan.variants.lattice_likelihood import LatticeChain

Decode = Callable[[PairView, Start, Parameters, ModelConfig], Prediction]
Begin = Callable[[PairView, Start, Parameters, InferenceConfig], Start]
Likelihood = Callable[[PairView, PlugIns, Parameters, ModelConfig], Tensor]
OneChain = Callable[[PairView, PlugIns, Scales, Boosters, InferenceConfig], LatticeChain]

DECODERS: Mapping[str, Decode] = {name: load(schedule.function) for name, schedule in SCHEDULES.items()}
BEGINNINGS: Mapping[str, Begin] = {name: load(start.function) for name, start in STARTS.items() if start.function}
LIKELIHOODS: Mapping[str, Likelihood] = {name: load(coupling.likelihood) for name, coupling in COUPLINGS.items()}
ONE_CHAINS: Mapping[str, OneChain] = {name: load(coupling.chain) for name, coupling in COUPLINGS.items() if coupling.chain}
