"""Displaced frames: offsets of the size that was asked for, and answers given back in the pair's own frames."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from torchcrf_scan import JointScanCRF, PairPrediction
from torchcrf_scan.baselines.start import match_start
from torchcrf_scan.batch import ScanPairBatch
from torchcrf_scan.commands import frames
from torchcrf_scan.commands.frames import FrameOffset, Turn, match_displaced
from torchcrf_scan.data.carmen import CarmenLog
from torchcrf_scan.evaluation.calibration import normalised_error
from torchcrf_scan.geometry import se2


def drawn(metres: float, turn: Turn, count: int = 400, seed: int = 1) -> torch.Tensor:
    return FrameOffset(metres, turn).draw(count, torch.Generator().manual_seed(seed))


def test_offsets_have_the_size_that_was_asked_for() -> None:
    theta, x, y = drawn(3.5, 0.35).unbind(-1)
    assert torch.allclose(torch.hypot(x, y), torch.tensor(3.5, dtype=torch.float64))
    assert theta.unique().tolist() == [-0.35, 0.35]
    assert 0.4 < (theta > 0).double().mean() < 0.6
    counts = torch.histc(torch.atan2(y, x), bins=4, min=-np.pi, max=np.pi)
    assert counts.min() > 60
    assert abs(torch.corrcoef(torch.stack([theta, torch.atan2(y, x)]))[0, 1]) < 0.15  # the side has nothing to do with the way


def test_any_turn_is_uniform_over_the_circle() -> None:
    theta = drawn(0.0, "any")[:, 0]
    counts = torch.histc(theta, bins=8, min=-np.pi, max=np.pi)
    assert counts.sum() == 400
    assert counts.min() > 25


def test_a_pairs_offset_does_not_depend_on_how_many_there_are() -> None:
    assert (drawn(2.0, "any", 100)[:7] == drawn(2.0, "any", 7)).all()
    assert (drawn(2.0, "any", 7, seed=2) != drawn(2.0, "any", 7)).any()


@pytest.mark.parametrize("metres", [-0.1, np.nan, np.inf])
def test_metres_must_make_sense(metres: float) -> None:
    with pytest.raises(ValueError, match="--frame_offset: expected"):
        FrameOffset(metres, 0.0)


@pytest.mark.parametrize("turn", [-0.1, np.nan, 3.15])
def test_turns_must_make_sense(turn: float) -> None:
    with pytest.raises(ValueError, match="--frame_turn: expected"):
        FrameOffset(0.0, turn)


def answer(model: JointScanCRF, log: CarmenLog, offsets: torch.Tensor, method: str = "start") -> list[PairPrediction]:
    return match_displaced(method, model, list(zip(log, offsets, strict=True)))


def test_the_method_sees_displaced_scans_and_its_motions_come_back(
    log_file: Path, model_dir: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    model, log, offsets = JointScanCRF.from_pretrained(model_dir), CarmenLog(log_file), drawn(3.5, 0.35, 4)
    seen: list[ScanPairBatch] = []

    def looking(model: JointScanCRF, batch: ScanPairBatch) -> frames.Prediction:
        seen.append(batch)
        return start(model, batch)

    start = frames.METHODS["start"]
    monkeypatch.setitem(frames.METHODS, "start", looking)
    found = answer(model, log, offsets)
    targets = np.stack([pair.target.points for pair in log])
    assert np.allclose(seen[0].target, se2.apply(offsets.numpy(), targets), atol=1e-5)
    assert seen[0].truth is None
    assert np.allclose(seen[0].initial_motion, [0, -0.1, 0], atol=1e-6)  # the log's odometry, which knows nothing of the frames
    in_their_frame = start(model, seen[0]).motions[:, 0].double()
    motions = torch.tensor(np.stack([one.motions[0] for one in found]))
    assert torch.allclose(se2.compose(offsets, motions), in_their_frame, atol=1e-4)


@pytest.mark.parametrize(("method", "usual"), [("joint", JointScanCRF.match_pairs), ("start", match_start)])
def test_frames_that_stay_give_the_usual_answer(log_file: Path, model_dir: Path, method: str, usual: Callable[..., Any]) -> None:
    model, log = JointScanCRF.from_pretrained(model_dir), CarmenLog(log_file)
    for found, expected in zip(answer(model, log, torch.zeros(4, 3), method), usual(model, list(log)), strict=True):
        assert (found.association == expected.association).all()
        assert (found.cluster == expected.cluster).all()
        assert np.allclose(found.motions, expected.motions, atol=1e-6)
        assert abs(found.motions[0, 1] + 0.1) < 0.05


def test_what_motions_are_known_to_turns_back_as_well(log_file: Path, model_dir: Path) -> None:
    """Normalised errors are those in the displaced frames; along the room nothing is seen, whichever way the frame is turned."""
    model, log, offsets = JointScanCRF.from_pretrained(model_dir), CarmenLog(log_file), drawn(3.5, 0.35, 4)
    batch = ScanPairBatch.collate(list(log)).displaced(offsets.float())
    there = [frames.METHODS["joint"](model, batch).pair(b, pair) for b, pair in enumerate(log)]
    truth = np.array([0.01, -0.12, 0.02])
    for one, back, offset in zip(there, answer(model, log, offsets, "joint"), offsets.numpy(), strict=True):
        assert one.covariances is not None
        assert back.covariances is not None
        error = normalised_error(back.motions[0], truth, back.covariances[0])
        assert error == pytest.approx(normalised_error(one.motions[0], se2.compose(offset, truth), one.covariances[0]), rel=1e-2)
        assert one.unobserved_shift is not None
        assert back.unobserved_shift is not None
        turned = se2.rotate(offset[:1], back.unobserved_shift[0])
        assert abs(turned @ one.unobserved_shift[0]) == pytest.approx(one.unobserved_shift[0] @ one.unobserved_shift[0], abs=1e-4)
