"""Input channels of the encoder: a point's surroundings in its own scan, and the other scan aligned by the present motions.

All channels are free of scale: lengths in units of beam footprint at the point's range and noise; angles in beam steps. All
are looked up along the beams, so the cost is linear in the points (design finding 15).
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from torchcrf_scan.batch import ScanPairBatch
from torchcrf_scan.encoder.aligned_loops import aligned_inputs_of_pairs
from torchcrf_scan.encoder.channels import BESIDE, FARTHEST, LARGEST_TURN, LONGEST_CHORD, NEAR, NOWHERE, PROFILE, WINDOW
from torchcrf_scan.fast.choice import can_run
from torchcrf_scan.features.free_space import Sweep, bearing_in, look, rising_turn
from torchcrf_scan.geometry import se2
from torchcrf_scan.inference.start import Start
from torchcrf_scan.loops.circle import LEAST_TURN
from torchcrf_scan.loops.pair import pair_of
from torchcrf_scan.search.pairs import start_arrays


@dataclass(frozen=True, slots=True)
class Side:
    """One scan and the motions that carry it into the other's frame.

    Attributes:
        points: (B, P, 2), mask: (B, P), sweep: of the scan. other, other_sweep: (B, Q, 2) points and sweep of the other scan.
        motions: (B, C, 3). log_odds: (B, C) of the existence of each mover.
        reach: (B, P, C) of `Start`, of the source; None: of the target, by distance, `NEAR`.
    """

    points: Tensor
    mask: Tensor
    sweep: Sweep
    other: Tensor
    other_sweep: Sweep
    motions: Tensor
    log_odds: Tensor
    reach: Tensor | None


@torch.no_grad()
def aligned_inputs(batch: ScanPairBatch, start: Start, backend: str = "auto", *, both: bool = True) -> tuple[Tensor, ...]:
    """(B, N, F) the `CHANNELS` of the source points, and with `both` (B, M, F) of the target points; 0 in the padding.

    start: output of `initialise`. backend: see `InferenceConfig`.
    """
    if can_run(backend, batch.source.device):
        pairs = [pair_of(batch, b) for b in range(len(batch))]
        starts = [start_arrays(start, b, pair) for b, pair in enumerate(pairs)]
        lengths = batch.source.shape[1], batch.target.shape[1]
        return tuple(of.to(batch.source) for of in aligned_inputs_of_pairs(pairs, starts, lengths, both=both))
    here = torch.zeros_like(batch.target_origin)
    source = Sweep.of(batch.source, batch.source_mask, batch.source_closed, batch.range_noise, here)
    target = Sweep.of(batch.target, batch.target_mask, batch.target_closed, batch.range_noise, batch.target_origin)
    is_there = torch.where(start.active, torch.inf, -torch.inf).to(start.motions)
    log_odds = is_there if start.log_odds is None else start.log_odds
    motions, back = start.motions, se2.inverse(start.motions)
    reach = motions.new_zeros(*batch.source.shape[:2], motions.shape[1]) if start.reach is None else start.reach
    sides = [Side(batch.source, batch.source_mask, source, batch.target, target, motions, log_odds, reach)]
    if both:
        sides.append(Side(batch.target, batch.target_mask, target, batch.source, source, back, log_odds, None))
    return tuple(channels_of(side) for side in sides)


def channels_of(side: Side) -> Tensor:
    """(B, P, F) the channels of one scan's points."""
    own, unit = own_channels(side)
    moved = se2.apply(side.motions, side.points[:, None])  # (B, C, P, 2)
    across, distance = cross_channels(side, moved, unit)
    sight = look(side.other_sweep, moved[:, 0])
    best, sure = best_mover(side, distance)
    background = distance[:, 0]
    rest = [sight.seen_through, sight.hidden, torch.log1p(best), sure, torch.log1p(background) - torch.log1p(best)]
    channels = torch.cat([own, across, torch.stack([*rest, torch.ones_like(best)], -1)], -1)
    return torch.where(side.mask[..., None], channels, 0.0)


def own_channels(side: Side) -> tuple[Tensor, Tensor]:
    """(B, P, 8) channels from the scan itself, and (B, P) the unit of length at each point."""
    sweep = side.sweep
    ranges = torch.where(side.mask, sweep.ranges, 0.0)
    bearings = torch.where(side.mask, sweep.bearings, 0.0)
    unit = (sweep.noise[:, None] + ranges * sweep.step[:, None]).clamp(min=1e-9)
    place = torch.arange(ranges.shape[1], device=ranges.device).expand_as(side.mask)
    found = []
    for k in BESIDE:
        beside, there = along_scan(sweep, place + k)
        found.append(torch.where(there, squash((ranges.gather(1, beside) - ranges) / unit), NOWHERE))
    for k in (-1, 1):
        beside, there = along_scan(sweep, place + k)
        turn = rising_turn(k * (bearings.gather(1, beside) - bearings)) / sweep.step[:, None]
        found.append(torch.log1p(torch.where(there, (turn - 1).clamp(0.0, LARGEST_TURN), LARGEST_TURN)))
    found.append(torch.log(unit / sweep.noise[:, None].clamp(min=1e-9)).clamp(max=8.0) / 2 - 1)
    usual = torch.where(side.mask, ranges, torch.nan).nanmedian(1, keepdim=True).values.nan_to_num(nan=1.0)
    found.append(torch.log(ranges.clamp(min=1e-9) / usual.clamp(min=1e-9)).clamp(-3.0, 3.0))
    return torch.stack(found, -1), unit


