"""What a mover's cluster is worth: which clusters count as true movers, and the regression on them."""

from dataclasses import replace

import pytest
import torch
from support import generator, make_points, normal

from torchcrf_scan.batch import ScanPairBatch, Truth
from torchcrf_scan.features.potentials import PairView
from torchcrf_scan.geometry import se2
from torchcrf_scan.inference.start import Start, nearest_association
from torchcrf_scan.learning import selection_fit
from torchcrf_scan.learning.material import Material
from torchcrf_scan.learning.selection_fit import fit_potential, is_true_mover, judge_clusters
from torchcrf_scan.model import JointScanCRF

N = 24
MOTIONS = torch.tensor([[0.05, -0.3, 0.1], [-0.1, 0.9, 0.3]], dtype=torch.float64)
ELSEWHERE = torch.tensor([0.0, 30.0, 30.0], dtype=torch.float64)


def annotated(seed: int = 1) -> ScanPairBatch:
    """A background and one mover, eight points in the middle."""
    source = make_points(N, seed)
    cluster = ((torch.arange(N) >= 8) & (torch.arange(N) < 16)).long()
    target = se2.apply(MOTIONS[cluster], source[:, None])[:, 0] + 0.003 * normal(N, 2, seed=seed)
    real = torch.ones(1, N, dtype=torch.bool)
    still = torch.zeros(1, dtype=torch.bool)
    truth = Truth(torch.arange(N)[None], cluster[None], MOTIONS[None], real)
    one = torch.ones(1).double()
    return ScanPairBatch(
        source[None], target[None], real, real, still, still, 0.1 * one, 0.01 * one, torch.zeros(1, 3).double(), truth
    )


def start_of(batch: ScanPairBatch) -> Start:
    """The background, the mover and a motion that explains nothing, all to be considered."""
    motions = torch.stack([*MOTIONS, ELSEWHERE])[None]
    odds = torch.tensor([[torch.inf, 1.0, -1.0]]).double()
    association = nearest_association(batch, motions, odds > -torch.inf, gate=20.0)
    return Start(motions, odds == torch.inf, association, torch.zeros_like(batch.target), None, odds)


@pytest.mark.parametrize("seed", range(4))
def test_true_movers_equal_the_loops(seed: int) -> None:
    batch = annotated()
    start = start_of(batch)
    cluster = torch.randint(-1, 3, (1, N), generator=generator(seed))
    known = torch.rand(1, N, generator=generator(seed + 9)) < 0.8
    assert batch.truth is not None
    view = PairView.of(replace(batch, truth=replace(batch.truth, known=known)))
    found = is_true_mover(view, start, cluster)[0].tolist()

    def overlap(k: int) -> int:
        return sum(bool(known[0, i]) and int(cluster[0, i]) == k and 8 <= i < 16 for i in range(N))

    sizes = [sum(bool(known[0, i]) and int(cluster[0, i]) == k for i in range(N)) for k in range(3)]
    expected = [overlap(k) > 0.5 * sizes[k] and overlap(k) == max(map(overlap, range(3))) > 0 for k in range(3)]
    assert found == expected


def test_clusters_are_judged_by_what_they_explain() -> None:
    batch = annotated()
    terms, label = judge_clusters(JointScanCRF().double(), Material(batch, start_of(batch), 0, ()))
    assert label.tolist() == [1, 0]
    assert float(terms[0, 0]) > float(terms[1, 0]) >= 0
    assert terms[:, 1].tolist() == [1.0, -1.0]


def test_a_mover_of_whom_nothing_is_annotated_is_not_judged() -> None:
    batch = annotated()
    assert batch.truth is not None
    known = (torch.arange(N) < 8) | (torch.arange(N) >= 16)
    batch = replace(batch, truth=replace(batch.truth, known=known[None]))
    terms, label = judge_clusters(JointScanCRF().double(), Material(batch, start_of(batch), 0, ()))
    assert label.tolist() == [0]
    assert terms[:, 1].tolist() == [-1.0]


def test_the_potential_tells_true_movers_from_others(monkeypatch: pytest.MonkeyPatch) -> None:
    label = torch.arange(40) % 2
    terms = torch.stack([label + 0.3 * normal(40, seed=1), 2 * label - 1 + 0.5 * normal(40, seed=2)], dim=-1)
    monkeypatch.setattr(selection_fit, "judge_clusters", lambda model, part: (terms, label))
    batch = annotated()
    potential = fit_potential(JointScanCRF(), [Material(batch, start_of(batch), 0, ())])
    worth = potential(terms[:, 0].clamp(min=0).expm1(), terms[:, 1])
    assert ((worth > 0) == (label == 1)).float().mean() > 0.95
    assert float(potential.explains) > 0
    assert float(potential.score) > 0


def test_without_movers_the_default_stays(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(selection_fit, "judge_clusters", lambda model, part: (torch.zeros(3, 2), torch.zeros(3).long()))
    batch = annotated()
    potential = fit_potential(JointScanCRF(), [Material(batch, start_of(batch), 0, ())])
    assert float(potential.bias) == -2.0
    assert float(fit_potential(JointScanCRF(), []).bias) == -2.0
