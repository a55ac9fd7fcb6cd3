"""What many tests share: one comparison with one tolerance table, and scans made from a seed."""

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

# Where the weights of the paper's features are among all; between them stand the extensions' (`features.scales`).
PAPER_ASSOCIATION = [*range(14), *range(19, 23)]
PAPER_CLUSTERING = [*range(4), *range(13, 21)]
PAPER_WEIGHTS = [*PAPER_ASSOCIATION, *(23 + k for k in PAPER_CLUSTERING)]  # of both chains in a row
TOLERANCE = {torch.float32: 1e-5, torch.float64: 1e-9}  # relative and absolute


def assert_close(actual: Any, expected: Any, *, tolerance: float | None = None) -> None:
    """Same shape, same infinities and NaN, and values within the tolerance of `actual`'s dtype (exact for whole numbers)."""
    actual = actual if isinstance(actual, Tensor) else torch.from_numpy(np.array(actual))
    within = TOLERANCE.get(actual.dtype, 0.0) if tolerance is None else tolerance
    comparable = actual.double() if actual.is_floating_point() else actual
    wanted = torch.as_tensor(expected, dtype=comparable.dtype)
    torch.testing.assert_close(comparable, wanted, rtol=within, atol=within, equal_nan=True)


def generator(seed: int) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def normal(*shape: int, seed: int = 0) -> Tensor:
    """Standard normal float64 numbers."""
    return torch.randn(*shape, generator=generator(seed), dtype=torch.float64)


def extended(weights: Tensor) -> Tensor:
    """The paper's 18, 12 or 30 weights among those of the extensions, which are 0: (23,), (21,) or (44,)."""
    places = {len(where): where for where in (PAPER_ASSOCIATION, PAPER_CLUSTERING, PAPER_WEIGHTS)}[len(weights)]
    return weights.new_zeros(places[-1] + 1).index_put((torch.tensor(places),), weights)


def paper_weights(association_seed: int, clustering_seed: int) -> tuple[Tensor, Tensor]:
    """(23,) and (21,): random weights of the features after the paper, none of the extensions'."""
    return extended(normal(18, seed=association_seed)), extended(normal(12, seed=clustering_seed))


def make_points(n: int, seed: int = 0, *, closed: bool = False) -> Tensor:
    """(n, 2) points of a scan in beam order: irregular bearings, ranges between 1 and 6 m."""
    random = torch.rand(2, n, generator=generator(seed), dtype=torch.float64)
    span = 2 * math.pi if closed else 1.2 * math.pi
    bearings = -span / 2 + span * (torch.arange(n) + 0.2 + 0.6 * random[0]) / n
    return polar(1 + 5 * random[1], bearings)


def polar(ranges: Tensor, bearings: Tensor) -> Tensor:
    """(..., 2) Cartesian points."""
    return ranges[..., None] * torch.stack([bearings.cos(), bearings.sin()], dim=-1)


def all_real(points: Tensor) -> Tensor:
    """(B, N) mask of scans without padding."""
    return torch.ones(points.shape[:-1], dtype=torch.bool)


def pad(points: Tensor, extra: int, value: float = 1e3) -> tuple[Tensor, Tensor]:
    """(B, N + extra, 2) points, the last `extra` of them rubbish, and their mask."""
    rubbish = torch.full((len(points), extra, 2), value, dtype=points.dtype)
    padded = torch.cat([points, rubbish], dim=1)
    return padded, torch.cat([all_real(points), ~all_real(rubbish)], dim=1)


def assert_slopes(answers: Callable[..., tuple[Tensor, ...]], *inputs: Tensor, step: float = 1e-6, atol: float = 1e-6) -> None:
    """`torch.autograd.gradcheck` of a long function: all backward passes at once, and so are the central differences."""
    sizes, point = [value.numel() for value in inputs], torch.cat([value.detach().flatten() for value in inputs])

    def at(row: Tensor) -> tuple[Tensor, ...]:
        return answers(*(part.view(value.shape) for part, value in zip(row.split(sizes), inputs, strict=True)))

    steps = step * torch.eye(len(point), dtype=point.dtype)
    slopes, ahead, behind = torch.func.jacrev(at)(point), torch.func.vmap(at)(point + steps), torch.func.vmap(at)(point - steps)
    for slope, after, before in zip(slopes, ahead, behind, strict=True):
        torch.testing.assert_close(slope.movedim(-1, 0), (after - before) / (2 * step), rtol=1e-3, atol=atol)


def events_of(folder: Path) -> Any:
    """All that was written for TensorBoard in a folder, an `EventAccumulator`."""
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    events = EventAccumulator(str(folder), size_guidance=dict.fromkeys(("scalars", "images", "tensors", "histograms"), 0))
    events.Reload()
    return events
