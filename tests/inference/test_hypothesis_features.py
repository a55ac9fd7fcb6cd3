import math

import torch
from torch import Tensor
from torchcrf_scan.inference.hypotheses import Hypotheses
from torchcrf_scan.inference.hypothesis_features import hypothesis_features
from torchcrf_scan.inference.surface import Surface

from torchcrf_scan.search.score import FEATURES

NOISE = torch.tensor(0.01)
STEP = math.radians(0.5)
BEARING = torch.arange(-120, 121) * STEP
STILL = torch.zeros(3)


def scan(post: float, bearing: Tensor = BEARING) -> Surface:
    """A round wall 8 m away and a post's front, 0.4 m wide, 4 m away at the bearing `post`."""
    ranges = torch.where((bearing - post).abs() < 0.05, 4.0, 8.0)
    return Surface.of(torch.stack([ranges * bearing.cos(), ranges * bearing.sin()], dim=-1), NOISE, False)


def features(source: Surface, target: Surface, turn: float, members: Tensor) -> dict[str, float]:
    motion = torch.tensor([turn, 0.0, 0.0])
    row = hypothesis_features(Hypotheses(motion[None], members[None]), source, target, STILL)[0]
    return dict(zip(FEATURES, row.tolist(), strict=True))


def test_a_post_that_moved_stands_out_and_has_no_excuse() -> None:
    source = scan(-0.2)
    found = features(source, scan(0.1), 0.3, source.ranges < 5)
    for name in ("stands_out", "landing_stands_out", "unexcused", "landing_unexcused", "unexcused_both", "share_of_piece"):
        assert found[name] > 0.8, name
    assert found["landing_occluded_before"] == 0
    assert found["fair_gain"] > math.log1p(10)


def test_the_wall_beside_a_post_does_not_stand_out() -> None:
    source = scan(0.0)
    beside = (source.bearings > source.bearings.mean() + 0.05) & (source.bearings < source.bearings.mean() + 0.2)
    found = features(source, source, 0.3, beside)
    assert found["stands_out"] < -0.4
    assert found["share_of_piece"] < 0.5
    assert found["fair_gain"] == 0


def test_what_the_other_scan_does_not_look_at_needs_no_mover() -> None:
    """The post leaves the view: its points are open, and that is all there is to say."""
    source = scan(-0.9)
    target = scan(9.0, BEARING[BEARING > -0.7])
    found = features(source, target, 0.6, source.ranges < 5)
    assert found["open_before"] == 1
    assert found["unexcused"] == found["unexcused_both"] == 0


def test_what_was_hidden_before_is_no_proof_of_a_mover() -> None:
    """The wall that the post hid in the source is new in the target."""
    source, target = scan(0.0), scan(9.0)
    members = (source.bearings - source.bearings.mean() + 0.2).abs() < 0.04
    found = features(source, target, 0.2, members)
    assert found["landing_occluded_before"] > 0.9
    assert found["landing_unexcused"] == 0
