"""Which movers stay, against the eager functions, on simulated scenes."""

from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from torchcrf_scan import JointScanCRF
from torchcrf_scan.batch import ScanPairBatch
from torchcrf_scan.data.simulate import simulate_pairs
from torchcrf_scan.data.worlds import SimulatorConfig
from torchcrf_scan.fast import arrays, decode, rounds, selection
from torchcrf_scan.features.potentials import PairView
from torchcrf_scan.inference import selection as eager
from torchcrf_scan.inference.joint import first_state
from torchcrf_scan.inference.start import Start
from torchcrf_scan.inference.state import State
from torchcrf_scan.loops.pair import pair_of
from torchcrf_scan.search.pairs import start_arrays


@cache
def layer() -> JointScanCRF:
    return JointScanCRF.from_pretrained(backend="eager").double().requires_grad_(False)


@cache
def considered(seed: int) -> tuple[ScanPairBatch, PairView, Start, State]:
    pair = simulate_pairs(SimulatorConfig(beams=91, movers_min=3), 1, 1, seed)[0]
    batch = ScanPairBatch.collate([pair], torch.float64).without_truth()
    start, view = layer().initialise(batch), layer().view(batch)
    off_beams = (
        start.motions + 1e-3
    )  # a point on a beam, as where the sensor stands still, is on the side that rounding takes it to
    start = replace(start, motions=off_beams)
    scaled = start.scaled(view.factor).considered()
    return batch, view, start, first_state(view, scaled, layer().config.inference)


def array(values: Tensor) -> Any:
    return np.ascontiguousarray(values[0].numpy())


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("odds", [0.0, -4.0])
def test_evidence_and_choice_agree_with_the_eager_ones(seed: int, odds: float) -> None:
    batch, view, start, state = considered(seed)
    fitted, config = layer().fitted, layer().config
    learned, settings = arrays.fitted_of(fitted), arrays.settings_of(config)
    pair = pair_of(batch, 0)
    begin, none = start_arrays(start, 0, pair), np.zeros(len(pair.source))
    scene = decode.scene_of(pair, begin, none, none, settings)
    ours = decode.first_state(scene, begin, False)
    tables = rounds.tables_of(scene, ours, learned.clustering)
    scaled = start.scaled(view.factor).considered()
    expected = eager.evidence(view, scaled, state, fitted, config.inference)
    np.testing.assert_allclose(selection.evidence(tables, ours.active, learned.clustering), expected[0], atol=1e-8)
    assert scaled.log_odds is not None
    scaled = replace(scaled, log_odds=scaled.log_odds + odds)
    kept = eager.discard_vacuous(view, scaled, state, fitted, config.inference).motions.active
    active = ours.active.copy()
    selection.discard_vacuous(tables, active, array(scaled.log_odds), learned.clustering, learned.worth)
    np.testing.assert_array_equal(active, kept[0])


def test_the_background_alone_is_never_asked() -> None:
    batch, _, start, _ = considered(0)
    learned, settings = arrays.fitted_of(layer().fitted), arrays.settings_of(layer().config)
    pair = pair_of(batch, 0)
    begin, none = start_arrays(start, 0, pair), np.zeros(len(pair.source))
    scene = decode.scene_of(pair, begin, none, none, settings)
    state = decode.first_state(scene, begin, True)
    state.active[1:] = False
    selection.discard_vacuous(
        rounds.tables_of(scene, state, learned.clustering), state.active, begin.log_odds, learned.clustering, learned.worth
    )
    assert state.active.tolist() == [True] + [False] * (len(state.active) - 1)
