import numpy as np
import pytest
import torch
from support import generator, normal

from torchcrf_scan.fast.boosting import add_margins, margin, stumps_of
from torchcrf_scan.features.boosting import StumpEnsemble


@pytest.mark.parametrize("stumps", [1, 5, 50])
def test_margins_equal_the_eager_ones(stumps: int) -> None:
    ensemble = StumpEnsemble(4, stumps).double()
    feature = torch.randint(0, 3, (stumps,), generator=generator(stumps))  # the last has none
    ensemble.set_stumps(feature, *normal(3, stumps, seed=stumps))
    phi = torch.cat([normal(60, 4, seed=1), ensemble.thresholds[:, 0].nan_to_num(posinf=0.0)[None]])  # at a threshold, too
    table = stumps_of(ensemble)
    for f in range(4):
        values, total = phi[:, f].numpy().copy(), np.zeros(len(phi))
        add_margins(table, f, values, total)
        expected = ensemble.margins(phi[:, f : f + 1], f).numpy()
        np.testing.assert_allclose(total, expected, rtol=1e-12, atol=1e-12)
        np.testing.assert_allclose([margin(table, f, value) for value in values], expected, rtol=1e-12, atol=1e-12)
    assert table.is_live.tolist() == [bool((feature == f).any()) for f in range(4)]


def test_nothing_fitted_is_zero() -> None:
    assert margin(stumps_of(StumpEnsemble(3)), 0, 1.0) == 0
