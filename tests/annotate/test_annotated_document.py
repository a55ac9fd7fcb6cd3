"""What may be done to an annotation: pure functions, taken back and written without loss."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from torchcrf_scan.annotate.document import (
    MOST_MOVERS,
    UNKNOWN,
    Document,
    annotated,
    annotation_of,
    assign,
    blank,
    drag,
    fit_again,
    mend,
    new_mover,
    proposed,
    surface,
    with_metric,
)
from torchcrf_scan.annotate.fit import FOLLOWS, Scans
from torchcrf_scan.annotate.history import History
from torchcrf_scan.data.pair_file import read_pair, write_pair
from torchcrf_scan.geometry import se2
from torchcrf_scan.scan import OUTLIER, PairPrediction, Scan, ScanPair

EGO, STEP = np.array([0.02, -0.3, 0.05]), np.array([-0.05, 0.2, -0.4])  # of the background and of the box


def made_pair(seed: int = 0, *, source: bool = True, target: bool = True) -> ScanPair:
    """A room's corner and a box that moves, each point of it seen again; some beams without return."""
    rng = np.random.default_rng(seed)
    line = np.linspace(-1, 1, 30)
    walls = np.concatenate([np.stack([6 + 0 * line, 4 * line], -1), np.stack([3 + 2 * line, 5 + 0 * line], -1)])
    box = np.concatenate([np.stack([3 + 0 * line, 0.8 * line], -1), np.stack([3.5 + 0.5 * line, 0.8 + 0 * line], -1)])
    first = np.concatenate([walls, box]) + rng.normal(0, 0.003, (120, 2))
    second = np.concatenate([se2.apply(EGO, first[:60]), se2.apply(STEP, first[60:])]) + rng.normal(0, 0.003, (120, 2))
    scans = []
    for points, is_seen in ((first, source), (second, target)):
        ranges = np.hypot(*points.T) if is_seen else np.full(120, np.nan)
        ranges[[4, 70]] = np.nan
        scans.append(Scan.from_ranges(ranges, np.arctan2(points[:, 1], points[:, 0]), range_noise=0.003))
    return ScanPair(*scans, 0.1, name="made", sequence="room")


PAIR = made_pair()
SCANS = Scans.of(PAIR)
IS_BOX = PAIR.source.beam >= 60


def labelled() -> Document:
    """As an annotator would do it from nothing."""
    document = assign(blank(SCANS), np.flatnonzero(~IS_BOX), 0)
    return assign(document, np.flatnonzero(IS_BOX), new_mover(document))


def assert_same(a: Document, b: Document) -> None:
    for name in ("label", "mended", "held", "association"):
        assert np.array_equal(getattr(a, name), getattr(b, name)), name
    np.testing.assert_allclose(a.motions, b.motions, atol=1e-6)


@pytest.mark.parametrize("is_line", [True, False])
def test_motions_and_associations_follow_from_the_labels(is_line: bool) -> None:
    document = with_metric(labelled(), is_line)
    assert document.label.tolist() == np.where(IS_BOX, 1, 0).tolist()
    for found, true, points in zip(document.motions, (EGO, STEP), (SCANS.source[~IS_BOX], SCANS.source[IS_BOX]), strict=True):
        apart = np.linalg.norm(se2.apply(found, points) - se2.apply(true, points), axis=-1)
        assert apart.mean() < 0.02
    partner = PAIR.target.beam[document.association]
    assert np.mean(partner == PAIR.source.beam) > 0.9
    assert not document.held.any()


def test_a_dragged_motion_is_held_until_it_is_fitted_again() -> None:
    document = labelled()
    pulled = drag(document, 1, np.array([0.1, 0.5, 0.0]))
    before, after = document.moved[IS_BOX], pulled.moved[IS_BOX]
    np.testing.assert_allclose(after.mean(0) - before.mean(0), [0.5, 0.0], atol=1e-9)
    assert se2.wrap(pulled.motions[1, 0] - document.motions[1, 0]) == pytest.approx(0.1)
    assert pulled.held.tolist() == [False, True]
    assert np.array_equal(pulled.moved[~IS_BOX], document.moved[~IS_BOX])
    kept = assign(pulled, np.flatnonzero(IS_BOX)[:5], OUTLIER)
    assert np.array_equal(kept.motions, pulled.motions)
    again = fit_again(pulled, 1)
    assert not again.held.any()
    np.testing.assert_allclose(again.motions, document.motions, atol=1e-3)


