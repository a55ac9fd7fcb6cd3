"""What the scans of a pair say before anything learned is asked: its parts fit together."""

import numpy as np
import pytest
from surveyed import SCENES, survey

from torchcrf_scan.search.feature_points import AT
from torchcrf_scan.search.score import FEATURES
from torchcrf_scan.search.survey import grids_of, may_stand, survey_at, without_standing


@pytest.mark.parametrize("name", SCENES)
def test_the_parts_of_a_survey_fit_together(name: str) -> None:
    at = survey(name)
    H = len(at.found.motions)
    assert at.features.shape == (H, len(FEATURES))
    assert at.found.group.shape == (H,)
    assert not np.isnan(at.features).any()
    assert [len(side.residual) for side in (at.leftover.source, at.leftover.target)] == [len(at.pair.source), len(at.pair.target)]
    assert at.leftover.background.tolist() == at.background.tolist()


def test_the_target_is_seen_from_where_its_sensor_stood() -> None:
    pair = survey("street").pair
    moved = pair._replace(target=pair.target + 3.0, target_origin=np.full(2, 3.0))
    here, there = grids_of(pair)[1].scan, grids_of(moved)[1].scan
    np.testing.assert_allclose(there.ranges, here.ranges, atol=1e-12)
    np.testing.assert_allclose(there.spacing, here.spacing, atol=1e-12)
    assert there.segment.tolist() == here.segment.tolist()


def test_a_survey_is_the_same_every_time() -> None:
    at = survey("street")
    again = survey_at(*grids_of(at.pair), at.background, at.pair.dt)
    assert again.features.tolist() == at.features.tolist()
    assert again.hypotheses.motions.tolist() == at.found.motions.tolist()


@pytest.mark.parametrize(
    ("occluded", "landing_open", "may"),
    [
        (0.6, 0.1, True),  # the edge of a shadow
        (0.6, 0.5, False),  # a mover that goes before something new
        (0.4, 0.1, False),  # gone from where the second scan sees a wall
    ],
)
def test_a_group_may_stand_if_it_is_hidden_and_its_new_place_holds_nothing_new(
    occluded: float, landing_open: float, may: bool
) -> None:
    row = np.zeros((1, len(FEATURES)))
    row[0, AT.occluded_before], row[0, AT.landing_open] = occluded, landing_open
    assert may_stand(row).tolist() == [may]


def test_what_may_stand_is_left_out_and_nothing_else() -> None:
    parts = survey("street")
    whole = survey_at(*grids_of(parts.pair), parts.background, parts.pair.dt)
    some = whole._replace(features=whole.features.copy())
    some.features[::2, AT.occluded_before], some.features[::2, AT.landing_open] = 1.0, 0.0
    left = without_standing(some)
    assert 0 < len(left.features) < len(some.features)
    assert not may_stand(left.features).any()
    moves = ~may_stand(some.features)
    assert left.hypotheses.motions.tolist() == some.hypotheses.motions[moves].tolist()
    assert left.hypotheses.group.tolist() == some.hypotheses.group[moves].tolist()
