import numpy as np
import pytest
import torch
from support import assert_close

pytest.importorskip("numba")

from surveyed import PAIRS, REAL, SCENES, survey
from torchcrf_scan.inference.background import unit_length

from torchcrf_scan.inference import hypotheses as eager
from torchcrf_scan.loops.nearest import nearest_within
from torchcrf_scan.search.groups import ends
from torchcrf_scan.search.hypotheses import residual_units
from torchcrf_scan.search.surface import OCCLUDED, SEEN_THROUGH, UNMEASURED


def test_real_pairs_are_among_the_scenes() -> None:
    if not REAL:
        pytest.skip(f"needs the real pairs, which are not part of the repository: nothing in {PAIRS}")
    assert set(SCENES) > {path.name for path in REAL}


@pytest.mark.parametrize("name", SCENES)
def test_leftover_is_that_of_the_eager_module(name: str) -> None:
    seen = survey(name)
    expected = eager.Leftover.of(seen.source, seen.target, seen.background)
    for side, surface in (("source", seen.source), ("target", seen.target)):
        found, sight = getattr(seen.leftover, side), getattr(expected, f"{side}_sight")
        assert_close(torch.from_numpy(found.residual), getattr(expected, side))
        assert_close(torch.from_numpy(found.units), eager.point_units(surface))
        assert found.piece.tolist() == eager.pieces(surface).tolist()
        for answer, flags in ((SEEN_THROUGH, sight.seen_through), (OCCLUDED, sight.occluded), (UNMEASURED, sight.unmeasured)):
            assert (found.sight == answer).tolist() == flags.tolist()
    assert seen.leftover.unit == pytest.approx(float(unit_length(seen.source, seen.target)), rel=1e-12)


@pytest.mark.parametrize("name", SCENES)
def test_the_same_hypotheses_in_the_same_order(name: str) -> None:
    seen = survey(name)
    expected = eager.hypothesise(seen.source, seen.target, seen.background, seen.dt)
    assert seen.as_eager.members.tolist() == expected.members.tolist()
    assert_close(seen.as_eager.motions, expected.motions, tolerance=1e-8)  # six iterations of rounding
    assert (np.diff(seen.found.group) >= 0).all()


def test_scenes_hold_hypotheses() -> None:
    assert min(len(survey(name).found.motions) for name in ("street", "room", "closed")) > 20


def test_ends_of_a_set_that_leads_round_the_seam() -> None:
    sets = [[2, 3, 4], [0, 1, 8, 9], [9], [*range(10)], [0, 9]]
    members = torch.tensor([[i in points for i in range(10)] for points in sets])
    first, last = eager.ends(members)
    assert [ends(np.array(points), 10) for points in sets] == list(zip(first.tolist(), last.tolist(), strict=True))


def test_nothing_within_reach() -> None:
    target = survey("street").leftover.target
    boxes = target.field.scan.boxes
    x, y = boxes.points[5]
    assert nearest_within(boxes, x, y, -1, 1e-6) == (0.0, 5)
    assert nearest_within(boxes, x + 1000, y, 5, 1.0) == (1.0, -1)
    assert residual_units(boxes, target.units, eager.TRUNCATION * target.units.max(), x + 1000, y, 3) == (eager.TRUNCATION, -1)
