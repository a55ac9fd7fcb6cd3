"""."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace


@dataclass(frozen=True)
class SimulatorConfig:
    """The simulated world, its sensor and its traffic (lengths in metres, speeds in m/s).

    Attributes:
        scene: `street` (a car among facades, trees and traffic) or `indoor` (a robot among walls, furniture and people).
        beams: beams of the sensor.
        fov: field of view, degrees; 360 is a closed scan.
        range_min: nearest return.
        range_max: farthest return.
        range_noise: standard deviation of a return.
        dropout: share of beams that return nothing although they hit something.
        mixed_pixels: share of the depth edges where a beam returns a range between the near and the far surface.
        vibration: standard deviation of the sensor's pitch and jolts, seen as extra range noise common to neighbouring beams.
        dt: seconds between the scans of a pair.
        ego_translation: largest travel of the sensor per pair, before `scale`; indoors never more than 1.5 m/s.
        ego_rotation: largest turn of the sensor per pair, radians.
        movers_min: least number of moving objects; a pair has fewer where some are out of sight.
        movers_max: largest number of moving objects.
        clutter: amount of hedges, bushes and low crowns, whose returns are not repeatable; 2 is an ordinary street.
        dominant_mover: probability that a truck drives beside the sensor and fills 40 to 50 % of the returns of a sequence.
        aperture: probability that a car is seen along one side only and slides along it.
        scale: factor on the whole world and on every motion, but not on the sensor; 0.1 imitates 1:10 model cars.
    """

    scene: str = "street"
    beams: int = 361
    fov: float = 180.0
    range_min: float = 0.1
    range_max: float = 80.0
    range_noise: float = 0.015
    dropout: float = 0.02
    mixed_pixels: float = 0.12
    vibration: float = 0.005
    dt: float = 0.2
    ego_translation: float = 2.0
    ego_rotation: float = 0.15
    movers_min: int = 1
    movers_max: int = 4
    clutter: float = 2.0
    dominant_mover: float = 0.0
    aperture: float = 0.0
    scale: float = 1.0

    def __post_init__(self) -> None:
        shares = ("dropout", "mixed_pixels", "dominant_mover", "aperture")
        amounts = ("range_min", "range_noise", "vibration", "ego_translation", "clutter")
        rules = {
            "scene": (self.scene in ("street", "indoor"), "street or indoor"),
            "beams": (self.beams >= 1, "at least 1"),
            "fov": (0 < self.fov <= 360, "above 0 and at most 360 degrees"),
            "range_max": (self.range_min < self.range_max < math.inf, f"a finite range above range_min = {self.range_min}"),
            "dt": (0 < self.dt < math.inf, "a finite time above 0"),
            "ego_rotation": (0 <= self.ego_rotation <= math.pi, "radians between 0 and pi"),
            "movers_min": (self.movers_min >= 0, "at least 0"),
            "movers_max": (self.movers_max >= self.movers_min, f"at least movers_min = {self.movers_min}"),
            "scale": (0 < self.scale < math.inf, "a finite factor above 0"),
        }
        rules |= {name: (0 <= getattr(self, name) <= 1, "a share between 0 and 1") for name in shares}
        rules |= {name: (0 <= getattr(self, name) < math.inf, "a finite number of at least 0") for name in amounts}
        for name, (is_met, expected) in rules.items():
            if not is_met:
                raise ValueError(f"{name}: expected {expected}, got {getattr(self, name)}")


MODEL_CARS = SimulatorConfig(beams=360, fov=360.0, range_max=9.0, dropout=0.3, scale=0.1, ego_translation=4.0, ego_rotation=0.25)

WORLDS = {
    "street": SimulatorConfig(),
    "fast_street": SimulatorConfig(ego_translation=4.0, range_noise=0.03, clutter=3.0),
    "model_cars": MODEL_CARS,
    "model_cars_dominant": replace(MODEL_CARS, dominant_mover=0.5, aperture=0.5),
    "indoor": SimulatorConfig(scene="indoor", range_max=30.0, ego_translation=0.4),
    "street_dominant": SimulatorConfig(dominant_mover=0.5, aperture=0.5),
    "still_street": SimulatorConfig(movers_min=0, movers_max=0),
    "still_indoor": SimulatorConfig(scene="indoor", range_max=30.0, ego_translation=0.4, movers_min=0, movers_max=0),
}
