"""The table of variants: each beside the model, on the pairs that both were tested on."""

from dataclasses import replace

import numpy as np
import pytest
from made_pairs import make_pair, perfect, perturbed

from torchcrf_scan.evaluation.bootstrap import Difference, by_sequence, paired_intervals
from torchcrf_scan.evaluation.metrics import PairScore, score_pair
from torchcrf_scan.evaluation.report import DIFFERENCES, OVERVIEW
from torchcrf_scan.evaluation.summary import summarise
from torchcrf_scan.experiment.ablation import ablation_table

SECONDS = {"model": [0.1, 0.4, 0.2, 0.3], "worse": [1.0, 3.0, 2.0, 5.0], "fewer": [0.5, 0.5]}


def resample(scores: list[PairScore]) -> np.ndarray:
    return by_sequence([one.sequence for one in scores], resamples=40)


@pytest.fixture
def scores() -> dict[str, list[PairScore]]:
    """The model is always right, one variant is not, the other was tested on every second pair."""
    random = np.random.default_rng(0)
    pairs = [replace(make_pair(40, 40, 2, random), name=f"pair {k}", sequence="ab"[k % 2]) for k in range(4)]
    worse = [score_pair(pair, perturbed(pair, random)) for pair in pairs]
    return {"model": [score_pair(pair, perfect(pair)) for pair in pairs], "worse": worse, "fewer": worse[::2]}


def test_every_variant_is_compared_on_its_own_pairs(scores: dict[str, list[PairScore]]) -> None:
    table = ablation_table(scores, SECONDS, resample)
    assert [row[0] for row in table.rows] == ["model", "worse", "fewer"]
    assert [row[1] for row in table.rows] == [4, 4, 2]
    for name, row in zip(scores, table.rows, strict=True):
        cells = dict(zip(table.columns, row, strict=True))
        summary = summarise(scores[name])
        for heading, key, _ in OVERVIEW:
            assert cells[heading] == pytest.approx(summary[key], nan_ok=True), (name, key)
        theirs = scores["model"][::2] if name == "fewer" else scores["model"]
        expected = paired_intervals(scores[name], theirs, resample(theirs))
        for heading, key in DIFFERENCES:
            found = cells[f"difference: {heading}"]
            if name == "model":
                assert found == "-"
            else:
                assert isinstance(found, Difference)
                assert (found.value, found.low, found.high) == pytest.approx(
                    (expected[key].value, expected[key].low, expected[key].high), nan_ok=True
                )
                assert not found.value > 0  # the model is always right
    times = [dict(zip(table.columns, row, strict=True))["time (ms)"] for row in table.rows]
    assert times == pytest.approx([250, 2500, 500])
    assert "* where it excludes zero" in table.to_markdown()


def test_a_pair_that_the_model_was_not_tested_on_is_an_error(scores: dict[str, list[PairScore]]) -> None:
    with pytest.raises(KeyError, match="pair 1"):
        ablation_table({"model": scores["model"][::2], "worse": scores["worse"]}, SECONDS, resample)
