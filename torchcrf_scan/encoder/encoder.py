"""The network: residual dilated convolutions along the beams, circular for closed scans."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from torchcrf_scan.batch import ScanPairBatch
from torchcrf_scan.config import EncoderConfig
from torchcrf_scan.encoder.aligned import aligned_inputs
from torchcrf_scan.encoder.aligned_loops import aligned_inputs_of_pairs
from torchcrf_scan.encoder.channels import CHANNELS
from torchcrf_scan.features.learned import ExtraLogUnary, LearnedInputs
from torchcrf_scan.inference.start import Start
from torchcrf_scan.loops.pair import Pair, PairStart


@dataclass(frozen=True, slots=True)
class Encoded:
    """Output of the encoder for B pairs.

    Attributes:
        extra: log potentials of the source points.
        source_embedding: (B, N, E), target_embedding: (B, M, E); None: without embeddings.
    """

    extra: ExtraLogUnary
    source_embedding: Tensor | None = None
    target_embedding: Tensor | None = None


class ScanEncoder(nn.Module):
    """Log potentials and embeddings of points from `aligned_inputs`; before training its potentials are 0.

    Gradients reach its own weights; its inputs have none.
    """

    def __init__(self, config: EncoderConfig) -> None:
        super().__init__()
        self.embedding = config.embedding
        self.reach = sum(config.dilations)
        self.first = nn.Linear(len(CHANNELS), config.width)
        self.layers = nn.ModuleList(Layer(config.width, dilation) for dilation in config.dilations)
        self.last = nn.Linear(config.width, 2 + config.embedding)
        nn.init.zeros_(self.last.weight[:2])
        nn.init.zeros_(self.last.bias)

    def forward(self, batch: ScanPairBatch, start: Start, backend: str = "auto") -> Encoded:
        """Output for a batch under the motions of a start. backend: of `aligned_inputs`."""
        source, *target = aligned_inputs(batch, start, backend, both=self.embedding > 0)
        logits = self.encode(source.to(self.last.weight), batch.source_mask, batch.source_closed).to(source)
        extra = ExtraLogUnary(outlier=logits[..., 0], moving=logits[..., 1])
        if not target:
            return Encoded(extra)
        of_target = self.encode(target[0].to(self.last.weight), batch.target_mask, batch.target_closed).to(source)
        return Encoded(extra, logits[..., 2:], of_target[..., 2:])

    def of_pairs(self, pairs: Sequence[Pair], starts: Sequence[PairStart]) -> LearnedInputs:
        """The log potentials of pairs as arrays, under their starts' motions; without embeddings."""
        points = torch.tensor([len(pair.source) for pair in pairs])
        longest = max(1, int(points.max())), max(1, max(len(pair.target) for pair in pairs))
        (inputs,) = aligned_inputs_of_pairs(pairs, starts, longest, both=False)
        mask = torch.arange(longest[0]) < points[:, None]
        closed = torch.tensor([pair.source_closed for pair in pairs])
        logits = self.encode(inputs.to(self.last.weight), mask, closed)
        return LearnedInputs(None, logits[..., 0], logits[..., 1])

    def encode(self, inputs: Tensor, mask: Tensor, closed: Tensor) -> Tensor:
        """(B, P, 2 + E) outlier, moving, embedding of every point. inputs: (B, P, F); mask: (B, P); closed: (B,)."""
        hidden = unroll(torch.relu(self.first(inputs)), mask, closed, self.reach)
        for layer in self.layers:
            hidden = layer(hidden)
        return self.last(hidden)


class Layer(nn.Module):
    """A residual layer: a depthwise convolution of three taps, then a linear mixture of the channels; shortens both ends."""

    def __init__(self, width: int, dilation: int) -> None:
        super().__init__()
        self.dilation = dilation
        self.norm = nn.LayerNorm(width)
        self.taps = nn.Parameter(torch.randn(3, width) / 3**0.5)
        self.mix = nn.Sequential(nn.Linear(width, width), nn.ReLU(), nn.Linear(width, width))

    def forward(self, hidden: Tensor) -> Tensor:
        """(B, P, width) -> (B, P - 2 dilation, width)."""
        d, inner = self.dilation, hidden.shape[1] - 2 * self.dilation
        seen = self.norm(hidden)
        before, here, after = self.taps
        seen = seen[:, :inner] * before + seen[:, d : d + inner] * here + seen[:, 2 * d :] * after
        return hidden[:, d : d + inner] + self.mix(seen)


def unroll(values: Tensor, mask: Tensor, closed: Tensor, reach: int) -> Tensor:
    """(B, P + 2 reach, F) the real points extended by `reach` at both ends: circular for a closed scan, zeros for an open one.

    values: (B, P, F). mask: (B, P). closed: (B,).
    """
    count = mask.sum(1, keepdim=True)
    place = torch.arange(-reach, values.shape[1] + reach, device=values.device)[None]
    there = ((place >= 0) & (place < count)) | (closed[:, None] & (count > 0))
    index = torch.where(closed[:, None], place % count.clamp(min=1), place).clamp(0, values.shape[1] - 1)
    return values.gather(1, index[..., None].expand(-1, -1, values.shape[2])) * there[..., None]
