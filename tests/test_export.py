"""The unrolled rounds compiled, exported, as ONNX, and as a function of the weights: always the answers of the model itself."""

from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import pytest
import torch
from support import normal
from torch import Tensor
from torch.export import ExportedProgram

from torchcrf_scan import InferenceConfig, JointScanCRF, ModelConfig, ScanPair, ScanPairBatch
from torchcrf_scan.data.simulate import simulate_pairs
from torchcrf_scan.data.worlds import SimulatorConfig
from torchcrf_scan.export import (
    OPSET,
    OUTPUTS,
    UnrolledDecoder,
    count_below,
    decoder_inputs,
    eliminate,
    export_onnx,
    export_program,
    middle_of_known,
)
from torchcrf_scan.inference.start import Start
from torchcrf_scan.scan import Scan

BEAMS = 16
SETTINGS: dict[str, Any] = {"clusters": 3, "iterations": 1, "stop_early": False, "backend": "eager"}


@pytest.fixture(scope="module")
def model() -> JointScanCRF:
    return JointScanCRF.from_pretrained(**SETTINGS)


def cut(pair: ScanPair, beams: int) -> ScanPair:
    """The first beams of both scans."""
    source, target = (Scan.from_ranges(s.ranges[:beams], s.bearings[:beams]) for s in (pair.source, pair.target))
    return ScanPair(source, target, pair.dt)


def batches() -> list[ScanPairBatch]:
    """Simulated pairs of one padded size: two pairs, one pair that is shorter, three pairs of which one has one point."""
    pairs = [simulate_pairs(SimulatorConfig(beams=BEAMS, dropout=0.0), 1, 1, seed)[0] for seed in range(4)]
    longest = 2 * [max(len(scan) for pair in pairs for scan in (pair.source, pair.target))]
    groups = [pairs[:2], [cut(pairs[2], 20)], [pairs[3], cut(pairs[0], 1), pairs[1]]]
    return [padded(ScanPairBatch.collate(group).without_truth(), *longest) for group in groups]


def padded(batch: ScanPairBatch, n: int, m: int) -> ScanPairBatch:
    """The batch with scans of n and m points."""

    def longer(values: Tensor, points: int) -> Tensor:
        return torch.cat([values, values.new_zeros(len(values), points - values.shape[1], *values.shape[2:])], dim=1)

    sizes = {"source": n, "source_mask": n, "target": m, "target_mask": m}
    return replace(batch, **{name: longer(getattr(batch, name), points) for name, points in sizes.items()})


@pytest.fixture(scope="module")
def cases(model: JointScanCRF) -> list[tuple[ScanPairBatch, Start]]:
    return [(batch, model.initialise(batch)) for batch in batches()]


def assert_same(found: dict[str, Tensor], expected: Any, tolerance: float = 0.0) -> None:
    """Labels equal, numbers within the tolerance. expected: a `Prediction`."""
    for name in OUTPUTS:
        here, there = found[name], getattr(expected, name).detach()
        if here.is_floating_point():
            torch.testing.assert_close(here, there, rtol=tolerance, atol=tolerance, msg=lambda text, of=name: f"{of}: {text}")
        else:
            assert torch.equal(here, there), name


# --- torch.compile --------------------------------------------------------------------------------------------------------------


def test_compiled_without_a_graph_break(model: JointScanCRF, cases: list[tuple[ScanPairBatch, Start]]) -> None:
    batch, start = cases[0]
    with torch.no_grad():
        found = torch.compile(model, backend="eager", fullgraph=True)(batch, start)
        expected = model(batch, start)
    assert_same({name: getattr(found, name) for name in OUTPUTS}, expected)
    torch.testing.assert_close(found.uncertainty.covariance, expected.uncertainty.covariance)


# --- torch.export and ONNX ------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def decided() -> JointScanCRF:
    """A model that takes the start's movers as they are, which makes its program a quarter shorter; its reach is soft."""
    settings = {**SETTINGS, "movers": "threshold", "candidates": 4}
    model = JointScanCRF.from_pretrained(features={"reach": "soft"}, **settings)
    with torch.no_grad():
        model.clustering_weights["reach"].fill_(0.5)
    return model


@pytest.fixture(scope="module")
def program(decided: JointScanCRF, cases: list[tuple[ScanPairBatch, Start]]) -> ExportedProgram:
    return export_program(decided, *cases[0])


