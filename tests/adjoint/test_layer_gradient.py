"""Gradients of the rounds by the loops: those of the tensors, and of finite differences."""

from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest
import torch
from support import assert_close, normal
from torch import Tensor

from torchcrf_scan import ExtraLogUnary, JointScanCRF, ScanPairBatch
from torchcrf_scan.adjoint.layer import Answer, pull_joined
from torchcrf_scan.adjoint.layer import unroll as unroll_in_loops
from torchcrf_scan.data.simulate import simulate_pairs
from torchcrf_scan.data.worlds import WORLDS, SimulatorConfig
from torchcrf_scan.inference.start import Start
from torchcrf_scan.prediction import Prediction
from torchcrf_scan.scan import Scan, ScanPair

EMPTY = Scan.from_ranges(np.full(9, np.inf), angle_min=-1.5, angle_increment=0.1)
ONE = Scan.from_ranges(np.array([2.0]), angle_min=0.1, angle_increment=0.1)


def pairs_of(world: str) -> list[ScanPair]:
    """A pair of few beams, one of which a scan has one point, and one with an empty scan."""
    pair = simulate_pairs(replace(WORLDS[world], beams=61), 1, 1, 4)[0]
    return [pair, ScanPair(pair.source, ONE, pair.dt), ScanPair(EMPTY, pair.target, pair.dt)]


@cache
def scene(world: str) -> tuple[ScanPairBatch, Start]:
    batch = ScanPairBatch.collate(pairs_of(world), torch.float64).without_truth()
    return batch, JointScanCRF.from_pretrained("simulated").double().initialise(batch)


def finite(values: Tensor) -> Tensor:
    return torch.where(values.isfinite(), values, 0.0)


def loss_of(answer: Prediction) -> Tensor:
    """A number in which every output with a gradient has its part."""
    parts = [answer.motions, finite(answer.log_association), finite(answer.log_cluster), answer.association_confidence]
    assert answer.uncertainty is not None
    parts += [answer.cluster_confidence, answer.uncertainty.covariance.diagonal(dim1=-2, dim2=-1).log1p()]
    return torch.stack([(part * normal(*part.shape, seed=k)).sum() for k, part in enumerate(parts)]).sum()


def slopes(
    world: str, backend: str, *, is_left_out: bool = False, **settings: Any
) -> tuple[Prediction, dict[str, Tensor], JointScanCRF]:
    """The answer to a world's pairs, and the gradient of its loss by every input with one."""
    batch, start = scene(world)
    model = JointScanCRF.from_pretrained("simulated", backend=backend, iterations=3, **settings).double()
    if is_left_out:
        torch.nn.init.zeros_(model.clustering_weights["hidden"])
    extra = [0.1 * normal(*batch.source_mask.shape, seed=seed) for seed in (7, 8)]
    leaves = dict(model.named_parameters()) | {"outlier": extra[0].requires_grad_(), "moving": extra[1].requires_grad_()}
    answer = model(batch, start, extra_log_unary=ExtraLogUnary(*extra))
    found = torch.autograd.grad(loss_of(answer), [*leaves.values()], allow_unused=True)
    return answer, {name: torch.zeros(()) if of is None else of for name, of in zip(leaves, found, strict=True)}, model


def assert_alike(found: dict[str, Tensor], expected: dict[str, Tensor]) -> None:
    scale = max(float(of.abs().max()) for of in expected.values())
    for name, slope in expected.items():
        torch.testing.assert_close(found[name], slope, rtol=1e-8, atol=1e-11 * scale, msg=lambda text, of=name: f"{of}: {text}")


@pytest.mark.parametrize("world", ["street", "model_cars_dominant"])
@pytest.mark.parametrize("metric", ["line", "point", "given"])
@pytest.mark.parametrize(
    "settings", [{}, {"stop_early": False}, {"detach_motion": True}, {"motion_weights": "hard"}, {"outlier_distance": 0.3}], ids=str
)
def test_gradients_are_those_of_the_tensors(world: str, metric: str, settings: dict[str, Any]) -> None:
    settings = {"motion_weights": "soft", "motion_metric": metric} | settings
    expected, slopes_expected, _ = slopes(world, "eager", **settings)
    found, slopes_found, _ = slopes(world, "compiled", **settings)
    for name in ("association", "cluster", "active", "converged", "iterations"):
        assert torch.equal(getattr(found, name)[:2], getattr(expected, name)[:2]), name
    assert_close(found.motions, expected.motions.detach(), tolerance=1e-9)
    assert_alike(slopes_found, slopes_expected)
    assert any(bool((of != 0).any()) for of in slopes_found.values())


def test_a_weight_of_zero_has_a_gradient() -> None:
    expected = slopes("street", "eager", is_left_out=True, motion_weights="soft")[1]
    found = slopes("street", "compiled", is_left_out=True, motion_weights="soft")[1]
    assert_alike(found, expected)
    assert float(found["clustering_weights.hidden"]) != 0


def test_gradients_are_those_of_finite_differences() -> None:
    batch, start = scene("street")
    model = JointScanCRF.from_pretrained("simulated", motion_weights="soft", stop_early=False, iterations=2).double()
    leaves = [*model.association_weights.values(), *model.clustering_weights.values()]
    found = torch.autograd.grad(loss_of(model(batch, start)), leaves)
    step = 1e-6
    for seed in range(4):
        direction = normal(len(leaves), seed=seed)
        ends = []
        for sign in (1, -1):
            with torch.no_grad():
                for leaf, along in zip(leaves, direction, strict=True):
                    leaf += sign * step * along
                ends.append(float(loss_of(model(batch, start))))
                for leaf, along in zip(leaves, direction, strict=True):
                    leaf -= sign * step * along
        slope = float(torch.stack(found) @ direction)
        assert (ends[0] - ends[1]) / (2 * step) == pytest.approx(slope, rel=2e-5)


