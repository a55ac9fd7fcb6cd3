"""The start of the background's motion (InitialiseRT, first half): a pool of registrations, the best by what it leaves open."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from torchcrf_scan.geometry import se2
from torchcrf_scan.inference.registration import register, register_both, surface_residual
from torchcrf_scan.inference.surface import Surface, carry_back, look_along

COARSE_POINTS = 120
SEGMENT_POINTS = 24
COARSE = 6  # hypotheses of the coarse search that are kept; the segments are registered from the best three
SLIDES = 10  # steps each way along the walls, for all of them
SLIDE_STEP = 4.0  # units
SLID = 6  # kept of these
KEPT = 12  # so many of all are worth a polish,
REFINED = 5  # and so many of the polished ones a refinement
TRUNCATION = 3.0  # a residual of three units is as bad as any
CONTRADICTION = 3.0  # units charged for a point that the other scan sees through (design finding 17)
TRUSTED = 2.5  # units both ways; a guess that leaves no more unexplained once it is refined has led to the background,
FOLLOWED = 8.0  # units; if refining has moved half of the points no farther than this
UNSEEN = 1.5  # units charged for a point of which the other scan says nothing; else flying off the map would be free
LENGTH_SHARE = (0.25, 4.0)  # median lengths of surface that a point stands for at least and at most, where it pulls,
COST_SHARE = (0.1, 10.0)  # and where motions are compared
GRID_REACH = 0.12  # of the usual range: the unit of the grid's shifts
GRID_SHIFTS = ((0.0, 0.0), (1.0, 0.0), (-1.0, 0.0), (0.0, 1.0), (0.0, -1.0), (2.5, 0.0), (-2.5, 0.0))
GRID_TURNS = (0.0, 0.12, -0.12, 0.3, -0.3)  # radians
ALIKE_TURN = 0.02  # radians up to which two motions may be the same
SMALLEST_SEGMENT, SEGMENTS = 6, 12  # points of a segment that is registered alone, and how many segments are
# Gates in units (of `refine`: of the residual), and how much of the residual along the surface counts, one per iteration.
COARSE_GATES, COARSE_ALONG = (8.0, 8.0, 6.0, 6.0, 4.0, 4.0, 3.0, 2.0), (1.0,) * 4 + (0.3,) * 4
SEGMENT_GATES, SEGMENT_ALONG = (6.0, 4.0, 3.0, 2.0), (1.0, 1.0, 0.3, 0.3)
POLISH_GATES, POLISH_ALONG = (4.0, 3.0, 2.0, 1.5), (0.1,) * 4
REFINE_GATES, REFINE_ALONG = (3.0, 2.0, 2.0, 1.5, 1.5, 1.5), (0.03,) * 6


def unit_length(source: Surface, target: Surface) -> Tensor:
    """() metres: the size of an ordinary registration error, from spacing and noise alone. All gates are multiples of it."""
    return torch.cat([source.spacing, target.spacing]).median() / 2 + 2 * torch.maximum(source.noise, target.noise)


def _share(length: Tensor, low: float, high: float) -> Tensor:
    """(P,) metres of surface in units of their median, clipped."""
    return (length / length.median().clamp(min=1e-6)).clamp(low, high)


def _one_way(moved: Tensor, length: Tensor, other: Surface, slack: float) -> Tensor:
    """(H,) truncated residual of (H, P, 2) moved points, standing for (P,) lengths, in the other scan; see-through charged."""
    residual = (surface_residual(moved, other)[0] / slack).clamp(max=TRUNCATION)
    sight = look_along(moved, other)
    is_far = residual >= TRUNCATION
    left_open = torch.where(sight.seen_through & is_far, CONTRADICTION, 0.0) + residual
    left_open = torch.where((sight.occluded | sight.unmeasured) & is_far, UNSEEN, left_open)
    share = _share(length, *COST_SHARE)
    return (share * left_open).sum(-1) / share.sum()


def background_cost(motions: Tensor, source: Surface, target: Surface, most: int | None = None, slack: float = 1.0) -> Tensor:
    """(H,) what every motion leaves unexplained when the whole scene is taken as static, both ways (design finding 17).

    Args:
        most: about so many points of either scan are looked at, None: all.
        slack: factor on what counts as one unit of residual, for motions that are not registered yet.
    """
    ahead, behind = (slice(None, None, max(1, math.ceil(len(scan) / (most or len(scan))))) for scan in (source, target))
    forward = _one_way(se2.apply(motions, source.points[ahead]), source.length[ahead], target, slack)
    return forward + _one_way(carry_back(motions, target.points[behind]), target.length[behind], source, slack)


def start_grid(source: Surface, target: Surface) -> Tensor:
    """(H, 3) turns and shifts in shares of the scene's size."""
    reach = GRID_REACH * torch.cat([source.ranges, target.ranges]).median()
    turns, shifts = torch.tensor(GRID_TURNS), torch.tensor(GRID_SHIFTS)
    return torch.cat([turns.repeat_interleave(len(shifts))[:, None], shifts.repeat(len(turns), 1) * reach.cpu()], 1).to(
        source.points
    )


def distinct(motions: Tensor, cost: Tensor, near: Tensor, count: int) -> Tensor:
    """Index of the `count` cheapest motions of which no two are closer than `near` (metres; radians weigh ten units of it)."""
    order = cost.argsort()
    turn, shift = se2.distance(motions[order][:, None], motions[order][None])
    alike = (shift < near) & (turn < ALIKE_TURN)
    kept: list[int] = []
    for row, is_like in enumerate(alike.tolist()):
        if not any(is_like[k] for k in kept):
            kept.append(row)
        if len(kept) == count:
            break
    return order[kept]


