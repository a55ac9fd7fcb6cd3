"""What earlier scans saw where points lie now."""

import numpy as np
from rooms_cast import ROOM, box, scan_at

from torchcrf_scan.stream.memory import Memory
from torchcrf_scan.stream.view import History, View

BOX = box(1.5, -1.0)


def view_at(time: float, *, has_box: bool = False, x: float = 0.0) -> View:
    pose = np.array([0.0, x, 0.0])
    return View.of(scan_at(pose, np.concatenate([ROOM, BOX]) if has_box else ROOM, int(10 * time)), pose, time)


def remembering(*views: View, spacing: float = 0.5, count: int = 6) -> Memory:
    memory = Memory(spacing, count)
    for view in views:
        memory.add(view)
    return memory


def test_a_box_where_free_space_was_has_moved_and_the_walls_have_stood() -> None:
    memory = remembering(*(view_at(0.5 * k, x=0.1 * k) for k in range(4)))
    now = view_at(2.0, has_box=True, x=0.4)
    votes = memory.look(now.grid, now.pose)
    points = now.grid.scan.points + now.pose[1:]
    on_box = (np.abs(points - np.array([1.5, -1.0])) < 0.35).all(1)
    assert on_box.sum() > 10
    assert votes.has_moved[on_box].mean() > 0.8
    assert votes.has_moved[~on_box].mean() < 0.02
    assert votes.has_stood[~on_box].mean() > 0.8
    assert not votes.has_stood[on_box].any()


def test_a_box_that_stays_stops_counting_as_moved() -> None:
    memory = remembering(view_at(0.0), view_at(0.5), *(view_at(1.0 + 0.5 * k, has_box=True) for k in range(3)))
    now = view_at(3.0, has_box=True)
    assert memory.look(now.grid, now.pose).has_moved.mean() < 0.02


def test_an_empty_memory_says_nothing() -> None:
    now = view_at(0.0)
    votes = remembering().look(now.grid, now.pose)
    assert not votes.has_moved.any()
    assert not votes.has_stood.any()


def test_it_keeps_so_many_scans_so_far_apart() -> None:
    memory = remembering(*(view_at(0.1 * k) for k in range(40)), spacing=0.5, count=3)
    now = view_at(4.0)
    assert memory.look(now.grid, now.pose).standing.max() == 3
    memory.clear()
    assert memory.look(now.grid, now.pose).standing.max() == 0


def test_history_gives_the_newest_scan_that_is_old_enough_and_forgets_older_ones() -> None:
    history = History(10)
    for k in range(8):
        history.add(view_at(0.1 * k), 0.25)
    assert len(history) == 4
    assert history.last.time == 0.7 or abs(history.last.time - 0.7) < 1e-9
    np.testing.assert_allclose([history.before(time).time for time in (0.8 - 0.25, 0.4, -1.0)], [0.5, 0.4, 0.4])
    short = History(2)
    for k in range(8):
        short.add(view_at(0.1 * k), 0.25)
    assert len(short) == 2
