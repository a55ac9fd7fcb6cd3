"""Pairs that a stream labels: they say what is true, they leave out what is not sure, and they train a model."""

import weakref
from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose
from rooms_cast import ROOM, box, ranges_at

from torchcrf_scan import JointScanCRF
from torchcrf_scan.baselines.cloud import Cloud
from torchcrf_scan.data.reading import Reading
from torchcrf_scan.geometry import se2
from torchcrf_scan.learning import self_labelled
from torchcrf_scan.learning.leaks import TrainedOn
from torchcrf_scan.learning.material import Material
from torchcrf_scan.learning.own_laser import calibrate_on
from torchcrf_scan.learning.self_labelled import Seen, label, label_readings, label_recordings, weighted
from torchcrf_scan.learning.settings import Config, DataConfig, LearningConfig
from torchcrf_scan.learning.trainer import train
from torchcrf_scan.result import MovingObject, ScanResult
from torchcrf_scan.scan import BACKGROUND, OUTLIER, Annotation, Bools, Floats, Scan, ScanPair
from torchcrf_scan.stream.placement import grid_at

BEAMS = np.radians(np.arange(-135, 135, 1.5))
SCANS, STEP, SPEED = 24, 0.1, 1.2  # seconds between scans; m/s of the box


def box_at(time: float, lasts: float = np.inf) -> Floats:
    """(4, 4) segments of a square that goes along y, until it is taken away."""
    return box(3.0, -2.0 + SPEED * time, 0.35)[: 4 if time < lasts else 0]


def pose_at(k: int) -> Floats:
    return np.array([0.01 * k, 0.03 * k, 0.0])


def drive(lasts: float = np.inf, first: float = 0.0) -> list[Reading]:
    """A sensor that goes through a room in which a box moves between two times."""
    rng, readings = np.random.default_rng(0), []
    for k in range(SCANS):
        time = STEP * k
        segments = np.concatenate([ROOM, box_at(time, lasts)[: 4 if time >= first else 0]])
        ranges = ranges_at(pose_at(k), segments, BEAMS) + rng.normal(0, 0.005, len(BEAMS))
        readings.append(Reading(Scan.from_ranges(ranges, BEAMS, range_noise=0.005), time))
    return readings


def is_box(pair: ScanPair) -> Bools:
    """(n_beams,) what truly moves in the source."""
    k = int(pair.name[-5:]) - 4  # the pair is named by the last of its four scans, 2 apart
    return ranges_at(pose_at(k), box_at(STEP * k), BEAMS) < ranges_at(pose_at(k), ROOM, BEAMS)


@cache
def shipped() -> JointScanCRF:
    return JointScanCRF.from_pretrained("simulated")


@cache
def labelled() -> tuple[ScanPair, ...]:
    return tuple(weighted(shipped(), label_readings(shipped(), drive(), 100, 2 * STEP, "room")))


def known(pair: ScanPair) -> Bools:
    assert pair.annotation is not None
    return ~pair.annotation.ignore


def test_the_labels_are_true() -> None:
    pairs = labelled()
    assert len(pairs) >= 6
    agree = total = found = 0
    for pair in pairs:
        truth = pair.annotation
        assert truth is not None
        told = known(pair) & (truth.body >= BACKGROUND)
        agree += int(((truth.body > 0) == is_box(pair))[told].sum())
        total += int(told.sum())
        found += int((truth.body[is_box(pair)] > 0).sum())
        assert pair.dt == pytest.approx(2 * STEP)
    assert agree > 0.98 * total
    assert found > 0.5 * sum(int(is_box(pair).sum()) for pair in pairs)


