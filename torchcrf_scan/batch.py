"""Scan pairs as padded tensors with masks."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, fields, replace
from typing import TypeVar

import numpy as np
import torch
from torch import Tensor

from torchcrf_scan.errors import TorchCRFScanError
from torchcrf_scan.geometry import se2
from torchcrf_scan.scan import FARTHEST, LONGEST, Floats, Scan, ScanPair
from torchcrf_scan.tree import tensor_tree

Item = TypeVar("Item")


@tensor_tree
@dataclass(frozen=True, slots=True)
class Truth:
    """The annotation of a batch, by point.

    Attributes:
        association: (B, N) int64 target point, -1 outlier.
        cluster: (B, N) int64 0 background, k >= 1 mover, -1 outlier.
        motions: (B, G, 3) motion of every annotated cluster, NaN for clusters absent from the pair.
        known: (B, N) bool, real points that are annotated.
    """

    association: Tensor
    cluster: Tensor
    motions: Tensor
    known: Tensor


@tensor_tree
@dataclass(frozen=True, slots=True)
class ScanPairBatch:
    """B scan pairs, padded at the end of every scan.

    Attributes:
        source: (B, N, 2), target: (B, M, 2). Cartesian points, each scan in its own sensor frame, in beam order; 0 in the padding.
        source_mask: (B, N), target_mask: (B, M). True = real; a scan's real points come first.
        source_closed, target_closed: (B,) bool. The scan covers the whole circle.
        dt: (B,) seconds between the scans.
        range_noise: (B,) standard deviation of a range, metres; estimated from the scans if the sensor's is unknown.
        initial_motion: (B, 3) `T_target_source` guess (odometry); the identity if there is none.
        truth: the annotation; None unless every pair is annotated.
        target_origin: (B, 2) position of the target's sensor in the target's frame: 0 (the default) unless that frame was
            displaced.
    """

    source: Tensor
    target: Tensor
    source_mask: Tensor
    target_mask: Tensor
    source_closed: Tensor
    target_closed: Tensor
    dt: Tensor
    range_noise: Tensor
    initial_motion: Tensor
    truth: Truth | None = None
    target_origin: Tensor = field(default=None)  # type: ignore[assignment]  # never None once made

    def __post_init__(self) -> None:
        if self.target_origin is None:
            object.__setattr__(self, "target_origin", torch.zeros_like(self.initial_motion[:, 1:]))

    def __len__(self) -> int:
        return len(self.source)

    def to(self, target: torch.device | torch.dtype | str) -> ScanPairBatch:
        """The batch on another device, or with its floating-point tensors in another dtype."""

        def move(value: Tensor) -> Tensor:
            return value if isinstance(target, torch.dtype) and not value.is_floating_point() else value.to(target)

        moved = {f.name: move(getattr(self, f.name)) for f in fields(self) if f.name != "truth"}
        truth = self.truth and Truth(*(move(getattr(self.truth, f.name)) for f in fields(self.truth)))
        return ScanPairBatch(**moved, truth=truth)

    def __getitem__(self, index: slice) -> ScanPairBatch:
        """A slice of the batch, with the same padding."""
        if not isinstance(index, slice):
            raise TypeError(f"index: expected a slice, got {type(index).__name__}")
        part = {f.name: getattr(self, f.name)[index] for f in fields(self) if f.name != "truth"}
        truth = self.truth and Truth(*(getattr(self.truth, f.name)[index] for f in fields(self.truth)))
        return ScanPairBatch(**part, truth=truth)

    def select(self, index: Tensor) -> ScanPairBatch:
        """The pairs index (P,) int64, their padding cut to the longest scan among them."""
        longest = {side: max(1, int(getattr(self, f"{side}_mask")[index].sum(-1).max())) for side in ("source", "target")}
        length = {name: longest[name.removesuffix("_mask")] for name in ("source", "target", "source_mask", "target_mask")}
        part = {f.name: getattr(self, f.name)[index] for f in fields(self) if f.name != "truth"}
        part |= {name: part[name][:, :most] for name, most in length.items()}
        n = longest["source"]
        truth = self.truth and Truth(
            self.truth.association[index, :n], self.truth.cluster[index, :n], self.truth.motions[index], self.truth.known[index, :n]
        )
        return ScanPairBatch(**part, truth=truth)

    def scaled(self, factor: Tensor) -> ScanPairBatch:
        """The same scenes in another unit of length; factor: (B,) scale of each pair."""
        by_pair = factor[:, None, None]
        truth = self.truth and replace(self.truth, motions=scale_motions(self.truth.motions, factor))
        return replace(
            self,
            source=self.source * by_pair,
            target=self.target * by_pair,
            range_noise=self.range_noise * factor,
            initial_motion=scale_motions(self.initial_motion, factor),
            target_origin=self.target_origin * factor[:, None],
            truth=truth,
        )

    def displaced(self, offset: Tensor) -> ScanPairBatch:
        """The same scenes with the target expressed in another frame; `initial_motion` is left unchanged.

        Args:
            offset: (B, 3) motion of the target's points into the new frame.
        """
        truth = self.truth and replace(
            self.truth, motions=se2.compose(offset[:, None].expand_as(self.truth.motions), self.truth.motions)
        )
        return replace(
            self,
            target=torch.where(self.target_mask[..., None], se2.apply(offset, self.target), self.target),
            target_origin=se2.apply(offset, self.target_origin[:, None])[:, 0],
            truth=truth,
        )

    def without_truth(self) -> ScanPairBatch:
        """The batch without its annotation."""
        return replace(self, truth=None)

    @classmethod
    def collate(cls, pairs: Sequence[ScanPair], dtype: torch.dtype = torch.float32) -> ScanPairBatch:
        """Pads pairs into one batch, each scan to at least one (masked) point; `truth` is set if every pair is annotated.

        Raises:
            TorchCRFScanError: no pairs, or a number that overflows the dtype or is beyond what a sensor gives.
        """
        if not pairs:
            raise TorchCRFScanError("pairs: expected at least one pair, got none")
        source, source_mask = _pad_points([pair.source for pair in pairs])
        target, target_mask = _pad_points([pair.target for pair in pairs])
        return cls(
            source=finite("source", source.to(dtype)),
            target=finite("target", target.to(dtype)),
            source_mask=source_mask,
            target_mask=target_mask,
            source_closed=torch.tensor([pair.source.is_closed for pair in pairs]),
            target_closed=torch.tensor([pair.target.is_closed for pair in pairs]),
            dt=finite("dt", torch.tensor([pair.dt for pair in pairs], dtype=dtype), LONGEST),
            range_noise=finite("range_noise", torch.tensor([range_noise_of(pair) for pair in pairs], dtype=dtype)),
            initial_motion=finite(
                "initial_motion", torch.from_numpy(np.stack([initial_motion_of(pair) for pair in pairs])).to(dtype)
            ),
            target_origin=torch.zeros(len(pairs), 2, dtype=dtype),
            truth=_collate_truth(pairs, source_mask, dtype) if all(pair.annotation for pair in pairs) else None,
        )


def batches(items: Sequence[Item], batch_size: int) -> Iterator[Sequence[Item]]:
    """The items in their order, `batch_size` at a time; raises TorchCRFScanError for a size below 1."""
    if batch_size < 1:
        raise TorchCRFScanError(f"batch_size: expected at least 1, got {batch_size}")
    for begin in range(0, len(items), batch_size):
        yield items[begin : begin + batch_size]


def finite(name: str, values: Tensor, most: float = FARTHEST) -> Tensor:
    """The values, unchanged; raises TorchCRFScanError if one is not finite, e.g. after overflow of a dtype, or beyond `most`."""
    wrong = values[~(values.double().abs() <= most)]  # half precision does not hold `most`
    if len(wrong):
        raise TorchCRFScanError(f"{name}: expected numbers of {values.dtype} within {most:g}, got {wrong[0].item()}")
    return values


def scale_motions(motions: Tensor, factor: Tensor) -> Tensor:
    """(B, ..., 3) motions in another unit of length; factor: (B,) scale of each pair."""
    by_pair = factor.view(-1, *[1] * (motions.dim() - 1))
    return torch.cat([motions[..., :1], motions[..., 1:] * by_pair], dim=-1)


def _pad_points(scans: Sequence[Scan]) -> tuple[Tensor, Tensor]:
    """(B, N, 2) points and (B, N) mask."""
    lengths = torch.tensor([len(scan) for scan in scans])
    longest = max(1, int(lengths.max()))
    points = torch.zeros(len(scans), longest, 2, dtype=torch.float64)
    for row, scan in zip(points, scans, strict=True):
        row[: len(scan)] = torch.from_numpy(scan.points)
    return points, torch.arange(longest) < lengths[:, None]


def initial_motion_of(pair: ScanPair) -> Floats:
    """(3,) the pair's initial guess; the identity if it has none."""
    return np.zeros(3) if pair.initial_motion is None else pair.initial_motion


