"""A stated convention for outliers: a point farther than some metres from every target point, under its own motion, is one.

Without it the distance is learned, in units of spacing. With it a potential joins both chains: on the side of the inliers within
the distance, of the outlier beyond it. It is larger than what the other potentials and the neighbours say of that question, so that
the decision lies at the distance, and the same for all targets and clusters within it, so that they decide all others as before.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

STRENGTH = 20.0  # of the potential far from the distance; learned ones and neighbours seldom add up to half of it
SOFTNESS = 0.05  # width of the step, in units of resolution


@dataclass(frozen=True, slots=True)
class Limit:
    """Distance of outliers of B pairs, in the features' unit of length.

    Attributes:
        distance: (B,). softness: (B,) width of the step there.
    """

    distance: Tensor
    softness: Tensor

    def log_within(self, distance: Tensor) -> Tensor:
        """Log potential of inliers at a distance (B, ...): `STRENGTH` well within the limit, 0 at it, minus that well beyond."""
        shape = (-1, *[1] * (distance.dim() - 1))
        beyond = (distance - self.distance.view(shape)) / self.softness.view(shape)
        return STRENGTH * (1 - 2 * torch.sigmoid(beyond))

    def joined(self, log_unary: Tensor, distance: Tensor) -> Tensor:
        """(B, N, S) log potentials with that of the limit, the outlier last. distance: (B, N, S-1) of the inlier states."""
        return torch.cat([log_unary[..., :-1] + self.log_within(distance), log_unary[..., -1:]], dim=-1)
