"""What every prediction must be, whatever the pair."""

import numpy as np

from torchcrf_scan.scan import PairPrediction, ScanPair


def check(pair: ScanPair, found: PairPrediction) -> None:
    """Shapes, numbers that exist, outliers and invalid beams that agree, movers by falling size."""
    n = pair.source.n_beams
    assert [len(a) for a in (found.association, found.cluster, found.association_confidence, found.cluster_confidence)] == [n] * 4
    assert found.association.dtype == found.cluster.dtype == np.int64
    assert found.motions.ndim == 2
    assert np.isfinite(found.motions).all()
    invalid = np.setdiff1d(np.arange(n), pair.source.beam)
    assert (found.association[invalid] == -1).all()
    assert (found.association_confidence[invalid] == 0).all()
    assert (found.association_confidence[pair.source.beam] == 1).all()
    assert ((found.association == -1) == (found.cluster == -1)).all()
    assert np.isin(found.association[found.association >= 0], pair.target.beam).all()
    sizes = np.bincount(found.cluster[found.cluster >= 0], minlength=len(found.motions))
    assert len(sizes) == len(found.motions)
    assert (sizes[1:] > 0).all()
    assert (np.diff(sizes[1:]) <= 0).all()


def same(a: PairPrediction, b: PairPrediction) -> bool:
    return all(np.array_equal(getattr(a, name), getattr(b, name)) for name in ("association", "cluster", "motions"))
