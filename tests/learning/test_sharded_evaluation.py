"""Test pairs shared out among processes: everybody ends with all answers, in their order."""

from dataclasses import dataclass, field
from typing import Any

import numpy as np
import small_run

from torchcrf_scan.learning.ranks import ALONE, Ranks
from torchcrf_scan.learning.trainer import evaluate
from torchcrf_scan.model import JointScanCRF


@dataclass(frozen=True)
class OneAfterTheOther(Ranks):
    """A process that finds what those before it have gathered."""

    before: list[Any] = field(default_factory=list)

    def gather(self, value: Any) -> list[Any]:
        self.before.append(value)
        return list(self.before)


def test_two_processes_find_what_one_finds() -> None:
    model = JointScanCRF(small_run.small_config().model)
    train, held_out = small_run.small_pairs()
    pairs = [*train, *held_out][:5]
    alone, answers = evaluate(model, {"joint": model}, pairs, 2)
    found: list[Any] = []
    first = OneAfterTheOther(0, 2, before=found)
    try:
        evaluate(model, {"joint": model}, pairs, 2, first)
    except KeyError:  # its own share is not all
        assert set(found[0]["joint"]) == {0, 1, 4}
    shared, gathered = evaluate(model, {"joint": model}, pairs, 2, OneAfterTheOther(1, 2, before=found))
    assert set(found[1]["joint"]) == {2, 3}
    assert [one.name for one in shared["joint"]] == [one.name for one in alone["joint"]]
    for one, other in zip(answers["joint"], gathered["joint"], strict=True):
        np.testing.assert_array_equal(one.association, other.association)
        np.testing.assert_array_equal(one.motions, other.motions)
    assert ALONE.gather(1) == [1]