def test_the_motions_are_true() -> None:
    for pair in labelled():
        truth, k = pair.annotation, int(pair.name[-5:]) - 4
        assert truth is not None
        background = se2.compose(se2.inverse(pose_at(k + 2)), pose_at(k))
        assert_allclose(truth.motions[0], background, atol=0.02)
        for number in range(1, len(truth.motions)):
            mine = pair.source.points[truth.body[pair.source.beam] == number].mean(0)[None]
            going = se2.apply(pose_at(k + 2), se2.apply(truth.motions[number], mine)) - se2.apply(pose_at(k), mine)
            assert_allclose(going[0], [0.0, SPEED * pair.dt], atol=0.08)


def test_associations_follow_from_the_motions() -> None:
    for pair in labelled():
        truth = pair.annotation
        assert truth is not None
        beam = np.flatnonzero(truth.association >= 0)
        assert ((truth.cluster == OUTLIER) == (truth.association == OUTLIER)).all()
        source, target = np.zeros((len(BEAMS), 2)), np.zeros((len(BEAMS), 2))
        source[pair.source.beam], target[pair.target.beam] = pair.source.points, pair.target.points
        moved = np.stack([se2.apply(truth.motions[truth.cluster[b]], source[b][None])[0] for b in beam])
        assert np.hypot(*(moved - target[truth.association[beam]]).T).max() < 0.5


def test_weights_are_the_model_s_confidence_in_what_is_known() -> None:
    for pair, answer in zip(labelled(), shipped().match_pairs(labelled()), strict=True):
        assert pair.annotation is not None
        beam = pair.source.beam
        expected = (answer.cluster_confidence[beam] * known(pair)[beam]).mean()
        assert pair.annotation.weight == pytest.approx(expected)
        assert 0 < pair.annotation.weight <= 1


def test_what_is_seen_in_less_than_three_scans_is_no_mover() -> None:
    """A box that appears for a quarter of a second is ignored, or an outlier; without any box nothing moves."""
    for readings in (drive(lasts=1.25, first=1.0), drive(lasts=0.0)):
        for pair in label_readings(shipped(), readings, 100, 2 * STEP, "room"):
            assert pair.annotation is not None
            assert (pair.annotation.body <= BACKGROUND).all()


def test_pairs_are_spread_evenly_and_no_more_than_asked() -> None:
    few = label_readings(shipped(), drive(), 3, 2 * STEP, "room")
    numbers = [int(pair.name[-5:]) for pair in few]
    assert len(few) == 3
    assert numbers == sorted(set(numbers))
    assert {pair.name for pair in few} <= {pair.name for pair in labelled()}
    assert numbers[-1] - numbers[0] >= SCANS // 3


@pytest.mark.parametrize("count", [0, 1, 3])
def test_a_recording_too_short_gives_none(count: int) -> None:
    assert label_readings(shipped(), drive()[:count], 5, STEP, "room") == []
    assert weighted(shipped(), []) == []


def test_blind_scans_give_none() -> None:
    blind = [replace(reading, scan=Scan.from_ranges(np.zeros(len(BEAMS)), BEAMS)) for reading in drive()]
    assert label_readings(shipped(), blind, 5, STEP, "room") == []


