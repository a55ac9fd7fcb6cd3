"""What the scans of a pair say before anything learned is asked: its parts fit together."""

import numpy as np
import pytest
from surveyed import SCENES, survey

from torchcrf_scan.search.score import FEATURES
from torchcrf_scan.search.survey import grids_of, survey_at


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
