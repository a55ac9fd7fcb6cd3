"""Settings of the simulator, and the named worlds made with them."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Annotated

from torchcrf_scan.beams import MOST_BEAMS
from torchcrf_scan.checks import Amount, OneOf, Positive, Share, Within, check_fields
from torchcrf_scan.errors import TorchCRFScanError


@dataclass(frozen=True)
class SimulatorConfig:
    """The simulated world, its sensor and its traffic (lengths in metres, speeds in m/s).

    Attributes:
        scene: `street` (a car among facades, trees and traffic) or `indoor` (a robot among walls, furniture and people).
        beams: beams of the sensor.
        fov: field of view, degrees; 360 is a closed scan.
        range_min: nearest return.
        range_max: farthest return.
        range_noise: standard deviation of a range.
        dropout: share of beams without return although they hit something.
        mixed_pixels: share of the depth edges where a beam returns a range between the near and the far surface.
        vibration: standard deviation of the sensor's pitch and jolts, as range noise common to neighbouring beams.
        dt: seconds between the scans of a pair.
        ego_translation: largest travel of the sensor per pair, before `scale`; indoors never more than 1.5 m/s.
        ego_rotation: largest rotation of the sensor per pair, radians.
        movers_min: least number of moving objects; a pair has fewer if some are out of sight.
        movers_max: largest number of moving objects.
        clutter: amount of hedges, bushes and low crowns, whose returns are not repeatable; 2 is an ordinary street.
        dominant_mover: probability that a truck drives beside the sensor and fills 40 to 50 % of the returns of a sequence.
        aperture: probability that a car is seen along one side only and slides along it.
        passer: probability that somebody passes half a metre to a metre before the sensor.
        scale: factor on the whole world and on every motion, but not on the sensor; 0.1 imitates 1:10 model cars.
        sweep: seconds from the first to the last beam of a scan, while the sensor and the movers move on; 0: all at once.
        litter: loose things (boxes, chairs, plants, people who stand) on each ten metres beside the sensor's way.
        states_limits: scans state their range limits and their noise; recordings often do not.
        matches_mixed: a return of no single surface may have a counterpart in the background, as who annotates a recording cannot
            tell it from others; otherwise it is an outlier always.
        least_travel: movers that travel less than this within a pair, in units of the association gate, are left out of the
            annotation (`ignore`), for they can be told from the background no better than the annotation's own tolerance.
    """

    scene: Annotated[str, OneOf("street", "indoor")] = "street"
    beams: Annotated[int, Within(1, MOST_BEAMS)] = 361
    fov: Annotated[float, Within(0, 360, above=True)] = 180.0
    range_min: Amount = 0.1
    range_max: Annotated[float, Within(0, 1e6, above=True)] = 80.0
    range_noise: Amount = 0.015
    dropout: Share = 0.02
    mixed_pixels: Share = 0.12
    vibration: Amount = 0.005
    dt: Positive = 0.2
    ego_translation: Amount = 2.0
    ego_rotation: Annotated[float, Within(0, math.pi)] = 0.15
    movers_min: Annotated[int, Within(0, 1000)] = 1
    movers_max: Annotated[int, Within(0, 1000)] = 4
    clutter: Amount = 2.0
    dominant_mover: Share = 0.0
    aperture: Share = 0.0
    passer: Share = 0.0
    scale: Positive = 1.0
    sweep: Amount = 0.0
    litter: Amount = 0.0
    states_limits: bool = True
    matches_mixed: bool = False
    least_travel: Amount = 0.0

    def __post_init__(self) -> None:
        check_fields(self)
        if self.range_max <= self.range_min:
            raise TorchCRFScanError(f"range_max: expected more than range_min = {self.range_min}, got {self.range_max}")
        if self.movers_max < self.movers_min:
            raise TorchCRFScanError(f"movers_max: expected at least movers_min = {self.movers_min}, got {self.movers_max}")


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

# What recordings have and the worlds above lack: scans that state nothing; little noise, but errors that neighbouring beams share
# (skew, tilt); mixed pixels in line with a surface; an annotation without what it cannot tell from the background.
AS_RECORDED = SimulatorConfig(range_noise=0.008, states_limits=False, matches_mixed=True, least_travel=1.0, movers_max=3)
STREET = replace(AS_RECORDED, ego_translation=3.0, vibration=0.03, litter=0.5)
INDOOR = replace(AS_RECORDED, scene="indoor", range_max=30.0, dt=0.3, ego_translation=0.4, litter=2.0, vibration=0.015)
ROOM = replace(INDOOR, fov=360.0, dt=0.2, ego_translation=0.1)  # people and robots before walls, a few metres away
STANDING = replace(INDOOR, ego_translation=0.0, ego_rotation=0.0)
SMALL = replace(AS_RECORDED, scale=0.1, range_max=9.0, dropout=0.3, dt=0.4, ego_translation=4.0, ego_rotation=0.25, aperture=0.2)
CARS = replace(SMALL, beams=360, fov=360.0, range_noise=0.005, vibration=0.012, sweep=0.08)


def without_movers(config: SimulatorConfig) -> SimulatorConfig:
    """The same world, in which nothing moves."""
    return replace(config, movers_min=0, movers_max=0)


TRAINING_WORLDS = {  # named by scene and beams
    "street_16": replace(STREET, beams=16, fov=120.0, range_max=60.0),
    "street_64": replace(STREET, beams=64, fov=90.0, range_noise=0.02, sweep=0.05),
    "street_181": replace(STREET, beams=181, range_noise=0.02, sweep=0.013, matches_mixed=False),
    "street_361": replace(STREET, sweep=0.05, matches_mixed=False),
    "street_541": replace(STREET, beams=541, fov=270.0, range_max=50.0, sweep=0.02),
    "street_1441": replace(STREET, beams=1441, fov=360.0, sweep=0.08, movers_max=6),
    "truck_361": replace(STREET, matches_mixed=False, dominant_mover=0.1, aperture=0.1),
    "indoor_32": replace(INDOOR, beams=32, fov=360.0, range_max=12.0, range_noise=0.02, sweep=0.1),
    "indoor_128": replace(INDOOR, beams=128, fov=90.0, range_max=8.0, range_noise=0.02),
    "indoor_360": replace(INDOOR, beams=360, fov=360.0, range_max=8.0, dropout=0.15, sweep=0.16),
    "indoor_512": replace(INDOOR, beams=512, fov=240.0, range_max=10.0, vibration=0.005, sweep=0.07, movers_max=5),
    "indoor_1081": replace(INDOOR, beams=1081, fov=270.0, vibration=0.005, sweep=0.019, movers_max=5),
    "crowd_768": replace(INDOOR, beams=768, fov=270.0, movers_min=2, movers_max=6, vibration=0.005, ego_translation=0.1),
    "room_720": replace(ROOM, beams=720, range_max=10.0, range_noise=0.01, sweep=0.1, movers_min=1, movers_max=4),
    "passed_512": replace(STANDING, beams=512, fov=240.0, range_max=8.0, dropout=0.5, passer=1.0),
    "cars_360": CARS,
    "cars_240": replace(CARS, beams=240, fov=240.0, range_noise=0.01, sweep=0.1),
    "still_street_361": without_movers(replace(STREET, sweep=0.05)),
    "still_cars_360": without_movers(CARS),
    "still_indoor_180": without_movers(replace(INDOOR, beams=180, range_noise=0.015, sweep=0.013)),
    "still_indoor_360": without_movers(replace(INDOOR, beams=360, sweep=0.013)),
    "still_indoor_512": without_movers(replace(INDOOR, beams=512, fov=240.0, range_max=10.0, sweep=0.1)),
}


def every(config: SimulatorConfig, dt: float) -> SimulatorConfig:
    """The same world and traffic, scanned every `dt` seconds; a sweep that would last longer is cut to that."""
    share = dt / config.dt
    travel, turn = share * config.ego_translation, min(share * config.ego_rotation, math.pi)
    return replace(config, dt=dt, ego_translation=travel, ego_rotation=turn, sweep=min(config.sweep, dt))


NAMED_WORLDS = WORLDS | TRAINING_WORLDS