LEAST_NOISE = 1e-9  # metres; without any, what only rounding tells apart would be told apart


def range_noise_of(pair: ScanPair) -> float:
    """The sensor's range noise, metres; if unknown, estimated from the ranges.

    On smooth surfaces the second differences of the ranges are noise alone.
    """
    stated = [scan.range_noise for scan in (pair.source, pair.target) if scan.range_noise is not None]
    if stated:
        return max(*stated, LEAST_NOISE)
    second = np.concatenate([np.diff(scan.ranges, n=2) for scan in (pair.source, pair.target)])
    if len(second) == 0:
        return 0.01
    return float(np.clip(1.4826 * np.median(np.abs(second)) / np.sqrt(6.0), 1e-3, 0.1))


def _collate_truth(pairs: Sequence[ScanPair], source_mask: Tensor, dtype: torch.dtype) -> Truth:
    shape = tuple(source_mask.shape)
    association, cluster = np.full(shape, -1), np.full(shape, -1)
    known = np.zeros(shape, dtype=bool)
    motions = np.full((len(pairs), max(len(pair.annotation.motions) for pair in pairs if pair.annotation), 3), np.nan)
    for b, pair in enumerate(pairs):
        truth, beam, n = pair.annotation, pair.source.beam, len(pair.source)
        assert truth is not None
        association[b, :n] = pair.target_points(truth.association)
        cluster[b, :n] = truth.cluster[beam]
        known[b, :n] = ~truth.ignore[beam]
        motions[b, : len(truth.motions)] = truth.motions
    return Truth(
        torch.from_numpy(association), torch.from_numpy(cluster), torch.from_numpy(motions).to(dtype), torch.from_numpy(known)
    )
