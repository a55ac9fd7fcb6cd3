"""Results of a stream that makes no mistake, on a simulated drive; and a CARMEN log of one."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

from torchcrf_scan.data.drive import Drive, simulate_drive
from torchcrf_scan.data.worlds import SimulatorConfig
from torchcrf_scan.geometry import se2
from torchcrf_scan.result import MovingObject, ScanResult
from torchcrf_scan.scan import Floats, Scan

SMALL = SimulatorConfig(beams=91, movers_min=2, movers_max=3)


def true_results(scans: int, seed: int = 0, config: SimulatorConfig = SMALL) -> list[ScanResult]:
    """The true results of a drive."""
    return list(results_of(simulate_drive(config, scans, seed), config.dt))


def results_of(drive: Drive, dt: float) -> Iterator[ScanResult]:
    before = drive[0].pose
    for one in drive:
        twist, before = se2.compose(se2.inverse(before), one.pose) / dt, one.pose
        objects = tuple(
            MovingObject(of.number, of.position, of.velocity, 0.01 * np.eye(4), of.heading, of.extent, of.points, 1.0)
            for of in one.objects
        )
        small = 1e-4 * np.eye(3)
        yield ScanResult(one.scan, one.stamp, one.pose, small, twist, small, one.moving, one.body, objects, "ok", "")


class FakeStream:
    """A stream that stands still and finds every third beam moving; a scan that is `bad` has no result."""

    def __init__(self, bad: tuple[int, ...] = ()) -> None:
        self.bad, self.fed, self.odometry = bad, 0, list[Floats | None]()

    def feed(self, scan: Scan, stamp: float, odometry: Floats | None = None) -> ScanResult:
        self.fed += 1
        self.odometry.append(odometry)
        if self.fed in self.bad:
            raise ValueError(f"scan {self.fed} is bad")
        moving = scan.to_beams(np.ones(len(scan), dtype=bool), False) & (np.arange(scan.n_beams) % 3 == 0)
        one = MovingObject(1, np.array([2.0, 1.0]), np.array([0.0, 1.0]), np.eye(4), 0.5 * np.pi, (1.0, 0.5), 5, 1.0)
        pose, small = np.array([0.0, 0.1 * self.fed, 0.0]), 1e-4 * np.eye(3)
        return ScanResult(scan, stamp, pose, small, np.zeros(3), small, moving, np.where(moving, 1, 0), (one,), "ok", "")


def carmen_log(path: Path, scans: int = 30, fault: bool = False) -> Path:
    """A log of a room 8 m wide, a scan every tenth of a second; with a fault the last line is cut."""
    bearings = -np.pi / 2 + np.pi / 60 * np.arange(60)
    lines = ["# made up\n", "PARAM robot_frontlaser_offset 0.1\n"]
    for k in range(scans):
        ranges = np.minimum(4 / np.maximum(np.abs(np.sin(bearings)), 1e-6), (12 - 0.1 * k) / np.maximum(np.cos(bearings), 1e-6))
        ranges[7] = 81.9
        odometry = f"{0.1 * k:.3f} 0 0 {0.1 * k:.3f} 0 0 {100 + 0.1 * k:.3f} host {100 + 0.1 * k:.3f}"
        lines.append(f"FLASER 60 {' '.join(f'{value:.2f}' for value in ranges)} {odometry}\n")
    lines.append("TAIL kept\n")
    path.write_text("".join(lines) + ("FLASER 60 1.0 2.0" if fault else ""))
    return path


def lost(result: ScanResult, reason: str) -> ScanResult:
    return replace(result, status="lost", reason=reason)