def test_associations_can_be_mended_and_released() -> None:
    document = labelled()
    point = np.flatnonzero(IS_BOX)[:2]
    other = int(document.association[point[0]]) + 1
    mended = mend(document, point, np.array([other]))
    assert (mended.association[point] == other).all()
    assert (mend(document, point, np.array([OUTLIER])).association[point] == OUTLIER).all()
    assert annotation_of(mend(document, point, np.array([OUTLIER]))).body[PAIR.source.beam[point]].tolist() == [1, 1]
    assert_same(mend(mended, point, np.array([FOLLOWS])), document)
    assert (assign(mended, point, 0).mended == FOLLOWS).all()
    unknown = assign(document, point, UNKNOWN)
    assert mend(unknown, point, np.array([other])).association[point].tolist() == [OUTLIER, OUTLIER]


def test_movers_are_numbered_from_the_first_free_number_up_to_the_last() -> None:
    document = labelled()
    assert new_mover(document) == 2
    gone = assign(document, np.flatnonzero(IS_BOX), UNKNOWN)
    assert np.isnan(gone.motions[1]).all()
    assert gone.movers == []
    assert new_mover(gone) == 1
    for number in range(1, MOST_MOVERS + 1):
        gone = assign(gone, np.array([number]), new_mover(gone))
    assert gone.movers == list(range(1, MOST_MOVERS + 1))
    with pytest.raises(ValueError, match="expected a mover up to 30, got 31"):
        assign(gone, np.array([0]), new_mover(gone))
    assert_same(annotated(SCANS, annotation_of(gone)), replace(gone, held=annotated(SCANS, annotation_of(gone)).held))


def test_a_surface_is_what_is_connected() -> None:
    scan = Scan.from_ranges([2.0] * 10 + [5.0] * 10, np.linspace(0, 0.5, 20), range_noise=0.01)
    document = blank(Scans.of(ScanPair(scan, scan)))
    assert surface(document, np.array([3])).tolist() == list(range(10))
    assert surface(document, np.array([3, 15])).tolist() == list(range(20))
    assert len(surface(document, np.zeros(0, np.int64))) == 0


ACTIONS = st.one_of(
    st.tuples(st.just("assign"), st.integers(-2, 3), st.lists(st.integers(0, 117), max_size=12)),
    st.tuples(st.just("drag"), st.integers(0, 2), st.lists(st.floats(-0.3, 0.3), min_size=3, max_size=3)),
    st.tuples(st.just("mend"), st.integers(-2, 117), st.lists(st.integers(0, 117), max_size=12)),
    st.tuples(st.just("fit"), st.integers(0, 2), st.just([])),
)


def act(document: Document, action: tuple[str, int, list[float]]) -> Document:
    kind, number, values = action
    if kind == "assign":
        return assign(document, np.array(values, np.int64), min(number, new_mover(document)))
    if kind == "mend":
        return mend(document, np.array(values, np.int64), np.array([number]))
    cluster = min(number, len(document.motions) - 1)
    return drag(document, cluster, np.array(values)) if kind == "drag" else fit_again(document, cluster)


@settings(max_examples=20)
@given(actions=st.lists(ACTIONS, max_size=6))
def test_whatever_is_done_can_be_undone_and_written(actions: list, tmp_path_factory: pytest.TempPathFactory) -> None:
    history = History(labelled())
    states = [history.present]
    for action in actions:
        history = history.do(act(history.present, action))
        states.append(history.present)
    for expected in reversed(states):
        assert history.present is expected
        history = history.undo()
    for expected in states:
        assert history.present is expected
        history = history.redo()
    path = tmp_path_factory.getbasetemp() / "made.npz"
    annotation = annotation_of(history.present)
    write_pair(path, replace(PAIR, annotation=annotation))
    back = read_pair(path).annotation
    assert back is not None
    again = annotation_of(annotated(SCANS, back))
    for name in ("association", "cluster", "motions", "body", "ignore"):
        assert np.array_equal(getattr(annotation, name), getattr(back, name), equal_nan=name == "motions"), name
        assert np.array_equal(getattr(annotation, name), getattr(again, name), equal_nan=name == "motions"), name


