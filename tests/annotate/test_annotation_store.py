"""The folder of annotations: what lies where, which names it takes, and what is left when the process is killed."""

import glob
import signal
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from forked import begin
from worked import a_change, act, actions, cases, state_of

from torchcrf_scan.annotate.desk import Desk
from torchcrf_scan.annotate.store import Store
from torchcrf_scan.data.dataset import PairFiles
from torchcrf_scan.data.pair_file import read_pair, write_pair

KILLS = 20
ODD = [
    "..",
    ".",
    "",
    "../../outside",
    "/absolute",
    "a/b",
    "a b",
    "a\\b",
    "\x1b[2J",
    "x" * 300,
    "x" * 301,
    "progress.json",
    ".annotate",
]


def found(folder: Path) -> list[str]:
    """What training finds in the folder, by each of the ways to name it."""
    by_glob = [
        sorted(path for path in glob.glob(f"{folder}/{way}", recursive=True) if Path(path).is_file()) for way in ("*", "**/*")
    ]
    by_name = [str(path) for path in PairFiles(folder).paths] if list(folder.glob("*.npz")) else []
    assert by_glob[0] == by_glob[1] == by_name
    return [Path(path).stem for path in by_name]


def test_only_finished_pairs_are_found_by_training(tmp_path: Path) -> None:
    store = Store(tmp_path)
    desk = Desk(cases(), store)
    first = desk.name
    a_change(desk)
    assert found(tmp_path) == []
    assert read_pair(store.unfinished(first)).annotation is not None
    before = store.unfinished(first).read_bytes()
    desk.finish()
    assert found(tmp_path) == [first]
    assert store.finished(first).read_bytes() == before
    assert not store.unfinished(first).exists()
    desk.finish()  # as the model says
    assert len(found(tmp_path)) == 2
    desk.go(-1)
    desk.go(-1)
    assert desk.name == first
    a_change(desk, -2)
    assert first not in found(tmp_path)
    assert first not in desk.progress.done
    assert Desk(cases(), store).progress.done == desk.progress.done
    desk.undo()
    desk.finish()
    assert store.finished(first).read_bytes() == before
    assert len(found(tmp_path)) == 2
    done = desk.progress.done
    (tmp_path / ".annotate" / "progress.json").unlink()
    assert sorted(Desk(cases(), store).progress.done) == sorted(done)


def test_a_pair_without_annotation_is_not_finished(tmp_path: Path) -> None:
    write_pair(tmp_path / "sure.npz", cases()[0].pair)
    desk = Desk(cases(), Store(tmp_path))
    assert desk.progress.done == []
    assert desk.ring[-1] == "sure"
    desk.go(-1)
    desk.finish()
    assert desk.progress.done == ["sure"]
    assert read_pair(tmp_path / "sure.npz").annotation is not None


def test_odd_names_stay_in_the_folder(tmp_path: Path) -> None:
    folder = tmp_path / "outer" / "annotated"
    folder.mkdir(parents=True)
    (tmp_path / "outer" / "kept.npz").write_bytes(b"mine")
    one = cases()[0]
    desk = Desk([replace(one, pair=replace(one.pair, name=name)) for name in ODD], Store(folder))
    for _ in ODD:
        a_change(desk)
        a_change(desk, -2)
        desk.finish()
    assert sorted(desk.progress.done) == sorted(ODD)
    assert len(found(folder)) == len(ODD)
    assert {path for path in tmp_path.rglob("*") if path.is_file() and folder not in path.parents} == {
        tmp_path / "outer" / "kept.npz"
    }
    assert {len(Store(folder).versions(name)) for name in ODD} == {2}
    assert Desk(list(desk.cases.values()), Store(folder)).progress.done == desk.progress.done


def hold(folder: Path) -> None:
    with Store(folder).alone():
        (folder / "held").touch()
        time.sleep(600)


def test_a_second_process_is_refused_until_the_first_is_gone(tmp_path: Path) -> None:
    process = begin(hold, tmp_path)
    try:
        wait_for(tmp_path / "held")
        with (
            pytest.raises(ValueError, match="expected nobody at work here, got another `torchcrf-scan annotate`"),
            Store(tmp_path).alone(),
        ):
            pass
    finally:
        process.kill()
        process.join()
    with Store(tmp_path).alone():
        pass


def work(folder: Path, seed: int) -> None:
    """Changes pairs without end, and notes every change that is acknowledged."""
    desk = Desk(cases(), Store(folder))
    with (folder.parent / "acknowledged").open("ab", buffering=0) as noted:
        for action in actions(seed):
            act(desk, action)
            assert not desk.error
            noted.write(b".")


def wait_for(path: Path) -> None:
    end = time.monotonic() + 60
    while not path.exists():
        assert time.monotonic() < end
        time.sleep(0.005)


@pytest.mark.parametrize("seed", range(KILLS))
def test_killed_at_any_moment(seed: int, tmp_path: Path) -> None:
    folder, twin = tmp_path / "annotated", tmp_path / "twin"
    folder.mkdir(), twin.mkdir()
    process = begin(work, folder, seed)
    wait_for(tmp_path / "acknowledged")
    time.sleep(np.random.default_rng(seed).uniform(0, 0.3))
    process.kill()
    process.join()
    assert process.exitcode == -signal.SIGKILL
    for path in folder.rglob("*.npz"):
        assert read_pair(path).annotation is not None
    desk, stream = Desk(cases(), Store(twin)), actions(seed)
    for _ in range((tmp_path / "acknowledged").stat().st_size):
        act(desk, next(stream))
    states = [state_of(twin)]
    act(desk, next(stream))  # the one in which it was killed
    states.append(state_of(twin))
    again = state_of(folder)
    for name in {*again, *states[0], *states[1]}:
        assert again.get(name) in [state.get(name) for state in states]
    assert Desk(cases(), Store(folder)).name in {case.pair.name for case in cases()}