def background_pool(source: Surface, target: Surface, guess: Tensor, extra: Tensor | None = None) -> Tensor:
    """(H, 3) hypotheses of the background's motion, cheapest first.

    Every stage's motions stay in the pool: where a mover supplies most returns, the next stage may lead away from the truth.

    Args:
        guess: (3,) one more place to search from, and one more hypothesis; so is the identity. extra: (H, 3) more starts.
    """
    unit = unit_length(source, target)
    grid = start_grid(source, target)
    guesses = torch.stack([torch.zeros_like(guess), guess]) if guess.any() else guess[None]
    given = guesses if extra is None else torch.cat([guesses, extra])
    starts = se2.compose(grid.repeat(len(guesses), 1), guesses.repeat_interleave(len(grid), 0))
    coarse = search_coarsely(torch.cat([starts, given]), source, target, float(unit))
    coarse = coarse[distinct(coarse, background_cost(coarse, source, target, most=COARSE_POINTS), unit, COARSE)]
    slid = slide(torch.cat([coarse, guesses]), target, unit)
    slid = slid[distinct(slid, background_cost(slid, source, target, most=COARSE_POINTS, slack=SLIDE_STEP), unit, SLID)]
    pool = torch.cat([coarse, given, slid, segment_hypotheses(source, target, coarse[:3], float(unit))])
    pool = pool[distinct(pool, background_cost(pool, source, target), unit, KEPT)]
    pool = torch.cat([pool, polish(pool, source, target, float(unit))])
    cost = background_cost(pool, source, target)
    refined = refine(pool[distinct(pool, cost, unit / 2, REFINED)], source, target)
    pool, cost = torch.cat([pool, refined]), torch.cat([cost, background_cost(refined, source, target)])
    return pool[distinct(pool, cost, unit / 2, len(pool))]


def follow(guess: Tensor, source: Surface, target: Surface) -> Tensor | None:
    """(3,) the background's motion near a guess (3,), as odometry or the last motion gives it; None where it explains too little.

    Spares the search: a guess within 20 cm and 3 degrees nearly always leads to the motion that the search would find.
    """
    unit = unit_length(source, target)
    motion = refine(polish(guess[None], source, target, float(unit)), source, target)[0]
    led = torch.linalg.vector_norm(se2.apply(motion, source.points) - se2.apply(guess, source.points), dim=-1).median()
    is_led = bool(led < FOLLOWED * unit) and bool(background_cost(motion[None], source, target) < TRUSTED)
    return motion if is_led else None


def search_coarsely(motions: Tensor, source: Surface, target: Surface, unit: float) -> Tensor:
    """Registers some of the source's points from afar."""
    some = slice(None, None, math.ceil(len(source) / COARSE_POINTS))
    gates = [unit * gate for gate in COARSE_GATES]
    return register(source.points[some], _share(source.length, *LENGTH_SHARE)[some], target, motions, gates, COARSE_ALONG)


def slide(motions: Tensor, target: Surface, unit: Tensor) -> Tensor:
    """(H S, 3) motions displaced along the way that most of the target's surface runs: there, registration is slow or blind."""
    x, y = target.tangent.unbind(-1)
    heading = torch.atan2((2 * x * y).sum(), (x**2 - y**2).sum()) / 2  # the mean of axes, which have no sign
    steps = torch.arange(-SLIDES, SLIDES + 1, device=motions.device)
    shift = (SLIDE_STEP * unit * steps[steps != 0])[:, None] * torch.stack([heading.cos(), heading.sin()])  # (S, 2)
    turn = motions[:, None, :1].expand(-1, len(shift), 1)
    return torch.cat([turn, motions[:, None, 1:] + shift], dim=-1).flatten(0, 1)


def segment_hypotheses(source: Surface, target: Surface, motions: Tensor, unit: float) -> Tensor:
    """Registers every larger segment alone: where most returns belong to a mover, some segment still is background."""
    sizes = torch.bincount(source.segment)
    large = sizes.argsort(descending=True)[:SEGMENTS]
    large = large[sizes[large] >= SMALLEST_SEGMENT]
    members = (source.segment[None] == large[:, None]).sort(descending=True, stable=True).indices  # (S, P), members come first
    spread = torch.arange(SEGMENT_POINTS, device=members.device) * sizes[large, None] // SEGMENT_POINTS  # (S, L)
    points = source.points[members.gather(1, spread)].repeat_interleave(len(motions), 0)  # (S H, L, 2)
    starts = motions.repeat(len(large), 1)
    gates = [unit * gate for gate in SEGMENT_GATES]
    return register(points, torch.ones_like(points[..., 0]), target, starts, gates, SEGMENT_ALONG)


def polish(motions: Tensor, source: Surface, target: Surface, unit: float) -> Tensor:
    """Draws hypotheses that are still a few gates off to where `refine` can take over."""
    gates = [unit * gate for gate in POLISH_GATES]
    return register(source.points, _share(source.length, *LENGTH_SHARE), target, motions, gates, POLISH_ALONG)


def refine(motions: Tensor, source: Surface, target: Surface) -> Tensor:
    """Point-to-line registration of the whole scans on each other, from good starts, by the residual that the choice goes by."""
    return register_both(source, target, motions, REFINE_GATES, REFINE_ALONG)