def test_a_batch_is_the_loop_over_its_pairs() -> None:
    pairs = [pair for world in ("street", "indoor") for pair in pairs_of(world)]
    model = JointScanCRF.from_pretrained("simulated", motion_weights="soft", iterations=2).double()

    def gradient(some: list[ScanPair]) -> Tensor:
        batch = ScanPairBatch.collate(some, torch.float64).without_truth()
        answer = model(batch, model.initialise(batch))
        inside = batch.source_mask[..., None]
        total = (answer.log_cluster.exp() * inside)[..., :2].sum() + answer.motions[:, :2].square().sum()
        leaves = [*model.association_weights.values(), *model.clustering_weights.values()]
        return torch.stack([*torch.autograd.grad(total + 0 * sum(leaves), leaves)])

    assert_close(gradient(pairs), sum(gradient([pair]) for pair in pairs).detach(), tolerance=1e-10)


def test_what_the_loops_do_not_cover_goes_to_the_tensors() -> None:
    batch, start = scene("street")
    model = JointScanCRF.from_pretrained("simulated", motion_weights="soft", iterations=1).double()
    points = batch.source.clone().requires_grad_()
    model(replace(batch, source=points), start).motions.sum().backward()
    assert points.grad is not None
    assert points.grad.isfinite().all()
    strict = JointScanCRF.from_pretrained("simulated", iterations=1, backend="compiled").double()
    with pytest.raises(ValueError, match=r"no gradient to be asked for by batch\.source, start"):
        strict(replace(batch, source=points), replace(start, motions=start.motions.clone().requires_grad_()))
    with pytest.raises(ValueError, match="no call inside a transform"):
        torch.func.grad(lambda weights: torch.func.functional_call(strict, weights, (batch, start)).motions.sum())(
            {name: of.detach() for name, of in strict.named_parameters()}
        )


def test_a_gradient_of_a_gradient_is_refused() -> None:
    batch, start = scene("street")
    model = JointScanCRF.from_pretrained("simulated", motion_weights="soft", iterations=1).double()
    weight = model.clustering_weights["sequence"]
    (slope,) = torch.autograd.grad(loss_of(model(batch, start)), weight, create_graph=True)
    with pytest.raises(RuntimeError, match="once_differentiable"):
        slope.backward()


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_no_gradient_of_random_batches_is_not_a_number(dtype: torch.dtype) -> None:
    model = JointScanCRF.from_pretrained("simulated", motion_weights="soft", stop_early=False, iterations=2).to(dtype)
    for seed in range(dtype == torch.float64, 50, 2):  # of either type every other one
        names = sorted(WORLDS)
        world = WORLDS[names[seed % len(names)]]
        pairs = simulate_pairs(replace(world, beams=9 + 7 * (seed % 5)), 2, 1, seed)
        batch = ScanPairBatch.collate(pairs, dtype).without_truth()
        model.zero_grad()
        answer = model(batch, model.initialise(batch))
        (finite(answer.log_association).sum() + finite(answer.log_cluster).sum() + answer.motions.sum()).backward()
        for name, weight in model.named_parameters():
            assert weight.grad is None or bool(weight.grad.isfinite().all()), (seed, name)


def test_the_way_back_through_merged_clusters() -> None:
    before = torch.log_softmax(normal(5, 4, seed=1), -1)
    before[0, 1] = before[1, 0] = before[1, 1] = -torch.inf
    joined = np.array([[0, 1], [0, 2]])
    leaf = before.clone().requires_grad_()
    columns = list(leaf.unbind(-1))
    for low, high in joined:
        neither = columns[low].isneginf() & columns[high].isneginf()
        both = [columns[c].masked_fill(neither, 0.0) for c in (low, high)]
        columns[low], columns[high] = torch.logaddexp(*both).masked_fill(neither, -torch.inf), torch.full((5,), -torch.inf).double()
    after, slope = torch.stack(columns, -1), normal(5, 4, seed=2)
    (torch.where(after.isfinite(), after, 0.0) * slope).sum().backward()
    assert leaf.grad is not None
    given = torch.where(after.isfinite(), slope, 0.0).numpy()
    with np.errstate(all="ignore"):
        found = pull_joined(Answer(None, before.numpy(), joined), given)  # type: ignore[arg-type]
    assert_close(found, leaf.grad.nan_to_num())


def test_states_of_several_rounds() -> None:
    batch, start = scene("street")
    model = JointScanCRF.from_pretrained("simulated", motion_weights="soft", stop_early=False, iterations=3).double()
    found = unroll_in_loops(batch, start, model.fitted, model.config, last=2)
    shorter = JointScanCRF.from_pretrained("simulated", motion_weights="soft", stop_early=False, iterations=2).double()
    assert_close(found.rounds[0].state.motions.value.detach(), shorter(batch, start).scaled(found.factor).motions.detach())
    assert_close(found.rounds[1].state.log_cluster.detach(), model(batch, start).log_cluster.detach())
    assert found.rounds[1].iterations.tolist() == [3, 3, 0]


def test_simulated_pairs_of_full_scans() -> None:
    batch = ScanPairBatch.collate(simulate_pairs(SimulatorConfig(beams=181), 2, 1, 0), torch.float64).without_truth()
    found = []
    for backend in ("eager", "compiled"):
        model = JointScanCRF.from_pretrained("simulated", motion_weights="soft", iterations=2, backend=backend).double()
        loss_of(model(batch, JointScanCRF.from_pretrained("simulated").double().initialise(batch))).backward()
        found.append({name: of.grad for name, of in model.named_parameters() if of.grad is not None})
    assert_alike(found[1], found[0])