def test_a_new_state_forgets_what_was_undone() -> None:
    history = History("a").do("b").undo().do("c")
    assert history.redo().present == "c"
    assert history.undo().present == history.undo().undo().present == "a"


@pytest.mark.parametrize("seen", [(False, True), (True, False), (False, False)])
def test_scans_without_points(seen: tuple[bool, bool], tmp_path: Path) -> None:
    pair = made_pair(source=seen[0], target=seen[1])
    document = blank(Scans.of(pair))
    points = np.arange(len(pair.source))
    document = drag(assign(document, points, 1), 1, np.array([0.1, 0.2, 0.3]))
    document = mend(fit_again(document, 0), points, np.array([FOLLOWS]))
    assert (document.association == OUTLIER).all()
    write_pair(tmp_path / "a.npz", replace(pair, annotation=annotation_of(document)))
    back = read_pair(tmp_path / "a.npz").annotation
    assert back is not None
    assert (back.association == OUTLIER).all()
    assert annotated(document.scans, back).label.tolist() == [1] * len(points)


def test_all_unknown_is_all_ignored() -> None:
    annotation = annotation_of(blank(SCANS))
    assert annotation.ignore.all()
    assert (annotation.association == OUTLIER).all()
    assert annotated(SCANS, annotation).label.tolist() == [UNKNOWN] * len(SCANS.source)


def test_the_proposal_is_the_models_answer() -> None:
    truth = annotation_of(labelled())
    ones = np.ones(120)
    motions = np.stack([EGO, STEP]) + 0.001
    prediction = PairPrediction(truth.association, truth.cluster, motions, ones, ones, True)
    document = proposed(SCANS, prediction)
    assert np.array_equal(document.motions, motions)
    assert document.label.tolist() == truth.cluster[PAIR.source.beam].tolist()
    assert document.held.all()
    assert_same(annotated(SCANS, annotation_of(document)), document)
    changed = assign(document, np.flatnonzero(IS_BOX)[:5], OUTLIER)
    assert np.array_equal(changed.motions, motions)
    np.testing.assert_allclose(fit_again(changed, 1).motions[1], labelled().motions[1], atol=5e-3)
    assert assign(changed, np.flatnonzero(IS_BOX)[:5], new_mover(changed)).held.tolist() == [True, True, False]


def test_a_pair_annotated_as_its_truth_says_gives_the_truth(pairs: list[ScanPair]) -> None:
    """From the true motions with an error of centimetres: a model's answer."""
    rng = np.random.default_rng(0)
    for pair in pairs:
        truth, beam = pair.annotation, pair.source.beam
        assert truth is not None
        scans = Scans.of(pair)
        body = np.where(truth.ignore, UNKNOWN, truth.body)[beam]
        nothing = np.full(pair.source.n_beams, OUTLIER)
        start = truth.motions + rng.normal(0, [0.002, 0.02, 0.02], truth.motions.shape)
        document = proposed(scans, PairPrediction(nothing, nothing, start, nothing + 1.0, nothing + 1.0, True))
        for k in np.unique(body).tolist():
            document = assign(document, np.flatnonzero(body == k), k)
        assert document.label.tolist() == body.tolist()
        found = annotation_of(document)
        is_known = ~truth.ignore
        assert np.array_equal(found.body[is_known], truth.body[is_known])
        assert np.mean(found.association[is_known] == truth.association[is_known]) > 0.8
        for k in np.unique(body[body >= 0]).tolist():
            points = scans.source[body == k]
            apart = np.linalg.norm(se2.apply(found.motions[k], points) - se2.apply(truth.motions[k], points), axis=-1)
            assert apart.mean() < (0.1 if len(points) > 20 else 0.3)
