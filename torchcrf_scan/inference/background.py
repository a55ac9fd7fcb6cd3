"""The start of the background's motion (InitialiseRT, first half): a pool of registrations, the best by what it leaves open."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from torchcrf_scan.geometry import se2
from torchcrf_scan.inference.registration import nearest_points, register
from torchcrf_scan.inference.surface import Surface, carry_back, look_along

COARSE_POINTS = 120
KEPT = 10  # hypotheses worth a refinement
TRUNCATION = 3.0  # a residual of three units is as bad as any
CONTRADICTION = 3.0  # units charged for a point that the other scan sees through (design finding 17)
UNSEEN = 1.5  # units charged for a point of which the other scan says nothing; else flying off the map would be free
LENGTH_SHARE = (0.25, 4.0)  # a point stands for at least, at most this many median lengths of surface


def unit_length(source: Surface, target: Surface) -> Tensor:
    """() metres: the size of an ordinary registration error, from spacing and noise alone. All gates are multiples of it."""
    return torch.cat([source.spacing, target.spacing]).median() / 2 + 2 * torch.maximum(source.noise, target.noise)


def _one_way(moved: Tensor, surface: Surface, other: Surface) -> Tensor:
    """(H,) truncated residual of `surface`'s points, carried to (H, P, 2), in the other scan; per length, see-through charged."""
    distance, index = nearest_points(moved, other)
    unit = other.spacing[index] / 2 + 2 * other.noise
    residual = (distance / unit).clamp(max=TRUNCATION)
    sight = look_along(moved, other)
    usual = surface.length.median()
    length = (surface.length / usual.clamp(min=1e-6)).clamp(*LENGTH_SHARE)
    counted = ~(sight.occluded | sight.unmeasured) | (residual < TRUNCATION)
    unexplained = torch.where(sight.seen_through & (residual >= TRUNCATION), CONTRADICTION, 0.0) + residual
    return (length * torch.where(counted, unexplained, UNSEEN)).sum(-1) / length.sum()


def background_cost(motions: Tensor, source: Surface, target: Surface) -> Tensor:
    """(H,) what every motion leaves unexplained when the whole scene is taken as static, both ways (design finding 17)."""
    forward = _one_way(se2.apply(motions, source.points), source, target)
    return forward + _one_way(carry_back(motions, target.points), target, source)


def start_grid(source: Surface, target: Surface, guess: Tensor) -> Tensor:
    """(H, 3) starts round the guess: turns and shifts in shares of the scene's size."""
    reach = 0.12 * torch.cat([source.ranges, target.ranges]).median()
    turns = torch.tensor([0.0, 0.12, -0.12, 0.3, -0.3])
    shifts = torch.tensor([[0.0, 0.0], [1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0], [2.5, 0.0], [-2.5, 0.0]])
    grid = torch.cat([turns.repeat_interleave(len(shifts))[:, None], shifts.repeat(len(turns), 1) * reach.cpu()], dim=1)
    return se2.compose(grid.to(guess), guess.expand(len(grid), 3))


def distinct(motions: Tensor, cost: Tensor, near: Tensor, count: int) -> Tensor:
    """Index of the `count` cheapest motions of which no two are closer than `near` (metres; radians weigh ten units of it)."""
    order = cost.argsort()
    turn, shift = se2.distance(motions[order][:, None], motions[order][None])
    alike = (shift < near) & (turn < 0.02)
    kept: list[int] = []
    for row, is_like in enumerate(alike.tolist()):
        if not any(is_like[k] for k in kept):
            kept.append(row)
        if len(kept) == count:
            break
    return order[kept]


def background_pool(source: Surface, target: Surface, guess: Tensor, extra: Tensor | None = None) -> Tensor:
    """(H, 3) refined hypotheses of the background's motion, cheapest first."""
    unit = unit_length(source, target)
    u = float(unit)
    stride = max(1, math.ceil(len(source) / COARSE_POINTS))
    coarse = source.points[::stride]
    weights = source.length[::stride].clamp(min=float(source.length.median()) / 4, max=float(source.length.median()) * 4)
    starts = start_grid(source, target, guess)
    if extra is not None:
        starts = torch.cat([starts, extra])
    pool = register(
        coarse, weights, target, starts, [8 * u, 8 * u, 6 * u, 6 * u, 4 * u, 4 * u, 3 * u, 2 * u], [1.0] * 4 + [0.3] * 4
    )
    cost = background_cost(pool, source, target)
    pool = pool[distinct(pool, cost, unit, 6)]
    by_segment = segment_hypotheses(source, target, pool[:3], u)
    pool = torch.cat([pool, by_segment])
    pool = pool[distinct(pool, background_cost(pool, source, target), unit, KEPT)]
    pool = refine(polish(pool, source, target, u), source, target, u)
    cost = background_cost(pool, source, target)
    return pool[distinct(pool, cost, unit / 2, len(pool))]


def segment_hypotheses(source: Surface, target: Surface, motions: Tensor, unit: float, smallest: int = 6, most: int = 12) -> Tensor:
    """Registers every larger segment alone: where most returns belong to a mover, some segment still is background."""
    sizes = torch.bincount(source.segment)
    large = sizes.argsort(descending=True)[:most]
    large = large[sizes[large] >= smallest]
    membership = (source.segment[None] == large[:, None]).to(source.points)  # (S, P)
    starts = motions.repeat(len(large), 1)
    weights = membership.repeat_interleave(len(motions), 0)
    return register(source.points, weights, target, starts, [6 * unit, 4 * unit, 3 * unit, 2 * unit], [1.0, 1.0, 0.3, 0.3])


def refine(motions: Tensor, source: Surface, target: Surface, unit: float) -> Tensor:
    """Point-to-line registration of the whole scan from good starts: the mean of source on target and target on source."""
    gates, along = [unit * g for g in (2.0, 1.5, 1.0, 1.0, 1.0, 1.0)], [0.03] * 6
    forward = register(source.points, torch.ones_like(source.ranges), target, motions, gates, along)
    backward = se2.inverse(register(target.points, torch.ones_like(target.ranges), source, se2.inverse(motions), gates, along))
    halfway = torch.cat([se2.wrap(backward[..., :1] - forward[..., :1]), backward[..., 1:] - forward[..., 1:]], dim=-1) / 2
    return forward + halfway


def polish(motions: Tensor, source: Surface, target: Surface, unit: float) -> Tensor:
    """Draws hypotheses that are still a few gates off to where `refine` can take over."""
    usual = float(source.length.median())
    weights = source.length.clamp(min=usual / 4, max=usual * 4)
    return register(source.points, weights, target, motions, [4 * unit, 3 * unit, 2 * unit, 1.5 * unit], [0.1] * 4)
