"""AdaBoost over decision stumps, evaluated in torch.

A sum of stumps is additive over features, so the ensemble is one lookup table a feature: the thresholds, and the margin between
each two of them. Fitting is `learning/boosting_fit.py`.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn


class StumpEnsemble(nn.Module):
    """H(phi) = sum_t alpha_t h_t(phi) over `stumps` decision stumps (spec 2.2); zero until it is fitted.

    Step-shaped: its gradient with respect to the inputs is zero wherever it is defined.

    Attributes:
        thresholds: (F, T) ascending, padded with inf.
        table: (F, T+1) margin of feature f between its thresholds.
    """

    thresholds: Tensor
    table: Tensor

    def __init__(self, features: int, stumps: int = 50) -> None:
        super().__init__()
        self.register_buffer("thresholds", torch.full((features, stumps), torch.inf))
        self.register_buffer("table", torch.zeros(features, stumps + 1))

    def extra_repr(self) -> str:
        """Shape of the ensemble."""
        return f"features={self.thresholds.shape[0]}, stumps={self.thresholds.shape[1]}"

    @torch.no_grad()
    def set_stumps(self, feature: Tensor, threshold: Tensor, left: Tensor, right: Tensor) -> None:
        """Takes T fitted stumps: h = left where phi[feature] <= threshold, else right (both already times alpha). (T,) each."""
        self.thresholds.fill_(torch.inf)
        self.table.zero_()
        for f in range(len(self.thresholds)):
            mine = (feature == f).nonzero().flatten()
            mine = mine[threshold[mine].argsort()]
            steps = (right - left)[mine].double().cumsum(0)
            self.thresholds[f, : len(mine)] = threshold[mine].to(self.thresholds.dtype)
            self.table[f] = left[mine].double().sum()
            self.table[f, 1 : len(mine) + 1] += steps.to(self.table.dtype)
            self.table[f, len(mine) + 1 :] = self.table[f, len(mine)]

    def margins(self, phi: Tensor, first: int = 0) -> Tensor:
        """Margin of the features `first` to `first + n`. phi: (..., n). Returns (...); the sum over all features is `forward`.

        Lets what does not change between iterations be kept: only the registered channel depends on the motions (spec 2.5.4).
        """
        rows = slice(first, first + phi.shape[-1])
        flat = phi.detach().reshape(-1, phi.shape[-1]).T.contiguous()  # (n, P)
        place = torch.searchsorted(self.thresholds[rows].to(flat.dtype), flat)  # thresholds below phi
        return self.table[rows].gather(1, place).sum(0).view(phi.shape[:-1])

    def forward(self, phi: Tensor) -> Tensor:
        """Margin H. phi: (..., F). Returns (...)."""
        if phi.shape[-1] != len(self.thresholds):
            raise ValueError(f"phi: expected {len(self.thresholds)} features, got {phi.shape[-1]}")
        return self.margins(phi)
