"""Candidates that are kept from round to round are those that a search finds anew."""

import numpy as np
import pytest
import torch
from support import make_points, normal

from torchcrf_scan.fast import kept_candidates
from torchcrf_scan.geometry import se2
from torchcrf_scan.loops.candidates import by_motion
from torchcrf_scan.loops.nearest import boxes_of


@pytest.mark.parametrize("count", [0, 1, 5, 59, 60, 80])
def test_kept_candidates_are_the_ones_that_a_search_finds(count: int) -> None:
    source, target = make_points(50, 1).numpy(), make_points(60, 2).numpy()
    boxes, motions, active = boxes_of(target), 0.1 * normal(3, 3, seed=4).numpy(), np.array([True, True, False])
    kept = kept_candidates.kept_of(50, 60, 3, count)
    for step in range(12):
        motions = motions + 0.3 ** (step % 6) * 0.1 * normal(3, 3, seed=step).numpy()
        active = np.array([True, step % 5 < 3, step > 8])
        moved = se2.apply(torch.from_numpy(motions), torch.from_numpy(source)).numpy()
        kept_candidates.update(kept, boxes, source, moved, motions, active)
        np.testing.assert_array_equal(kept.index, by_motion(boxes, source, motions, active, count)[0])
