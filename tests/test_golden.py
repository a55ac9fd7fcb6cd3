"""The answers of today are those of before."""

import numpy as np
import pytest
from golden import FIELDS, FILE, MODELS, answers, arrays

from torchcrf_scan.data.worlds import WORLDS


@pytest.mark.parametrize("model", MODELS)
@pytest.mark.parametrize("world", WORLDS)
def test_the_answers_are_those_of_before(model: str, world: str) -> None:
    found = arrays(answers(model, world))
    with np.load(FILE) as kept:
        expected = {name: kept[f"{model}/{world}/{name}"] for name in FIELDS}
    for name in ("association", "cluster"):
        np.testing.assert_array_equal(found[name], expected[name], err_msg=name)
    np.testing.assert_allclose(found["motions"], expected["motions"], rtol=0, atol=1e-6)
