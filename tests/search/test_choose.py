"""The start of one pair from what was surveyed: who is considered, how sure, where he may be, and who is associated with whom."""

import numpy as np
import pytest
import torch
from support import assert_close
from surveyed import SCENES, Surveyed, survey

from torchcrf_scan.batch import ScanPairBatch
from torchcrf_scan.features.potentials import resolution
from torchcrf_scan.geometry import se2
from torchcrf_scan.inference.start import FARTHEST, beyond_reach, nearest_association
from torchcrf_scan.loops.jit import Array
from torchcrf_scan.loops.pair import Pair, PairStart
from torchcrf_scan.loops.rigid import compose
from torchcrf_scan.search.accept import probabilities_of, score_of, select
from torchcrf_scan.search.choose import CONSIDERED, FEWEST_POINTS, OF_SIDE, choose_movers, judge
from torchcrf_scan.search.groups import Groups
from torchcrf_scan.search.hypotheses import members_of
from torchcrf_scan.search.leftover import OPEN
from torchcrf_scan.search.score import HypothesisScore
from torchcrf_scan.search.sides import Sides

SCORE = score_of(HypothesisScore().double())


def batch_of(pair: Pair) -> ScanPairBatch:
    """The same as tensors."""
    source, target, guess = (torch.from_numpy(values)[None] for values in (pair.source, pair.target, pair.initial_motion))
    masks = (torch.ones(of.shape[:2], dtype=torch.bool) for of in (source, target))
    closed = torch.tensor([pair.source_closed]), torch.tensor([pair.target_closed])
    dt, noise = (torch.tensor([value], dtype=torch.float64) for value in (pair.dt, pair.noise))
    return ScanPairBatch(source, target, *masks, *closed, dt, noise, guess)


def sides_of(name: str) -> Sides:
    """The sides that slide, and in the street a made-up one as well: the first points of the scan."""
    at = survey(name)
    sides = at.sides
    if name != "street":
        return sides
    motion, members = compose(np.array([0.0, 0.5, 0.0]), at.background), np.arange(20)
    groups = Groups(np.append(sides.groups.start, sides.groups.start[-1] + 20), np.append(sides.groups.members, members))
    return Sides(np.concatenate([sides.motions, motion[None]]), groups)


def give_sides(reach: Array, at: Surveyed, sides: Sides, movers: Array) -> None:
    """What moves as a side does has it within reach, and the background has not."""
    for s, motion in enumerate(sides.motions):
        members = sides.groups.members[sides.groups.start[s] : sides.groups.start[s + 1]]
        points = at.pair.source[members]
        for c, mover in enumerate(movers, 1):
            apart = np.linalg.norm(se2.apply(motion, points) - se2.apply(mover, points), axis=-1).mean()
            if apart <= OPEN * at.leftover.unit:
                reach[members, 0], reach[members, c] = FARTHEST, 0.0


def chosen(name: str, clusters: int) -> PairStart:
    at = survey(name)
    unit = float(resolution(batch_of(at.pair))[0])
    return choose_movers(at.leftover, at.found, at.features, sides_of(name), at.pair.initial_motion, SCORE, clusters, unit)


@pytest.mark.parametrize("name", SCENES)
@pytest.mark.parametrize("clusters", [1, 6])
def test_the_start_is_put_together_from_what_was_found(name: str, clusters: int) -> None:
    at, start = survey(name), chosen(name, clusters)
    batch, N = batch_of(at.pair), len(at.pair.source)
    is_enough = at.pair.fewest_points >= FEWEST_POINTS
    sides = sides_of(name)
    found, sure = judge(at.found, at.features, sides, SCORE)
    assert_close(sure, np.append(probabilities_of(SCORE, at.features), np.full(len(sides.motions), OF_SIDE)))
    movers = select(at.leftover, found, sure, CONSIDERED, clusters - 1) if is_enough else np.zeros(0, np.int64)
    G = len(movers)
    motions = np.tile(at.pair.initial_motion, (clusters, 1))
    motions[0] = at.background if is_enough else motions[0]
    motions[1 : G + 1] = found.motions[movers]
    assert_close(start.motions, motions)
    assert start.active.tolist() == [True, *(sure[movers] >= SCORE.threshold), *[False] * (clusters - 1 - G)]
    assert_close(start.log_odds, [np.inf, *np.log(sure[movers] / (1 - sure[movers])), *[-np.inf] * (clusters - 1 - G)])
    assert_close(start.target_tangents, at.target.tangent if is_enough else np.zeros_like(at.pair.target))
    members = np.zeros((1, clusters, N), np.bool_)
    members[0, 1 : G + 1] = members_of(found, movers, N)
    reach = beyond_reach(batch.source, torch.from_numpy(members), resolution(batch))
    if is_enough:
        give_sides(reach[0].numpy(), at, sides, motions[1 : G + 1])
    assert_close(start.reach, reach[0], tolerance=1e-9)
    assert (start.reach <= 0).tolist() == (reach[0] <= 0).tolist()
    given = torch.from_numpy(start.motions)[None], torch.from_numpy(start.active)[None], reach
    assert start.association.tolist() == nearest_association(batch, *given)[0].tolist()
    assert not any(np.isnan(values).any() for values in start)


def test_scenes_hold_movers() -> None:
    assert sum(int(chosen(name, 6).active.sum()) for name in ("street", "room", "closed")) > 5
