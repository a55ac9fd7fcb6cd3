"""First-order training: it learns, goes on after kill -9 as if nothing had been, and many processes descend as one does."""

import json
import logging
import math
import os
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import small_run
import torch
from forked import begin, run_ranks
from small_run import Watcher
from torch import Tensor

from torchcrf_scan.config import EncoderConfig
from torchcrf_scan.learning.checkpoint import NAME
from torchcrf_scan.learning.gradient import LINEAR, Learner, has_amp, portions_from
from torchcrf_scan.learning.objectives import pseudo_likelihood
from torchcrf_scan.learning.portions import Portion, as_portion
from torchcrf_scan.learning.ranks import ALONE, Ranks
from torchcrf_scan.model import JointScanCRF

KILLED = -9


def assert_identical(a: Any, b: Any, where: str = "") -> None:
    """Bit for bit the same, down to the optimiser's moments."""
    assert type(a) is type(b), where
    if isinstance(a, Tensor):
        assert torch.equal(a, b), where
    elif isinstance(a, dict):
        assert a.keys() == b.keys(), where
        for key in a:
            assert_identical(a[key], b[key], f"{where}.{key}")
    elif isinstance(a, list | tuple):
        assert len(a) == len(b), where
        for k, (x, y) in enumerate(zip(a, b, strict=True)):
            assert_identical(x, y, f"{where}[{k}]")
    else:
        assert a == b, where


def final(learner: Learner) -> dict[str, Any]:
    """All that a run ends with: the state that goes on and the weights that are kept."""
    return {"last": learner.state_dict(), "model": dict(learner.model.state_dict())}


@pytest.mark.parametrize(("width", "surveyed"), [(0, 0), (4, 2)])
def test_the_workers_search_for_the_start_of_an_encoder(width: int, surveyed: int) -> None:
    config = small_run.small_config(objective="pseudo_likelihood")
    config = replace(config, model=replace(config.model, encoder=EncoderConfig(width=width)))
    portion = next(portions_from(0, config, small_run.small_pairs()[0], ALONE))
    assert len(portion.surveys) == surveyed


@pytest.fixture(scope="module")
def straight(tmp_path_factory: pytest.TempPathFactory) -> tuple[Learner, Watcher]:
    """A run that nobody disturbed."""
    return small_run.run(tmp_path_factory.mktemp("straight"), small_run.small_config())


@pytest.mark.parametrize(
    ("death", "workers", "reached"),
    [(("--kill-after", "5"), 0, 4), (("--kill-in-write", "4"), 0, 2), (("--kill-after", "1", "--workers", "1"), 1, 0)],
)
def test_killed_and_resumed_ends_bit_for_bit_the_same(
    death: tuple[str, ...], workers: int, reached: int, straight: tuple[Learner, Watcher], tmp_path: Path
) -> None:
    """reached: step of the last checkpoint before the end. What a process of its own began, this one ends."""
    process = begin(small_run.main, [str(tmp_path), *death])
    process.join()
    assert process.exitcode == KILLED
    assert not (tmp_path / "curve.json").exists()
    learner, watcher = small_run.run(tmp_path, small_run.small_config(workers=workers), resume=True)
    assert_identical(final(learner), final(straight[0]))
    assert len(watcher.reports) == 6 - reached
    assert [report.terms for report in watcher.reports] == [report.terms for report in straight[1].reports[reached:]]


def test_two_processes_have_the_loss_curve_of_one(straight: tuple[Learner, Watcher], tmp_path: Path) -> None:
    assert run_ranks(small_run.main, [str(tmp_path)]) == [0, 0]
    two, one = json.loads((tmp_path / "curve.json").read_text()), straight[1]
    assert two["loss"] == pytest.approx([report.terms["total"] for report in one.reports], rel=1e-5)
    assert [step for step, _ in two["validation"]] == [0, 2, 4, 6]
    assert [loss for _, loss in two["validation"]] == pytest.approx([loss for _, loss in one.validations], rel=1e-5)


