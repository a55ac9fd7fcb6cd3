from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from torchcrf_scan.data import dataset
from torchcrf_scan.data.dataset import PairFiles, split_by_sequence
from torchcrf_scan.data.pair_file import write_pair
from torchcrf_scan.scan import Scan, ScanPair

SCAN = Scan.from_ranges(np.ones(3), np.arange(3.0))


def make_pair(sequence: str = "", name: str = "") -> ScanPair:
    return ScanPair(SCAN, SCAN, sequence=sequence, name=name)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """b.npz, a.npz and deep/c.npz, and a file of another kind."""
    (tmp_path / "deep").mkdir()
    for name in ("b", "a", "deep/c"):
        write_pair(tmp_path / f"{name}.npz", make_pair())
    (tmp_path / "notes.txt").write_text("not a pair")
    return tmp_path


def names(pairs: PairFiles) -> list[str]:
    return [pair.name for pair in pairs]


def test_files_are_sorted_and_counted_once(folder: Path) -> None:
    assert names(PairFiles(folder)) == ["a", "b"]
    assert names(PairFiles(f"{folder}/**/*.npz")) == ["a", "b", "c"]
    assert names(PairFiles(folder / "b.npz", folder, folder / "deep")) == ["a", "b", "c"]


def test_it_is_a_sequence(folder: Path) -> None:
    pairs = PairFiles(folder)
    assert len(pairs) == 2
    assert pairs[-1] is pairs[1]
    assert [pair.name for pair in pairs[::-1]] == ["b", "a"]
    with pytest.raises(IndexError):
        pairs[2]
    assert "2 files" in repr(pairs)


def test_files_are_read_when_asked_for_and_once(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    read: list[str] = []
    monkeypatch.setattr(dataset, "read_pair", lambda path: read.append(path.name) or make_pair())
    pairs = PairFiles(folder)
    assert read == []
    assert pairs[1] is pairs[1]
    assert read == ["b.npz"]


def test_a_file_name_with_brackets_is_no_pattern(tmp_path: Path) -> None:
    write_pair(tmp_path / "a[1].npz", make_pair())
    assert len(PairFiles(tmp_path / "a[1].npz")) == 1


@pytest.mark.parametrize("pattern", ["nothing*.npz", "missing", "empty"])
def test_a_pattern_without_files_is_named(folder: Path, pattern: str) -> None:
    (folder / "empty").mkdir()
    with pytest.raises(ValueError, match=pattern.replace("*", r"\*")):
        PairFiles(folder, folder / pattern)


def test_no_pattern_at_all() -> None:
    with pytest.raises(ValueError, match="at least one"):
        PairFiles()


@given(
    sequences=st.lists(st.sampled_from("abcde"), min_size=2).filter(lambda names: len(set(names)) > 1),
    share=st.floats(0.01, 0.99),
    seed=st.integers(0, 100),
)
def test_split_never_cuts_a_sequence(sequences: list[str], share: float, seed: int) -> None:
    pairs = [make_pair(sequence, str(i)) for i, sequence in enumerate(sequences)]
    for held_out in (share, 1, len(set(sequences)) - 1):
        train, test = split_by_sequence(pairs, held_out, seed)
        assert train
        assert test
        assert not {pair.sequence for pair in train} & {pair.sequence for pair in test}
        for part in (train, test):
            assert [int(pair.name) for pair in part] == sorted(int(pair.name) for pair in part)
        assert len(train) + len(test) == len(pairs)
        again = split_by_sequence(pairs, held_out, seed)
        assert [p.name for p in again[1]] == [p.name for p in test]


def test_split_holds_out_what_is_asked_for() -> None:
    pairs = [make_pair(name) for name in "aabbccddee"]
    assert len(split_by_sequence(pairs, 2)[1]) == 4
    assert len(split_by_sequence(pairs, 0.3)[1]) == 4
    assert len(split_by_sequence(pairs, 0.2)[1]) == 2
    assert len(split_by_sequence(pairs, 0.99)[1]) == 8


def test_split_depends_on_the_seed() -> None:
    pairs = [make_pair(name) for name in "abcdefgh"]
    drawn = {split_by_sequence(pairs, 1, seed)[1][0].sequence for seed in range(20)}
    assert len(drawn) > 3


def test_a_single_sequence_cannot_be_split() -> None:
    for pairs in ([], [make_pair()] * 3):
        with pytest.raises(ValueError, match="at least 2 sequences"):
            split_by_sequence(pairs, 1)


@pytest.mark.parametrize("held_out", [0, 2, -1, 0.0, 1.0, 1.5, float("nan"), True])
def test_impossible_shares_are_refused(held_out: float) -> None:
    with pytest.raises(ValueError, match="held_out: expected"):
        split_by_sequence([make_pair("a"), make_pair("b")], held_out)


def test_split_of_the_real_pairs(real_pairs_dir: Path) -> None:
    train, test = split_by_sequence(PairFiles(real_pairs_dir), 1, seed=3)
    assert len({pair.sequence for pair in train}) == 2
    assert len({pair.sequence for pair in test}) == 1
