"""What learning looks at once: the same whoever looks, dealt out in whole sequences."""

from collections.abc import Iterator
from dataclasses import fields, is_dataclass, replace

import numpy as np
import pytest
import torch
from support import assert_close
from torch import Tensor

from torchcrf_scan.batch import ScanPairBatch
from torchcrf_scan.experiment.study import Study
from torchcrf_scan.learning import material as material_module
from torchcrf_scan.learning.material import Collection, assign_folds, collect
from torchcrf_scan.learning.settings import LearningConfig
from torchcrf_scan.scan import ScanPair
from torchcrf_scan.search.accept import score_of
from torchcrf_scan.search.pairs import initialise
from torchcrf_scan.search.score import HypothesisScore

UNDISTURBED = LearningConfig(disturbance=0.0, folds=2, batch_size=2)


def tensors(value: object) -> Iterator[Tensor]:
    """Every tensor and array in nested dataclasses and sequences."""
    if isinstance(value, Tensor):
        yield value
    elif isinstance(value, (np.ndarray, bool, float)):
        yield torch.from_numpy(np.array(value))
    elif isinstance(value, (list, tuple)):
        for part in value:
            yield from tensors(part)
    elif is_dataclass(value):
        for field in fields(value):
            yield from tensors(getattr(value, field.name))


def assert_equal(one: object, other: object) -> None:
    first, second = list(tensors(one)), list(tensors(other))
    assert len(first) == len(second) > 0
    for a, b in zip(first, second, strict=True):
        torch.testing.assert_close(a, b, rtol=0, atol=0, equal_nan=True)


@pytest.fixture(scope="module")
def undisturbed(small_pairs: list[ScanPair]) -> Collection:
    """The last three pairs as they are."""
    return collect(small_pairs[3:], UNDISTURBED)


# --- looking ------------------------------------------------------------------------------------------------------------------


def test_neither_jobs_nor_draws_elsewhere_change_what_is_found(
    small_pairs: list[ScanPair], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(material_module, "PART", 1)
    config = LearningConfig(seed=5)
    one = collect(small_pairs[:2], config, jobs=1)
    torch.manual_seed(99)
    assert_equal(one, collect(small_pairs[:2], config, jobs=2))


def test_pairs_are_disturbed_a_little_and_keep_their_names(small_pairs: list[ScanPair], study: Study) -> None:
    collection = study.collection
    assert (collection.names, collection.sequences) == (
        tuple(pair.name for pair in small_pairs),
        tuple(pair.sequence for pair in small_pairs),
    )
    assert collection.pairs == tuple(small_pairs)
    as_they_are = ScanPairBatch.collate(small_pairs)
    moved = torch.linalg.vector_norm(collection.batch.source - as_they_are.source, dim=-1)[as_they_are.source_mask]
    assert 0 < float(moved.median()) < 0.5
    assert torch.equal(collection.batch.source_mask, as_they_are.source_mask)


def test_pairs_without_annotation_are_refused(small_pairs: list[ScanPair]) -> None:
    with pytest.raises(ValueError, match=f"pairs: expected annotated pairs, got .*{small_pairs[1].name}"):
        collect([small_pairs[0], replace(small_pairs[1], annotation=None)], UNDISTURBED)
    with pytest.raises(ValueError, match="pairs: expected annotated pairs, got none"):
        collect([], UNDISTURBED)


# --- dealing out --------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("index", [[1], [2, 0], [5, 1, 3]])
def test_a_selection_is_the_same_as_collating_alone(small_pairs: list[ScanPair], index: list[int]) -> None:
    everything = ScanPairBatch.collate(small_pairs)
    found = everything.select(torch.tensor(index))
    alone = ScanPairBatch.collate([small_pairs[k] for k in index])
    assert found.truth is not None
    assert alone.truth is not None
    movers = alone.truth.motions.shape[1]
    assert found.truth.motions[:, movers:].isnan().all()  # room for the movers of other pairs
    assert_equal(replace(found, truth=replace(found.truth, motions=found.truth.motions[:, :movers])), alone)
    assert everything.without_truth().select(torch.tensor(index)).truth is None


def test_material_is_the_chosen_pairs_with_the_start_of_the_score(small_pairs: list[ScanPair], undisturbed: Collection) -> None:
    pairs, score = small_pairs[3:], HypothesisScore()
    material = undisturbed.material([2, 0], score, 4, UNDISTURBED)
    seen = sorted(round(float(part.batch.source[b].sum()), 3) for part in material for b in range(len(part.batch)))
    assert seen == sorted(round(float(ScanPairBatch.collate([pairs[k]]).source.sum()), 3) for k in (2, 0))
    for part in material:
        assert torch.equal(ScanPairBatch.collate(part.pairs).source, part.batch.source)
        expected = initialise(part.batch, score_of(score), 4)
        assert part.start.motions.shape == (len(part.batch), 4, 3)
        assert torch.equal(part.start.active, expected.active)
        assert_close(part.start.motions, expected.motions, tolerance=1e-4)
        assert torch.equal(part.start.association, expected.association)


def test_material_is_batches_of_one_fold(study: Study) -> None:
    collection = study.collection
    material = collection.material(range(6), HypothesisScore(), 5, UNDISTURBED)
    assert sum(len(part.batch) for part in material) == 6
    assert all(len(part.batch) <= 2 for part in material)
    assert [part.fold for part in material] == [0, 0, 1]  # two sequences of two pairs, and one
    assert all(part.start.motions.shape == (len(part.batch), 5, 3) for part in material)


def test_the_score_is_fitted_on_the_chosen_pairs_alone(study: Study) -> None:
    collection = study.collection
    some, changed = collection.fit_score([0, 1, 2]), replace(collection, views=(*collection.views[:3], (), (), ()))
    assert_equal(list(some.buffers()), list(changed.fit_score([0, 1, 2]).buffers()))
    assert not torch.equal(some.weight, collection.fit_score(range(6)).weight)


# --- folds --------------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("folds", [1, 2, 3, 5])
def test_folds_keep_sequences_whole(folds: int) -> None:
    sequences = list("aaaabbbccdddddeffg")
    numbers = assign_folds(sequences, folds)
    assert sorted(set(numbers)) == list(range(folds))
    for sequence in "abcdefg":
        assert len({number for name, number in zip(sequences, numbers, strict=True) if name == sequence}) == 1
    sizes = [numbers.count(number) for number in range(folds)]
    assert max(sizes) - min(sizes) <= 5


@pytest.mark.parametrize("folds", [0, 1])
def test_no_folds_are_one(folds: int) -> None:
    assert assign_folds(["a", "b", "a"], folds) == [0, 0, 0]


def test_no_more_folds_than_sequences() -> None:
    assert sorted(assign_folds(["a", "b", "a"], 5)) == [0, 0, 1]
