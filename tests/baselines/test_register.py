"""The register of the baselines: what a row goes on from comes before it, and what it declares is so."""

import numpy as np
import pytest
from checks import check
from rooms import room_pair

from torchcrf_scan.baselines.register import BASELINES, by_command


def test_rows_and_commands_have_a_name_of_their_own() -> None:
    commands = [baseline.command for baseline in BASELINES.values() if baseline.command]
    assert len(set(commands)) == len(commands) == len(by_command()) == 3


@pytest.mark.parametrize("row", [row for row, baseline in BASELINES.items() if baseline.after])
def test_a_row_comes_after_the_one_that_it_goes_on_from(row: str) -> None:
    rows = list(BASELINES)
    assert rows.index(BASELINES[row].after) < rows.index(row)


@pytest.mark.parametrize("command", by_command())
def test_a_command_answers_from_the_pair_alone(command: str) -> None:
    pair = room_pair(np.array([0.03, 0.1, -0.08]))
    check(pair, by_command()[command](pair))
