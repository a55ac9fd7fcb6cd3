"""Scores of simulated drives: of the truth itself, and of the truth with one thing wrong."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from torchcrf_scan.data.drive import Drive, DriveScan, simulate_drive
from torchcrf_scan.data.worlds import NAMED_WORLDS, every
from torchcrf_scan.evaluation.drives import drive_scores
from torchcrf_scan.result import MovingObject, ScanResult

pytest.importorskip("trackeval", reason="needs trackeval (extra tracking)")


@pytest.fixture(scope="module")
def drive() -> Drive:
    return simulate_drive(replace(every(NAMED_WORLDS["street"], 0.1), movers_min=3), 30, 3)


def the_truth(scan: DriveScan) -> ScanResult:
    """What a stream would say that knows everything but what it does not see."""
    objects = tuple(
        MovingObject(of.number, of.position, of.velocity, np.eye(4), of.heading, of.extent, of.points, 1.0)
        for of in scan.objects
        if of.points
    )
    none, eye = np.zeros(3), np.eye(3)
    return ScanResult(scan.scan, scan.stamp, scan.pose, eye, none, eye, scan.moving, scan.body, objects, "ok", "")


def scores(drive: Drive, change: Callable[[int, ScanResult], ScanResult] = lambda i, result: result) -> dict[str, float]:
    return drive_scores([drive], [[change(i, the_truth(scan)) for i, scan in enumerate(drive)]])


def test_the_truth_is_right(drive: Drive) -> None:
    found = scores(drive)
    perfect = ("hota", "mota", "idf1", "movers_found", "hota_position", "mota_position")
    assert {key: found[key] for key in perfect} == pytest.approx(dict.fromkeys(perfect, 100.0))
    wrong = ("id_switches", "velocity_error", "false_moving", "path_error")
    assert {key: found[key] for key in wrong} == pytest.approx(dict.fromkeys(wrong, 0.0), abs=1e-9)
    assert found["movers"] == found["sightings"] > 30


def test_other_numbers_halfway_switch_but_are_found(drive: Drive) -> None:
    def renumbered(i: int, result: ScanResult) -> ScanResult:
        if i < 15:
            return result
        objects = tuple(replace(of, number=of.number + 100) for of in result.objects)
        return replace(result, track=np.where(result.track > 0, result.track + 100, result.track), objects=objects)

    found = scores(drive, renumbered)
    assert found["movers_found"] == 100
    assert found["id_switches"] >= 2
    assert found["hota"] < 90


def test_what_is_not_confirmed_is_found_but_not_tracked(drive: Drive) -> None:
    found = scores(drive, lambda i, result: replace(result, objects=()))
    assert (found["movers_found"], found["recall"], found["hota"]) == (100, 0, 0)
    assert np.isnan(found["velocity_error"])


def test_velocities_are_compared_in_the_axes_of_the_sensor(drive: Drive) -> None:
    def turned(i: int, result: ScanResult) -> ScanResult:
        quarter = np.array([[0.0, -1.0], [1.0, 0.0]])
        objects = tuple(replace(of, velocity=quarter @ of.velocity) for of in result.objects)
        return replace(result, objects=objects, pose=result.pose + np.array([np.pi / 2, 0, 0]))

    assert scores(drive, turned)["velocity_error"] == pytest.approx(0, abs=1e-9)

    def faster(i: int, result: ScanResult) -> ScanResult:
        objects = tuple(replace(of, velocity=of.velocity + np.array([0.3, 0.4])) for of in result.objects)
        return replace(result, objects=objects)

    assert scores(drive, faster)["velocity_error"] == pytest.approx(0.5)


def test_background_that_moves_and_a_path_that_is_too_long(drive: Drive) -> None:
    found = scores(drive, lambda i, result: replace(result, moving=np.ones_like(result.moving), pose=1.01 * result.pose))
    assert found["false_moving"] == 100
    assert 0.05 < found["path_error"] < 0.3


def test_results_of_another_drive(drive: Drive) -> None:
    with pytest.raises(ValueError, match="results: expected one per scan of 1 drives"):
        drive_scores([drive], [[the_truth(drive[0])]])
