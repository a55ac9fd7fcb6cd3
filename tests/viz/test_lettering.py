"""Names in letters that the font lacks are drawn without a warning."""

import pytest
from results import true_results

from torchcrf_scan.viz.lettering import drawable
from torchcrf_scan.viz.summary import Summary


@pytest.mark.parametrize(
    ("name", "drawn"), [("日x", r"\u65e5x"), ("run\n\x01", r"run\n\x01"), ("\U0001f697\udcff", r"\U0001f697\udcff"), ("žΩ", "žΩ")]
)
def test_any_name_is_drawn_without_a_warning(name: str, drawn: str) -> None:
    """Warnings are errors here."""
    assert drawable(name) == drawn
    summary = Summary()
    for result in true_results(2):
        summary.add(result)
    summary.plot(name).canvas.draw()
