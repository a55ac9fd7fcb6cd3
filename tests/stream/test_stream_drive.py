"""Simulated drives with truth: the stream finds more of the movers than pairs alone, and its poses are right."""

import numpy as np
import pytest

from torchcrf_scan import JointScanCRF, ScanStream
from torchcrf_scan.data.drive import Drive, simulate_drive
from torchcrf_scan.data.worlds import NAMED_WORLDS, every
from torchcrf_scan.geometry import se2
from torchcrf_scan.scan import Bools

SCANS = 40


def moving_by_pairs(model: JointScanCRF, drive: Drive) -> list[Bools]:
    """(n_beams,) of every scan but the first, each matched to the one before."""
    pairs = zip(drive[1:], drive[:-1], strict=True)
    return [model.match(now.scan, before.scan, now.stamp - before.stamp).cluster > 0 for now, before in pairs]


def found(moving: list[Bools], drive: Drive) -> tuple[float, float]:
    """Share of the movers' beams that are called moving, and of the background's."""
    true, static = (np.concatenate([mask(of) for of in drive[1:]]) for mask in (lambda of: of.moving, lambda of: of.body == 0))
    called = np.concatenate(moving)
    return float(called[true].mean()), float(called[static].mean())


@pytest.mark.parametrize("world", ["indoor_360", "cars_360"])
def test_drive(world: str) -> None:
    drive = simulate_drive(every(NAMED_WORLDS[world], 0.1), SCANS, 12)
    model = JointScanCRF.from_pretrained()
    stream = ScanStream(model)
    results = [stream.feed(of.scan, of.stamp) for of in drive]
    recall, wrong = found([result.moving for result in results[1:]], drive)
    alone, _ = found(moving_by_pairs(model, drive), drive)
    assert recall > alone + 0.08
    assert wrong < 0.005
    turn, shift = se2.distance(np.stack([result.pose for result in results]), drive.poses)
    length = np.hypot(*np.diff(drive.poses[:, 1:], axis=0).T).sum()
    assert turn[-1] < 0.03
    assert shift[-1] < 0.05 + 0.02 * length