def test_a_recording_is_read_whole(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[tuple[str, int, float]] = []

    def note(model: JointScanCRF, readings: Sequence[Reading], most: int, seconds: float, sequence: str) -> list[ScanPair]:
        asked.append((sequence, len(list(readings)), seconds))
        return []

    monkeypatch.setattr(self_labelled, "label_readings", note)
    path = tmp_path / "hall.csv"
    path.write_text("stamp,0.0,0.1\n0.0,1,2\n0.1,1,2\n")
    assert label_recordings(shipped(), [path], 5, 0.2) == []
    assert asked == [("hall", 2, 0.2)]
    with pytest.raises(FileNotFoundError, match=r"none\.log"):
        label_recordings(shipped(), [tmp_path / "none.log"], 5, 0.2)


def test_a_model_is_fitted_to_them_beside_annotated_pairs_and_alone() -> None:
    """The distance of outliers and the confidences are never learned from labels that the model gave itself."""
    certain = [replace(pair, annotation=pair.annotation and replace(pair.annotation, weight=1.0)) for pair in labelled()[:2]]
    _, parts = calibrate_on(shipped(), certain, also=labelled()[2:])
    assert [part.name for part in parts] == ["outlier distance", "scales", "movers' worth", "confidences"]
    _, parts = calibrate_on(shipped(), [], also=labelled())
    assert [part.name for part in parts] == ["scales", "movers' worth"]


def test_material_tells_how_much_its_pairs_count() -> None:
    pairs = labelled()[:3]
    counts = Material(None, None, 0, pairs).counts  # type: ignore[arg-type]  # the pairs alone matter
    assert_allclose(counts.numpy(), [pair.annotation.weight for pair in pairs if pair.annotation], rtol=1e-6)
    bare = Material(None, None, 0, (replace(pairs[0], annotation=None),)).counts  # type: ignore[arg-type]
    assert bare.tolist() == [1.0]


# --- one window of four scans, whose results are made by hand ---------------------------------------------------------------------

PATH = [np.array([0.05 * k, 0.3 * k, 0.1 * k]) for k in range(4)]  # farther from scan to scan than any gate
CENTRES = [np.array([3.0, -2.0 + 0.4 * k]) for k in range(4)]


def seen(k: int, centre: Floats | None) -> Seen:
    """Scan k, with a box whose returns the stream calls object 7."""
    segments = ROOM if centre is None else np.concatenate([ROOM, box_at(0.0)[:4] + np.tile(centre - [3.0, -2.0], 2)])
    ranges = ranges_at(PATH[k], segments, BEAMS)
    is_on_box = ranges < ranges_at(PATH[k], ROOM, BEAMS)
    scan = Scan.from_ranges(ranges, BEAMS, range_noise=0.005)
    track = scan.to_beams(np.where(is_on_box[scan.beam], 7, BACKGROUND), OUTLIER)
    mover = MovingObject(7, CENTRES[k], np.array([0.0, 2.0]), np.eye(4), 0.0, (0.7, 0.7), int(is_on_box.sum()), 1.0)
    empty = np.zeros(3), np.eye(3)
    result = ScanResult(scan, 0.2 * k, PATH[k], np.eye(3), *empty, track > 0, track, (mover,), "ok", "")
    return Seen(result, grid_at(scan, scan.points), track[scan.beam], 0.2 * k)


def annotation_of(*scans: Seen) -> Annotation:
    pair = label(scans, "room", "pair")
    assert pair is not None
    assert pair.annotation is not None
    return pair.annotation


def test_a_window_is_labelled_by_its_four_scans() -> None:
    scans = [seen(k, CENTRES[k]) for k in range(4)]
    found = annotation_of(*scans)
    moves = scans[1].result.moving
    assert ((found.body > 0) == moves).all()
    assert not found.ignore[moves].any()
    background = se2.compose(se2.inverse(PATH[2]), PATH[1])
    assert_allclose(found.motions[0], background, atol=0.01)
    beam = np.flatnonzero(found.association >= 0)
    assert len(beam) > 0.8 * len(BEAMS)
    source, target = (of.result.scan for of in scans[1:3])
    gate = 3.2 * (np.median(Cloud.of(target).spacing) / 2 + 0.01)
    for body in (0, 1):
        mine = beam[found.cluster[beam] == body]
        moved = se2.apply(found.motions[body], source.to_beams(source.points, 0.0)[mine])
        apart = np.hypot(*(moved - target.to_beams(target.points, 0.0)[found.association[mine]]).T)
        assert len(mine)
        assert apart.max() <= gate + 1e-9


@pytest.mark.parametrize(
    "others",
    [(None, None), (np.array([3.0, -2.9]), np.array([3.0, -2.9])), (CENTRES[0], None)],
    ids=["seen in two scans", "goes back and forth", "seen in three scans"],
)
def test_a_mover_must_go_on_alike_in_three_scans(others: tuple[Floats | None, Floats | None]) -> None:
    scans = [seen(0, others[0]), seen(1, CENTRES[1]), seen(2, CENTRES[2]), seen(3, others[1])]
    found, moves = annotation_of(*scans), scans[1].result.moving
    is_mover = others[0] is CENTRES[0]
    assert ((found.body[moves] > 0) == is_mover).all()
    assert (found.ignore[moves] == (not is_mover)).all()


def standing(*spurious: int) -> list[Seen]:
    """Four scans from one place, some with a return at 1 m on the first beam."""
    scans = []
    for k in range(4):
        ranges = ranges_at(PATH[1], ROOM, BEAMS)
        ranges[0] = 1.0 if k in spurious else ranges[0]
        scan = Scan.from_ranges(ranges, BEAMS, range_noise=0.005)
        track = scan.to_beams(np.full(len(scan), BACKGROUND), OUTLIER)
        result = replace(seen(1, None).result, scan=scan, track=track, moving=track > 0, objects=())
        scans.append(Seen(result, grid_at(scan, scan.points), track[scan.beam], 0.2 * k))
    return scans


def test_a_surface_must_be_met_in_two_other_scans() -> None:
    """A return that no other scan explains is an outlier, one that a single other scan explains is ignored."""
    alone = annotation_of(*standing(1))
    assert (alone.body[0], alone.association[0], alone.ignore[0]) == (OUTLIER, OUTLIER, False)
    assert annotation_of(*standing(1, 3)).ignore[0]
    assert annotation_of(*standing(0, 1, 2, 3)).body[0] == BACKGROUND


def test_what_the_target_does_not_see_has_no_counterpart() -> None:
    scans = standing()
    gone = scans[2].result.scan.only(np.abs(scans[2].result.scan.beam - 90) > 15)
    track = gone.to_beams(np.full(len(gone), BACKGROUND), OUTLIER)
    scans[2] = Seen(replace(scans[2].result, scan=gone, track=track), grid_at(gone, gone.points), track[gone.beam], 0.4)
    found = annotation_of(*scans)
    assert (found.association[80:100] == OUTLIER).all()
    assert (found.body[80:100] == BACKGROUND).all()
    assert (found.association[[0, 40, 130, 179]] >= 0).all()


def test_an_object_that_is_not_met_where_it_goes_is_ignored() -> None:
    scans = [seen(k, CENTRES[k] + [1.5 * (k == 2), 0.0]) for k in range(4)]
    found = annotation_of(*scans)
    assert found.ignore[scans[1].result.moving].all()


def test_memory_is_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    class Made:
        pass

    alive: weakref.WeakSet[Made] = weakref.WeakSet()
    most = 0

    def make(*_: object) -> Made:
        nonlocal most
        made = Made()
        alive.add(made)
        most = max(most, len(alive))
        return made

    monkeypatch.setattr(self_labelled, "label", make)
    assert len(label_readings(shipped(), drive(), 2, STEP, "room")) == 2
    assert 3 <= most <= 6


def test_the_command_trains_on_a_recording(tmp_path: Path) -> None:
    log, readings = tmp_path / "hall.csv", drive()
    rows = [",".join(map(str, [of.stamp, *of.scan.to_beams(of.scan.ranges, 0.0)])) for of in readings]
    log.write_text("\n".join([",".join(["stamp", *map(str, BEAMS)]), *rows]) + "\n")
    config = Config(
        data=DataConfig(simulate_train=(), simulate_test=(), unlabelled=str(log)),
        init="simulated",
        output=str(tmp_path / "run"),
        learning=LearningConfig(max_steps=2),
        compare_chains=False,
    )
    assert train(config) == {"joint": []}
    assert TrainedOn.of_model(str(tmp_path / "run" / "model")).sequences[:1] == ("hall",)
