"""What the background leaves of both scans, and the pieces that a scan consists of."""

import numpy as np
import oracles_search as oracles
import pytest
from hypothesis import given
from support import assert_close
from surveyed import SCENES, any_scan, oracle_of, seen, survey
from wall_and_car import STEP, on_car, polar, wall_and_car

from torchcrf_scan.geometry import se2
from torchcrf_scan.search.leftover import pieces
from torchcrf_scan.search.surface import AGREES, OCCLUDED, SEEN_THROUGH, UNMEASURED, Surface

SIGHTS = {"agrees": AGREES, "seen through": SEEN_THROUGH, "occluded": OCCLUDED, "unmeasured": UNMEASURED}


def test_a_car_that_shares_its_segment_with_the_wall_is_a_piece() -> None:
    surface = wall_and_car(0.0).scan
    assert np.unique(surface.segment).tolist() == [0]
    numbers = pieces(surface)
    assert np.unique(numbers[on_car(surface)]).tolist() == [1]
    assert np.unique(numbers[~on_car(surface)]).tolist() == [0, 2]


def test_a_piece_leads_round_the_seam_of_a_closed_scan() -> None:
    bearing = np.arange(720) * STEP
    ranges = np.where((bearing > 3) & (bearing < 3.2), 3.0, 5.0)
    numbers = pieces(seen(polar(ranges, bearing), closed=True))
    assert numbers[0] == numbers[-1]
    assert len(np.unique(numbers)) == 2


@given(any_scan())
def test_pieces_equal_the_oracle(scan: Surface) -> None:
    assert pieces(scan).tolist() == oracles.pieces(oracle_of(scan))


@pytest.mark.parametrize("name", SCENES)
def test_what_is_left_equals_the_oracle(name: str) -> None:
    found = survey(name)
    source, sight, target, back = found.scene.left()
    for side, residual, sights in ((found.leftover.source, source, sight), (found.leftover.target, target, back)):
        assert_close(side.residual, residual)
        assert side.sight.tolist() == [SIGHTS[verdict] for verdict in sights]
        assert_close(side.units, oracle_of(side.grid.scan).units)
        assert side.piece.tolist() == oracles.pieces(oracle_of(side.grid.scan))
    assert_close(found.leftover.carried, se2.apply(found.background, found.pair.source))