def test_the_program_answers_as_the_model_for_any_number_of_pairs(
    program: ExportedProgram, decided: JointScanCRF, cases: list[tuple[ScanPairBatch, Start]]
) -> None:
    run = program.module()
    for batch, start in cases:
        with torch.no_grad():
            assert_same(run(**decoder_inputs(batch, start)), decided(batch, start), 1e-6)


class Half(torch.nn.Module):
    """A program small enough to be saved in no time."""

    def forward(self, start: Start) -> Start:
        return start.scaled(torch.full_like(start.motions[:, 0, 0], 0.5))


def test_a_program_of_dataclasses_is_saved_and_loaded(cases: list[tuple[ScanPairBatch, Start]], tmp_path: Path) -> None:
    start = cases[0][1]
    torch.export.save(torch.export.export(Half(), (start,)), tmp_path / "half.pt2")
    with torch.serialization.safe_globals([Start]):  # the file holds the example, and torch loads no class that nobody vouches for
        found = torch.export.load(tmp_path / "half.pt2").module()(start)
    assert torch.equal(found.motions, Half()(start).motions)
    assert torch.equal(found.association, start.association)


def test_motions_alone_are_a_start(model: JointScanCRF, cases: list[tuple[ScanPairBatch, Start]]) -> None:
    decoder = UnrolledDecoder(model)
    for batch, start in cases:
        motions = start.motions[:, :1]
        with torch.no_grad():
            found = decoder(**decoder_inputs(batch, motions))
            expected = model(batch, Start.at(batch, motions, torch.ones_like(motions[..., 0], dtype=torch.bool)))
        assert_same(found, expected)
        known = (found["association"] >= 0).sum()
        assert known > 0.5 * batch.source_mask.sum()


def test_plain_operators_give_the_same_answers(model: JointScanCRF, cases: list[tuple[ScanPairBatch, Start]]) -> None:
    decoder = UnrolledDecoder(model, plain=True)
    for batch, start in cases:
        with torch.no_grad():
            assert_same(decoder(**decoder_inputs(batch, start)), model(batch, start), 1e-6)
            assert not torch.is_grad_enabled()
    assert torch.is_grad_enabled()


@pytest.mark.filterwarnings("ignore:.*LeafSpec:FutureWarning")  # torch's converter warns of torch
def test_onnxruntime_answers_as_the_model(
    decided: JointScanCRF, program: ExportedProgram, cases: list[tuple[ScanPairBatch, Start]], tmp_path: Path
) -> None:
    onnx, runtime = pytest.importorskip("onnx"), pytest.importorskip("onnxruntime")
    pytest.importorskip("onnxscript")
    export_onnx(tmp_path / "model.onnx", program)
    assert [path.name for path in tmp_path.iterdir()] == ["model.onnx"]
    assert {entry.domain: entry.version for entry in onnx.load(tmp_path / "model.onnx").opset_import}[""] == OPSET
    session = runtime.InferenceSession(tmp_path / "model.onnx")
    names = [given.name for given in session.get_inputs()]
    assert names == [*decoder_inputs(*cases[0])]
    assert tuple(out.name for out in session.get_outputs()) == OUTPUTS
    for batch, start in cases:
        inputs = decoder_inputs(batch, start)
        values = session.run(None, {name: inputs[name].numpy() for name in names})
        found = dict(zip(OUTPUTS, map(torch.from_numpy, values), strict=True))
        with torch.no_grad():
            expected = decided(batch, start)
        is_possible = batch.source_mask[..., None] & (expected.log_association[..., :-1] > -torch.inf)
        # where a scan has fewer points than candidates, those that do not exist are equally far, and every runtime names others
        found["candidates"] = torch.where(is_possible, found["candidates"], expected.candidates)
        assert_same(found, expected, 1e-4)


def test_what_cannot_be_exported_says_so(model: JointScanCRF) -> None:
    flooding = JointScanCRF(ModelConfig(inference=InferenceConfig(schedule="flooding")))
    with pytest.raises(ValueError, match="schedule: expected sweep for a model to export, got flooding"):
        UnrolledDecoder(flooding)
    early = JointScanCRF()
    inference = UnrolledDecoder(early, iterations=3).model.config.inference
    assert (inference.stop_early, inference.iterations, inference.backend) == (False, 3, "eager")
    assert early.config.inference.stop_early


