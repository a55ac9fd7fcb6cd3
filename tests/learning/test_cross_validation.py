"""Leave-one-out: what every fold may see, what is on disk when, and several processes that end as one."""

import os
from pathlib import Path

import numpy as np
import pytest
from forked import run_ranks
from made_up import RIVAL, Recorder, guess, make_pairs, make_study

from torchcrf_scan.experiment import cross_validation
from torchcrf_scan.experiment.cross_validation import SECONDS, Fold, cores, make_folds, read_folds, run_folds, write_fold
from torchcrf_scan.experiment.methods import METHODS, Answer
from torchcrf_scan.experiment.models import JOINT
from torchcrf_scan.experiment.settings import RunConfig
from torchcrf_scan.safe_names import file_name
from torchcrf_scan.scan import ScanPair

BY_PAIR, BY_SEQUENCE = "leave_one_pair_out", "leave_one_sequence_out"

# --- folds --------------------------------------------------------------------------------------------------------------------


def random_pairs(seed: int) -> tuple[list[ScanPair], int]:
    """Pairs of a few sequences in any order, and how many of them are left out in turn."""
    random = np.random.default_rng(seed)
    tested = [*"ab", *random.choice(list("abcd"), random.integers(1, 9))]
    return make_pairs(*random.permutation(tested), *random.choice(["x", "y"], random.integers(4))), len(tested)


@pytest.mark.parametrize("protocol", [BY_PAIR, BY_SEQUENCE])
@pytest.mark.parametrize("seed", range(8))
def test_every_pair_is_tested_once_by_models_that_have_not_seen_it(seed: int, protocol: str) -> None:
    pairs, tested = random_pairs(seed)
    folds = make_folds(protocol, pairs, tested)
    assert sorted(k for fold in folds for k in fold.test) == list(range(tested))
    assert len({fold.name for fold in folds}) == len(folds) > 1
    for fold in folds:
        assert set(fold.train) | set(fold.test) == set(range(len(pairs)))
        assert not set(fold.train) & set(fold.test)
        assert set(range(tested, len(pairs))) <= set(fold.train)
        if protocol == BY_SEQUENCE:
            assert not {pairs[k].sequence for k in fold.train} & {pairs[k].sequence for k in fold.test}
        else:
            assert len(fold.test) == 1


@pytest.mark.parametrize("protocol", [BY_PAIR, BY_SEQUENCE])
@pytest.mark.parametrize("every", [2, 3, 5])
def test_fewer_tests_leave_the_training_as_it_is(every: int, protocol: str) -> None:
    pairs, tested = random_pairs(5)
    whole = {fold.name: fold for fold in make_folds(protocol, pairs, tested)}
    thin = make_folds(protocol, pairs, tested, every)
    assert sorted(k for fold in thin for k in fold.test) == list(range(0, tested, every))
    for fold in thin:
        assert fold.train == whole[fold.name].train
        assert fold.test


@pytest.mark.parametrize(("protocol", "sequences"), [(BY_SEQUENCE, "aaa"), (BY_PAIR, "a")])
def test_one_thing_cannot_be_left_out(protocol: str, sequences: str) -> None:
    with pytest.raises(ValueError, match=f"{protocol}: expected at least 2 to leave out in turn, got 1"):
        make_folds(protocol, make_pairs(*sequences, "x"), len(sequences))


def test_pairs_of_the_same_name_are_refused() -> None:
    twice = [*make_pairs("a", "b"), *make_pairs("c")]
    for protocol in (BY_PAIR, BY_SEQUENCE):
        with pytest.raises(ValueError, match="expected pair names that differ, got twice pair 0"):
            make_folds(protocol, twice, 3)
    assert len(make_folds(BY_SEQUENCE, twice, 2)) == 2  # what is only trained on leaves nothing behind


def test_sequences_named_like_folders_or_each_other_get_folders_of_their_own() -> None:
    sequences = ["a", "a b", "a/b", ".", "..", ""]
    folds = [fold.name for fold in make_folds(BY_SEQUENCE, make_pairs(*sequences), len(sequences))]
    assert folds == [file_name(sequence) for sequence in sequences]
    assert len({*folds}) == len(sequences)


# --- running ------------------------------------------------------------------------------------------------------------------


def folds_of(pairs: list[ScanPair]) -> dict[str, list[Fold]]:
    return {protocol: make_folds(protocol, pairs, len(pairs)) for protocol in (BY_PAIR, BY_SEQUENCE)}


def run(folder: Path, pairs: list[ScanPair], folds: dict[str, list[Fold]]) -> int:
    """Runs what is missing; returns how often the pairs were looked at."""
    looked = []
    run_folds(lambda jobs: looked.append(jobs) or make_study(pairs), folds, RunConfig(), folder, 1)  # type: ignore[func-returns-value]
    assert set(looked) <= {1}
    return len(looked)


def test_finished_folds_are_not_run_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pairs = make_pairs(*"aabc")
    folds, recorder = folds_of(pairs), Recorder()
    recorder.install(monkeypatch)
    assert run(tmp_path, pairs, folds) == 1
    assert sorted(recorder.asked) == sorted(2 * [pair.name for pair in pairs])
    assert recorder.trained == [fold.train for of_protocol in folds.values() for fold in of_protocol]
    assert recorder.variants == [False] * 4 + [True] * 3  # the slow lattice in one protocol alone
    assert run(tmp_path, pairs, folds) == 0
    assert len(recorder.asked) == 8
    (tmp_path / BY_SEQUENCE / "c" / SECONDS).unlink()
    assert run(tmp_path, pairs, folds) == 1
    assert recorder.asked[8:] == ["pair 3"]