def cross_channels(side: Side, moved: Tensor, unit: Tensor) -> tuple[Tensor, Tensor]:
    """(B, P, 10) channels from the other scan under the background's motion, and (B, C, P) units to its nearest point.

    moved: (B, C, P, 2) points under every motion. unit: (B, P).
    """
    B, C, P = moved.shape[:3]
    sweep = side.other_sweep
    bearing = bearing_in(sweep, moved.flatten(1, 2) - sweep.origin[:, None])  # (B, C P)
    after = torch.searchsorted(sweep.bearings, bearing - LEAST_TURN)  # returns on a beam, up to rounding, are not beyond it
    beam, there = along_scan(sweep, after[..., None] + torch.arange(-WINDOW, WINDOW, device=after.device))  # (B, C P, 2 W)
    beam, there = beam.view(B, C, P, -1), there.view(B, C, P, -1)
    arms = side.other.gather(1, beam.view(B, -1, 1).expand(-1, -1, 2)).view(B, C, P, -1, 2) - moved[..., None, :]
    distance = torch.linalg.vector_norm(arms, dim=-1) / unit[:, None, :, None]
    nearest = distance.masked_fill(~there, FARTHEST).clamp(max=FARTHEST).amin(-1)

    arms, beam, there, bearing = arms[:, 0], beam[:, 0], there[:, 0], bearing.view(B, C, P)[:, 0]
    chord = arms[..., 1:, :] - arms[..., :-1, :]
    share = (-(arms[..., :-1, :] * chord).sum(-1) / (chord**2).sum(-1).clamp(min=1e-12)).clamp(0.0, 1.0)
    gap = torch.linalg.vector_norm(arms[..., :-1, :] + share[..., None] * chord, dim=-1) / unit[..., None]
    is_surface = there[..., 1:] & there[..., :-1] & (torch.linalg.vector_norm(chord, dim=-1) < LONGEST_CHORD * unit[..., None])
    surface = torch.minimum(gap.masked_fill(~is_surface, FARTHEST).amin(-1), nearest[:, 0])

    middle = slice(WINDOW - PROFILE, WINDOW + PROFILE)
    ranges = sweep.ranges.gather(1, beam[..., middle].flatten(1)).view(B, P, -1)
    own = torch.linalg.vector_norm(moved[:, 0] - sweep.origin[:, None], dim=-1, keepdim=True)
    profile = torch.where(there[..., middle], squash((ranges - own) / unit[..., None]), NOWHERE)
    step = sweep.step[:, None]
    bearings = sweep.bearings.gather(1, beam[..., WINDOW - 1 : WINDOW + 1].flatten(1)).view(B, P, 2)
    turns = torch.stack([rising_turn(bearing - bearings[..., 0]), rising_turn(bearings[..., 1] - bearing)], -1) / step[..., None]
    turns = torch.where(there[..., WINDOW - 1 : WINDOW + 1], turns, LARGEST_TURN).clamp(max=LARGEST_TURN)
    return torch.cat([profile, torch.log1p(turns), torch.log1p(torch.stack([nearest[:, 0], surface], -1))], -1), nearest


def best_mover(side: Side, distance: Tensor) -> tuple[Tensor, Tensor]:
    """(B, P) units to the other scan under the best mover, and the probability of the most probable mover near the point.

    distance: (B, C, P) units under every motion.
    """
    distance = distance[:, 1:]
    reach = distance < NEAR if side.reach is None else side.reach[..., 1:].mT <= 0
    there = reach & (side.log_odds[:, 1:, None] > -torch.inf)
    sure = torch.sigmoid(side.log_odds[:, 1:, None]) * torch.exp(-distance / 2) * there
    none = distance.new_zeros(distance.shape[0], 1, distance.shape[2])
    distance = torch.cat([distance.masked_fill(~there, FARTHEST), none + FARTHEST], 1)
    return distance.amin(1), torch.cat([sure, none], 1).amax(1)


def along_scan(sweep: Sweep, place: Tensor) -> tuple[Tensor, Tensor]:
    """Real points at indices (B, ...) along a scan, wrapped round a closed one, and whether they exist."""
    extra = (1,) * (place.dim() - 1)
    count = sweep.count.view(-1, *extra)
    closed = sweep.closed.view(-1, *extra) & (count > 0)
    there = ((place >= 0) & (place < count)) | closed
    last = (count - 1).clamp(min=0)
    return torch.where(closed, place % (last + 1), torch.minimum(place.clamp(min=0), last)), there


def squash(values: Tensor) -> Tensor:
    """Signed compression: nearly linear for small values, logarithmic for large ones."""
    return torch.asinh(values) / 2