@pytest.mark.parametrize("objective", ["pseudo_likelihood", "unrolled"])
def test_the_validation_loss_falls_and_the_best_weights_are_kept(objective: str, tmp_path: Path) -> None:
    config = small_run.small_config(objective=objective, steps=8, clip=0.0)
    learner, watcher = small_run.run(tmp_path, config)
    losses = dict(watcher.validations)
    assert min(losses.values()) < losses[0]
    assert learner.best is not None
    assert learner.stopping.best == min(losses.values())
    assert_identical(dict(learner.model.state_dict()), dict(learner.best))
    assert all(math.isfinite(report.norm) and report.nodes > 0 and report.pairs == 4 for report in watcher.reports)
    assert set(watcher.reports[0].norms) == {"association_weights", "clustering_weights"}
    total = math.sqrt(sum(norm**2 for norm in watcher.reports[0].norms.values()))
    assert watcher.reports[0].norm == pytest.approx(total)


def test_it_stops_early_and_stays_stopped(tmp_path: Path) -> None:
    config = small_run.small_config(steps=12, validate_every=1, patience=2, learning_rate=100.0, clip=0.0, warmup=0)
    learner, _ = small_run.run(tmp_path, config)
    assert learner.stopping.is_over
    assert learner.step == learner.stopping.step + 2 < 12
    again, watcher = small_run.run(tmp_path, config, resume=True)
    assert (again.step, watcher.reports) == (learner.step, [])
    assert_identical(dict(again.model.state_dict()), dict(learner.model.state_dict()))


def test_without_validation_the_last_weights_are_kept(tmp_path: Path) -> None:
    learner, watcher = small_run.run(tmp_path, small_run.small_config(steps=2, validation=0.0))
    assert learner.best is None
    assert watcher.validations == []
    assert (tmp_path / NAME).exists()


def weights_after(steps: int, path: Path, **settings: Any) -> dict[str, Tensor]:
    learner, _ = small_run.run(path, small_run.small_config(steps=steps, validation=0.0, warmup=0, final_rate=1.0, **settings))
    return {name: p.detach().clone() for name, p in learner.model.named_parameters()}


def test_the_mean_of_the_last_steps_is_kept(tmp_path: Path) -> None:
    second, third = (weights_after(steps, tmp_path / str(steps)) for steps in (2, 3))
    found = weights_after(3, tmp_path / "mean", average=0.6)  # the last two of three
    for name, values in found.items():
        torch.testing.assert_close(values, (second[name] + third[name]) / 2, rtol=1e-6, atol=1e-9)


def test_a_share_of_the_initial_weights_is_kept(tmp_path: Path) -> None:
    trained, none = (weights_after(2, tmp_path / str(share), trained_share=share) for share in (1.0, 0.0))
    found = weights_after(2, tmp_path / "blend", trained_share=0.7)
    linear = [name for name in found if name.startswith(LINEAR)]
    assert len(linear) > 30
    for name in linear:
        torch.testing.assert_close(found[name], 0.7 * trained[name] + 0.3 * none[name], rtol=1e-6, atol=1e-9)
    assert any(not torch.equal(trained[name], none[name]) for name in linear)


def test_a_disk_that_fills_up_does_not_stop_the_training(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture, straight: tuple[Learner, Watcher]
) -> None:
    calls = 0

    def fsync(_: int) -> None:
        nonlocal calls
        calls += 1
        if calls > 2:  # the first checkpoint: its content and its folder
            raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", fsync)
    with caplog.at_level(logging.WARNING):
        learner, _ = small_run.run(tmp_path, small_run.small_config())
    assert "checkpoint of step 6 not written" in caplog.text
    assert "that of step 0 is kept" in caplog.text
    assert_identical(dict(learner.model.state_dict()), dict(straight[0].model.state_dict()))
    assert torch.load(tmp_path / NAME, weights_only=True)["step"] == 0