def test_a_killed_run_goes_on_where_it_was(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pairs = make_pairs(*"aabbc")
    folds = {BY_SEQUENCE: make_folds(BY_SEQUENCE, pairs, 5)}
    Recorder(fail_at="pair 3").install(monkeypatch)
    with pytest.raises(KeyboardInterrupt):
        run(tmp_path, pairs, folds)
    assert sorted(path.name for path in (tmp_path / BY_SEQUENCE).iterdir()) == ["a"]
    left = tmp_path / BY_SEQUENCE / f".b.{os.getpid()}"  # what a kill in the middle of writing leaves
    (left / "joint").mkdir(parents=True)
    (left / SECONDS).write_text("{}")
    (tmp_path / BY_SEQUENCE / ".c.1").mkdir()
    again = Recorder()
    again.install(monkeypatch)
    run(tmp_path, pairs, folds)
    assert again.asked == ["pair 2", "pair 3", "pair 4"]
    found = read_folds(tmp_path / BY_SEQUENCE, pairs, folds[BY_SEQUENCE])
    assert [prediction.motions[0, 1] for prediction in found.predictions[RIVAL]] == [0, 1, 2, 3, 4]


def test_a_fold_appears_whole_or_not_at_all(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pair = make_pairs("a")[0]
    answers = {pair.name: {method: Answer(guess(pair, 0), 1.0) for method in METHODS[:4]}}
    folder, written = tmp_path / BY_PAIR / "fold", []
    real = cross_validation.write_prediction

    def watch(path: Path, prediction: object) -> None:
        assert not folder.exists()
        if len(written) == fail_at:
            raise KeyboardInterrupt
        written.append(path)
        real(path, prediction)  # type: ignore[arg-type]

    monkeypatch.setattr(cross_validation, "write_prediction", watch)
    fail_at = 2
    with pytest.raises(KeyboardInterrupt):
        write_fold(folder, answers)
    assert not folder.exists()
    written, fail_at = [], -1
    write_fold(folder, answers)
    assert len(list(folder.rglob("*.npz"))) == 4
    assert (folder / SECONDS).is_file()
    assert [path.name for path in folder.parent.iterdir()] == ["fold"]


# --- reading ------------------------------------------------------------------------------------------------------------------


def test_results_are_in_the_order_of_the_pairs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pairs = make_pairs(*"bacab")  # whose folds are b, a, c
    Recorder().install(monkeypatch)
    for every in (1, 2):
        folds = {BY_SEQUENCE: make_folds(BY_SEQUENCE, pairs, 5, every)}
        run(tmp_path / str(every), pairs, folds)
        found = read_folds(tmp_path / str(every) / BY_SEQUENCE, pairs, folds[BY_SEQUENCE])
        expected = list(range(0, 5, every))
        assert [pair.name for pair in found.pairs] == [f"pair {k}" for k in expected]
        assert [prediction.motions[0, 1] for prediction in found.predictions[RIVAL]] == expected
        assert found.seconds == {RIVAL: [0.1 + k for k in expected], JOINT: [1.0 + k for k in expected]}
        assert list(found.predictions) == [RIVAL, JOINT]  # as in METHODS


def test_a_method_that_a_fold_lacks_is_no_row(tmp_path: Path) -> None:
    pairs = make_pairs("a", "b")
    folds = make_folds(BY_PAIR, pairs, 2)
    for k, methods in enumerate([("ICP", JOINT), (JOINT,)]):
        write_fold(tmp_path / folds[k].name, {pairs[k].name: {method: Answer(guess(pairs[k], 0), 1.0) for method in methods}})
    assert list(read_folds(tmp_path, pairs, folds).predictions) == [JOINT]


# --- several processes --------------------------------------------------------------------------------------------------------


def run_rank(folder: Path) -> None:
    """A process of two, with a disk of its own: writes down how many folds it ran."""
    rank, pairs, recorder = os.environ["RANK"], make_pairs(*"aabc"), Recorder()
    recorder.install()
    run_folds(lambda jobs: make_study(pairs), folds_of(pairs), RunConfig(), folder / rank, 1)
    (folder / f"ran_{rank}").write_text(str(len(recorder.trained)))


def test_two_ranks_share_the_folds_and_rank_0_ends_with_all(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pairs = make_pairs(*"aabc")
    folds = folds_of(pairs)
    unfinished = tmp_path / "0" / BY_PAIR / folds[BY_PAIR][1].name / "joint" / "pair_1.npz"  # of a rank 0 that was killed
    unfinished.parent.mkdir(parents=True)
    unfinished.write_bytes(b"half a file")
    assert run_ranks(run_rank, tmp_path) == [0, 0]
    assert [(tmp_path / f"ran_{rank}").read_text() for rank in "01"] == ["4", "3"]
    everything = {(protocol, fold.name) for protocol, of_protocol in folds.items() for fold in of_protocol}
    there = [{(path.parts[-3], path.parts[-2]) for path in (tmp_path / rank).rglob(SECONDS)} for rank in "01"]
    assert there[0] == everything
    assert len(there[1]) == 3
    Recorder().install(monkeypatch)
    assert run(tmp_path / "0", pairs, folds) == 0  # nothing is left to do
    for protocol, of_protocol in folds.items():
        found = read_folds(tmp_path / "0" / protocol, pairs, of_protocol)
        assert [prediction.motions[0, 1] for prediction in found.predictions[RIVAL]] == [0, 1, 2, 3]


def test_cores_are_shared_by_the_processes_of_a_machine(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cross_validation, "cpu_count", lambda: 5)
    assert (cores(3), cores(0)) == (3, 5)
    monkeypatch.setenv("LOCAL_WORLD_SIZE", "2")
    assert (cores(3), cores(0)) == (3, 2)
    monkeypatch.setenv("LOCAL_WORLD_SIZE", "9")
    assert cores(0) == 1
