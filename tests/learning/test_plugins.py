"""What the features take as observed in training: noisy truth, found motions that stand for it, and spurious ones to ignore."""

from dataclasses import replace

import pytest
import torch
from support import assert_close, generator, make_points
from torch import Tensor

from torchcrf_scan.batch import ScanPairBatch, Truth
from torchcrf_scan.geometry import se2
from torchcrf_scan.inference.pseudo_likelihood import true_plugins
from torchcrf_scan.inference.start import Start
from torchcrf_scan.learning.plugins import match_start, mix_associations, training_plugins
from torchcrf_scan.learning.settings import LearningConfig

N = 20
MOTIONS = torch.tensor([[0.05, -0.3, 0.1], [-0.1, 1.9, 0.3], [0.2, -0.2, -2.0]], dtype=torch.float64)
WRONG = torch.tensor([0.0, 30.0, 30.0], dtype=torch.float64)
QUIET = {"rotation_noise": 0.0, "translation_noise": 0.0}


def make_batch(pairs: int = 1) -> ScanPairBatch:
    source = torch.stack([make_points(N, seed) for seed in range(pairs)])
    cluster = (torch.arange(N) // 5).clamp(max=2).expand(pairs, N).clone()
    cluster[:, -1] = -1
    target = se2.apply(MOTIONS[cluster.clamp(min=0)], source[:, :, None])[:, :, 0]
    association = torch.arange(N).expand(pairs, N).masked_fill(cluster < 0, -1)
    return ScanPairBatch(
        source=source,
        target=target,
        source_mask=torch.ones(pairs, N, dtype=torch.bool),
        target_mask=torch.ones(pairs, N, dtype=torch.bool),
        source_closed=torch.zeros(pairs, dtype=torch.bool),
        target_closed=torch.zeros(pairs, dtype=torch.bool),
        dt=torch.full((pairs,), 0.1).double(),
        range_noise=torch.full((pairs,), 0.01).double(),
        initial_motion=torch.zeros(pairs, 3).double(),
        truth=Truth(association, cluster, MOTIONS.expand(pairs, 3, 3), torch.ones(pairs, N, dtype=torch.bool)),
    )


def make_start(batch: ScanPairBatch, motions: list[Tensor], active: list[bool] | None = None) -> Start:
    B = len(batch)
    mask = torch.tensor(active or [True] * len(motions)).expand(B, -1)
    nobody = torch.full(batch.source.shape[:2], -1)
    return Start(torch.stack(motions).expand(B, -1, 3), mask, nobody, torch.zeros_like(batch.target))


def test_found_motions_stand_for_the_truth_whatever_their_slot() -> None:
    batch = make_batch()
    start = make_start(batch, [MOTIONS[0], WRONG, MOTIONS[2] + 0.01, MOTIONS[1]])
    stands_for = match_start(batch, start, true_plugins(batch, 4))
    assert stands_for[0].nonzero().tolist() == [[0, 0], [1, 3], [2, 2]]


def test_one_found_motion_stands_for_one_cluster_at_most() -> None:
    batch = make_batch()
    start = make_start(batch, [MOTIONS[0], MOTIONS[1] + 0.02, MOTIONS[1] + 0.001])
    stands_for = match_start(batch, start, true_plugins(batch, 3))
    assert stands_for[0].nonzero().tolist() == [[0, 0], [1, 2]]


def test_inactive_or_bad_motions_stand_for_nothing() -> None:
    batch = make_batch()
    start = make_start(batch, [WRONG, MOTIONS[1], MOTIONS[2]], [True, False, True])
    assert match_start(batch, start, true_plugins(batch, 3))[0].nonzero().tolist() == [[2, 2]]


def test_the_start_is_used_for_some_pairs_and_the_noisy_truth_for_the_others() -> None:
    batch = make_batch(40)
    near = MOTIONS + 0.01
    start = make_start(batch, [*near])
    for share, least, most in ((0.0, 0, 0), (1.0, 40, 40), (0.5, 8, 32)):
        plugins = training_plugins(batch, start, LearningConfig(start_share=share, **QUIET), generator(0))
        taken = (plugins.motions - near).abs().amax((1, 2)) < 1e-9
        assert least <= int(taken.sum()) <= most
        assert_close(plugins.motions[~taken], MOTIONS.expand(int((~taken).sum()), 3, 3))


def test_the_noise_has_its_size() -> None:
    batch = make_batch(300)
    start = make_start(batch, [WRONG, WRONG, WRONG])
    config = LearningConfig(rotation_noise=0.004, translation_noise=0.03)
    noise = training_plugins(batch, start, config, generator(0)).motions - MOTIONS
    assert_close(noise.mean((0, 1)), torch.zeros(3).double(), tolerance=0.005)
    assert_close(noise.std((0, 1)), torch.tensor([0.004, 0.03, 0.03]).double(), tolerance=0.1 * 0.03)
    again = training_plugins(batch, start, config, generator(0)).motions
    assert torch.equal(again, noise + MOTIONS) or torch.allclose(again, noise + MOTIONS)


@pytest.mark.parametrize("share", [0.0, 1.0])
def test_spare_slots_hold_spurious_movers(share: float) -> None:
    batch = make_batch()
    start = make_start(batch, [MOTIONS[0], MOTIONS[2], WRONG, WRONG + 1, WRONG + 2], [True, True, True, False, True])
    plugins = training_plugins(batch, start, LearningConfig(start_share=share, **QUIET), generator(0))
    assert plugins.motions.shape == (1, 5, 3)
    assert plugins.active.tolist() == [[True] * 5]
    assert_close(plugins.motions[0], torch.stack([*MOTIONS, WRONG, WRONG + 2]))
    assert plugins.label[0].tolist() == batch.truth.cluster[0].tolist()  # type: ignore[union-attr]


def test_reaches_are_those_of_the_true_points_and_of_the_spurious_segments() -> None:
    batch = make_batch()
    start = make_start(batch, [MOTIONS[0], WRONG, MOTIONS[2], MOTIONS[1]])
    found = 3 * torch.rand(1, N, 4, generator=generator(1), dtype=torch.float64)
    plugins = training_plugins(batch, replace(start, reach=found), LearningConfig(**QUIET), generator(0))
    assert (plugins.reach[0, torch.arange(N), plugins.label[0].clamp(min=0)] == 0).all()
    assert plugins.reach.max() > 0
    assert torch.equal(plugins.motions[0, 3], WRONG)
    assert torch.equal(plugins.reach[..., 3], found[..., 1])
    assert training_plugins(batch, start, LearningConfig(**QUIET), generator(0)).reach is None


def test_spare_slots_without_spurious_movers_stay_empty() -> None:
    batch = make_batch()
    start = make_start(batch, [*MOTIONS, WRONG], [True, True, True, False])
    plugins = training_plugins(batch, start, LearningConfig(**QUIET), generator(0))
    assert plugins.active.tolist() == [[True, True, True, False]]


def test_more_spurious_movers_than_slots_are_dropped() -> None:
    batch = make_batch()
    start = make_start(batch, [MOTIONS[0], *[WRONG + k for k in range(4)]])
    plugins = training_plugins(batch, start, LearningConfig(**QUIET), generator(0))
    assert plugins.active.all()
    assert_close(plugins.motions[0], torch.stack([*MOTIONS, WRONG, WRONG + 1]))


def test_a_wrong_background_is_no_mover() -> None:
    batch = make_batch()
    start = make_start(batch, [WRONG, MOTIONS[1], MOTIONS[2], WRONG], [True, True, True, False])
    plugins = training_plugins(batch, start, LearningConfig(start_share=1.0, **QUIET), generator(0))
    assert plugins.active.tolist() == [[True, True, True, False]]
    assert_close(plugins.motions[0, :3], MOTIONS)


@pytest.mark.parametrize(("share", "least", "most"), [(0.0, 0, 0), (1.0, 40, 40), (0.5, 8, 32)])
def test_predicted_associations_replace_the_true_ones_of_some_pairs(share: float, least: int, most: int) -> None:
    batch = make_batch(40)
    plugins = true_plugins(batch, 3)
    predicted = torch.full((40, N), 7)
    mixed = mix_associations(plugins, predicted, share, generator(0))
    taken = (mixed.association == 7).all(-1)
    assert least <= int(taken.sum()) <= most
    assert torch.equal(mixed.association[~taken], plugins.association[~taken])
    assert torch.equal(mixed.label, plugins.label)