def test_decompositions_equal_the_operators() -> None:
    values, sorted_rows = normal(3, 20), normal(3, 8, seed=1).sort(-1).values
    values[:, :8] = sorted_rows  # ties
    sorted_rows[1, 5:] = torch.inf
    assert torch.equal(count_below(sorted_rows, values), torch.searchsorted(sorted_rows, values))
    for known in (0, 1, 2, 7, 20):
        some = values.masked_fill(torch.arange(20) >= known, torch.nan)
        torch.testing.assert_close(middle_of_known(some, 1).values, some.nanmedian(1).values, rtol=0, atol=0, equal_nan=True)
    root = normal(5, 4, 3, 3, seed=2)
    matrix, right = root @ root.mT + 0.1 * torch.eye(3), normal(5, 4, 3, seed=3)
    torch.testing.assert_close(eliminate(matrix, right)[0], torch.linalg.solve(matrix, right))


# --- a function of the weights --------------------------------------------------------------------------------------------------


def soft(features: dict[str, Any] | None = None) -> JointScanCRF:
    features = {"reach": "soft", **(features or {})}
    return JointScanCRF.from_pretrained(features=features, **{**SETTINGS, "motion_weights": "soft", "temperature": 1.0})


def weight_sets(model: JointScanCRF, count: int) -> list[dict[str, Tensor]]:
    """The model's weights, each set disturbed otherwise."""
    draws = normal(count, len(list(model.parameters()))).float()
    return [
        {name: value.detach() + 0.1 * draw for (name, value), draw in zip(model.named_parameters(), row, strict=True)}
        for row in draws
    ]


def answers(model: JointScanCRF, weights: dict[str, Tensor], batch: ScanPairBatch, start: Start) -> tuple[Tensor, ...]:
    found = torch.func.functional_call(model, weights, (batch, start))
    return found.log_association.exp(), found.log_cluster.exp(), found.motions


def test_other_weights_are_another_model(cases: list[tuple[ScanPairBatch, Start]]) -> None:
    batch, start = cases[0]
    model, (weights,) = soft(), weight_sets(soft(), 1)
    with torch.no_grad():
        other = soft()
        other.load_state_dict({**other.state_dict(), **weights})
        found, expected = answers(model, weights, batch, start), answers(other, {}, batch, start)
        usual = answers(model, {}, batch, start)
    for one, two in zip(found, expected, strict=True):
        assert torch.equal(one, two)
    assert not torch.allclose(found[0], usual[0], atol=1e-3)


def test_a_state_dict_brings_the_program_s_answers_along(cases: list[tuple[ScanPairBatch, Start]]) -> None:
    batch, start = cases[2]
    model = soft()
    with torch.no_grad():
        for name, value in weight_sets(model, 1)[0].items():
            model.get_parameter(name).copy_(value)
        again = JointScanCRF(model.config)
        again.load_state_dict(model.state_dict())
        assert_same(UnrolledDecoder(again)(**decoder_inputs(batch, start)), model(batch, start))


def test_many_weights_at_once(cases: list[tuple[ScanPairBatch, Start]]) -> None:
    """`vmap` over weights is the loop over them, and so are the gradients through it."""
    batch, start = cases[0]
    model = soft()
    sets = weight_sets(model, 3)
    stacked = {name: torch.stack([weights[name] for weights in sets]) for name in sets[0]}

    def loss(weights: dict[str, Tensor]) -> Tensor:
        association, cluster, motions = answers(model, weights, batch, start)
        return association[..., 0].sum() + cluster[..., 0].sum() + motions.sum()

    many = torch.func.vmap(lambda weights: answers(model, weights, batch, start))(stacked)
    slopes = torch.func.vmap(torch.func.grad(loss))(stacked)
    for k, weights in enumerate(sets):
        for value, expected in zip(many, answers(model, weights, batch, start), strict=True):
            torch.testing.assert_close(value[k], expected, rtol=1e-4, atol=1e-5)
        alone = torch.func.grad(loss)(weights)
        for name, slope in alone.items():
            torch.testing.assert_close(slopes[name][k], slope, rtol=1e-3, atol=1e-3)
    assert any(bool(slope.abs().sum() > 0) for slope in slopes.values())


def test_a_dataclass_is_a_tree_of_its_tensors(cases: list[tuple[ScanPairBatch, Start]]) -> None:
    from torch.utils import _pytree as pytree

    for value in cases[0]:
        leaves, spec = pytree.tree_flatten(value)
        again = pytree.tree_unflatten(leaves, spec)
        assert all(getattr(again, f.name) is getattr(value, f.name) for f in fields(value))