def test_a_run_of_other_settings_is_not_gone_on_with(tmp_path: Path) -> None:
    small_run.run(tmp_path, small_run.small_config(steps=1))
    with pytest.raises(ValueError, match=r"got gradient\.steps = '2' after '1'"):
        small_run.run(tmp_path, small_run.small_config(steps=2), resume=True)


def test_parts_that_cannot_be_shared_out_are_an_error(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"gradient\.part: expected 4 / 2 parts to be shared out among 3 processes"):
        small_run.run(tmp_path, small_run.small_config(), Ranks(0, 3))


# --- one step -----------------------------------------------------------------------------------------------------------------


@pytest.fixture
def learner() -> Learner:
    config = small_run.small_config(batch_size=4, part=2, clip=0.5, warmup=0)
    return Learner(JointScanCRF(config.model), config.gradient, ALONE)


@pytest.fixture(scope="module")
def portions() -> list[Portion]:
    pairs, _ = small_run.small_pairs()
    return [as_portion(pairs[:2]), as_portion(pairs[2:])]


def test_parts_make_the_gradient_of_the_whole(learner: Learner, portions: list[Portion]) -> None:
    pairs, _ = small_run.small_pairs()
    whole = JointScanCRF(learner.model.config)
    loss = pseudo_likelihood(whole, as_portion(pairs))["total"]
    loss.backward()
    squares = [float(weight.grad.square().sum()) for weight in whole.parameters() if weight.grad is not None]
    report = learner.descend(pseudo_likelihood, iter(portions))
    assert report.terms["total"] == pytest.approx(loss.item(), rel=1e-5)
    assert report.norm == pytest.approx(math.sqrt(sum(squares)), rel=1e-4)
    cut = [weight.grad for weight in learner.model.parameters()]
    assert math.sqrt(sum(float(g.square().sum()) for g in cut if g is not None)) == pytest.approx(0.5, rel=1e-4)


def test_a_gradient_that_is_not_finite_is_left_out(
    learner: Learner, portions: list[Portion], caplog: pytest.LogCaptureFixture
) -> None:
    def broken(model: JointScanCRF, portion: Portion) -> dict[str, Tensor]:
        return {"total": next(iter(model.parameters())) * math.nan}

    before = {name: value.clone() for name, value in learner.model.state_dict().items()}
    with caplog.at_level(logging.WARNING):
        learner.descend(broken, iter(portions))
    assert "step 1 left out: its gradient is not finite" in caplog.text
    assert_identical(dict(learner.model.state_dict()), before)
    assert learner.step == 1


def test_a_loss_that_no_weight_has_a_part_in_moves_nothing(learner: Learner, portions: list[Portion]) -> None:
    before = {name: value.clone() for name, value in learner.model.state_dict().items()}
    report = learner.descend(lambda model, portion: {"total": torch.tensor(1.0)}, iter(portions))
    assert (report.norm, report.terms) == (0.0, {"total": 1.0})
    assert_identical(dict(learner.model.state_dict()), before)


def test_a_cpu_calculates_in_full_precision(learner: Learner) -> None:
    assert not has_amp(replace(learner.config, amp=True), torch.device("cpu"))


def test_the_state_holds_everything(learner: Learner, portions: list[Portion]) -> None:
    def forever() -> Iterator[Portion]:
        while True:
            yield from portions

    learner.descend(pseudo_likelihood, forever())
    learner.keep_best(1.0)
    other = Learner(JointScanCRF(learner.model.config), learner.config, ALONE)
    other.load_state_dict(learner.state_dict())
    assert_identical(other.state_dict(), learner.state_dict())
    reports = [of.descend(pseudo_likelihood, forever()) for of in (learner, other)]
    assert reports[0].terms == reports[1].terms
    assert_identical(other.state_dict(), learner.state_dict())
