"""The paper's own numbers (spec 10.1), for the rows of our tables with the same method.

They were measured on pairs that are not public, so they are anchors of magnitude and order, not targets.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class PublishedTable:
    """One table of the paper.

    Attributes:
        columns: C headings with the number of digits printed.
        rows: method, named as in our tables -> its C numbers.
    """

    columns: tuple[tuple[str, int], ...]
    rows: Mapping[str, tuple[float, ...]]


_LABELS = (("accuracy (%)", 2), ("SED", 2), ("outliers found (%)", 2), ("outliers true (%)", 2), ("ratio (%)", 2))

ASSOCIATION = PublishedTable(
    _LABELS,
    {
        "ICP, tuned": (69.19, 119.10, 34.60, 11.07, 89.79),  # 'ICP' in the paper; ours is tuned to the same share of outliers
        "CRF-Matching": (71.03, 116.16, 13.01, 11.07, 57.93),
        "joint": (74.13, 96.13, 12.96, 11.07, 73.37),
    },
)
DETECTION = PublishedTable(
    _LABELS,
    {
        "K-Means (ICP)": (43.16, 243.87, 34.60, 11.07, 89.79),
        "K-Means (CRF-Matching)": (60.42, 215.55, 13.01, 11.07, 57.93),
        "CRF-Clustering": (60.04, 190.03, 24.35, 11.07, 55.64),
        "joint": (83.22, 79.61, 13.12, 11.07, 73.37),
    },
)
ESTIMATION = PublishedTable(
    (("rotation (rad)", 2), ("translation (m)", 2)),
    {
        "K-Means (ICP)": (0.02, 1.01),
        "K-Means (CRF-Matching)": (0.04, 0.77),
        "CRF-Clustering": (0.05, 0.88),
        "joint": (0.03, 0.56),
    },
)
