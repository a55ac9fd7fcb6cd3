"""Every setting of the package as frozen dataclasses; `configs/*.yaml` and the command line fill them in (jsonargparse)."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class SimulatorConfig:
    """The simulated world, its sensor and its traffic (lengths in metres, angles in degrees, speeds in m/s).

    Attributes:
        scene: `street` (a car among facades, trees and traffic) or `indoor` (a robot among walls, furniture and people).
        beams: beams of the sensor.
        fov: field of view; 360 is a closed scan.
        range_max: farthest return.
        range_noise: standard deviation of a return.
        dropout: share of beams that return nothing although they hit something.
        dt: seconds between the scans of a pair.
        ego_translation: largest travel of the sensor per pair.
        ego_rotation: largest turn of the sensor per pair, radians.
        movers_min, movers_max: number of moving objects.
        vibration: standard deviation of the sensor's pitch and jolts, seen as extra range noise common to neighbouring beams.
    """

    scene: str = "street"
    beams: int = 361
    fov: float = 180.0
    range_max: float = 80.0
    range_noise: float = 0.015
    dropout: float = 0.02
    dt: float = 0.2
    ego_translation: float = 2.0
    ego_rotation: float = 0.15
    movers_min: int = 1
    movers_max: int = 4
    vibration: float = 0.005
