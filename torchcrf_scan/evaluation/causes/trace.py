"""What the search saw of one pair."""

from __future__ import annotations

from dataclasses import dataclass

from torchcrf_scan.scan import Bools, Floats, Ints


@dataclass(frozen=True, slots=True)
class SearchTrace:
    """The pool of the search of one pair, H hypothesised motions of movers, and what became of them. N points of the source.

    Attributes:
        background: (3,) the background's motion as the search found it, before any label.
        motions: (H, 3) `T_target_source`. members: (H, N) bool, the points that each of them moves.
        likely: (H,) bool, whether the score alone would let it be considered.
        considered: (G,) numbers of the hypotheses that became clusters, without rivals.
        kept: (G,) bool, whether the cluster was still there at the end.
        units: (N,) metres, the usual distance of a well registered point from its surface.
    """

    background: Floats
    motions: Floats
    members: Bools
    likely: Bools
    considered: Ints
    kept: Bools
    units: Floats

    @property
    def accepted(self) -> Ints:
        """Numbers of the hypotheses that were considered and kept."""
        return self.considered[self.kept]
