"""AdaBoost over decision stumps, evaluated in torch.

A sum of stumps is additive over features, so the ensemble is one lookup table per feature: the thresholds, and the margin of
every interval between them. Fitting is in `learning/boosting_fit.py`. The smooth variant replaces every step by a sigmoid.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from torchcrf_scan.errors import TorchCRFScanError


class StumpEnsemble(nn.Module):
    """H(phi) = sum_t alpha_t h_t(phi) over `stumps` decision stumps (spec 2.2); zero until it is fitted.

    With width 0 it is piecewise constant: its gradient with respect to the inputs is zero wherever it is defined. With a width
    above 0 every step is a sigmoid of that width: differentiable in inputs, thresholds and table. As the width goes to 0 the
    margins converge to those of the steps, except at the thresholds themselves, where a sigmoid is one half.

    Attributes:
        thresholds: (F, T) ascending, padded with inf; at most T of all are finite.
        table: (F, T+1) margin of feature f between its thresholds.
        width: of the sigmoids, in units of the inputs; 0: steps.
    """

    thresholds: Tensor
    table: Tensor

    def __init__(self, features: int, stumps: int = 50, *, width: float = 0.0, is_learned: bool = False) -> None:
        """is_learned: thresholds and table are parameters, not buffers."""
        super().__init__()
        self.width = width
        empty = {"thresholds": torch.full((features, stumps), torch.inf), "table": torch.zeros(features, stumps + 1)}
        for name, value in empty.items():
            if is_learned:
                self.register_parameter(name, nn.Parameter(value))
            else:
                self.register_buffer(name, value)

    def extra_repr(self) -> str:
        """Shape of the ensemble."""
        return f"features={self.thresholds.shape[0]}, stumps={self.thresholds.shape[1]}, width={self.width}"

    @torch.no_grad()
    def set_stumps(self, feature: Tensor, threshold: Tensor, left: Tensor, right: Tensor) -> None:
        """Sets T fitted stumps: h = left where phi[feature] <= threshold, else right (both already times alpha). (T,) each."""
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

        Lets constant parts be cached between iterations: only the registered channel depends on the motions (spec 2.5.4).
        """
        rows = slice(first, first + phi.shape[-1])
        if self.width > 0:
            return smooth_margins(phi, self.thresholds[rows], self.table[rows], self.width)
        flat = phi.detach().reshape(-1, phi.shape[-1]).T.contiguous()  # (n, P)
        place = torch.searchsorted(self.thresholds[rows].to(flat.dtype), flat)  # number of thresholds below phi
        return self.table[rows].gather(1, place).sum(0).view(phi.shape[:-1])

    def forward(self, phi: Tensor) -> Tensor:
        """Margin H. phi: (..., F). Returns (...)."""
        if phi.shape[-1] != len(self.thresholds):
            raise TorchCRFScanError(f"phi: expected {len(self.thresholds)} features, got {phi.shape[-1]}")
        return self.margins(phi)


def smooth_margins(phi: Tensor, thresholds: Tensor, table: Tensor, width: float) -> Tensor:
    """Margins whose steps are sigmoids: table[f, 0] + sum_t (table[f, t+1] - table[f, t]) sigmoid((phi_f - threshold_ft) / width).

    Args:
        phi: (..., F). thresholds: (F, T), of which at most T are finite. table: (F, T+1).

    Returns:
        (...), at the cost of T sigmoids each, as padding is skipped.
    """
    T = thresholds.shape[1]
    order = thresholds.detach().flatten().argsort(stable=True)[:T]  # the finite ones of all features, and some padding
    threshold, step = thresholds.flatten()[order].to(phi), table.diff(dim=1).flatten()[order].to(phi)
    rise = torch.sigmoid((phi.index_select(-1, order // T) - threshold) / width)  # (..., T)
    return table[:, 0].sum().to(phi) + (rise * step).sum(-1)
