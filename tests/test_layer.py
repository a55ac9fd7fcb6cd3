"""The layer inside a larger network: embeddings and log potentials that are learned elsewhere go in."""

import math
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from support import assert_close, make_points, normal
from torch import Tensor

from torchcrf_scan import ClusteringCRF, ExtraLogUnary, FeatureConfig, InferenceConfig, JointScanCRF, MatchingCRF, ModelConfig
from torchcrf_scan.batch import ScanPairBatch
from torchcrf_scan.config import RUN_TIME
from torchcrf_scan.features.learned import Embeddings
from torchcrf_scan.geometry import se2
from torchcrf_scan.inference.selection import evidence
from torchcrf_scan.inference.start import Start
from torchcrf_scan.prediction import Prediction

N, M, SIZE = 12, 10, 3
MOTIONS = torch.tensor([[0.05, -0.3, 0.1], [-0.1, 0.9, 0.3]], dtype=torch.float64)
SETTINGS = InferenceConfig(clusters=3, iterations=2, stop_early=False, motion_weights="soft", backend="eager")


def scene(pairs: int = 1, n: int = N, m: int = M) -> tuple[ScanPairBatch, Start]:
    """Pairs whose halves move as MOTIONS says; the last has padding at the end of both scans."""
    source = torch.stack([make_points(n, seed) for seed in range(pairs)])
    cluster = (torch.arange(n) >= n // 2).long()
    target = se2.apply(MOTIONS[cluster], source[:, :, None])[:, :m, 0] + 0.02 * normal(pairs, m, 2)
    source_mask, target_mask = torch.ones(pairs, n, dtype=torch.bool), torch.ones(pairs, m, dtype=torch.bool)
    if pairs > 1:
        source_mask[-1, -3:], target_mask[-1, -2:] = False, False
    batch = ScanPairBatch(
        source=source * source_mask[..., None],
        target=target * target_mask[..., None],
        source_mask=source_mask,
        target_mask=target_mask,
        source_closed=torch.zeros(pairs, dtype=torch.bool),
        target_closed=torch.zeros(pairs, dtype=torch.bool),
        dt=torch.full((pairs,), 0.1).double(),
        range_noise=torch.full((pairs,), 0.01).double(),
        initial_motion=torch.zeros(pairs, 3).double(),
    )
    association = torch.where(source_mask & (torch.arange(n) < target_mask.sum(-1, keepdim=True)), torch.arange(n), -1)
    tangents = torch.nn.functional.normalize(normal(pairs, m, 2, seed=8), dim=-1)
    return batch, Start(MOTIONS.expand(pairs, 2, 3), torch.ones(pairs, 2, dtype=torch.bool), association, tangents)


def make_model(
    embedding: str = "none", layer: type[JointScanCRF] = JointScanCRF, coupling: str = "motions", **inference: object
) -> JointScanCRF:
    features = FeatureConfig(embedding=embedding, stumps=4, left_out=())
    own = replace(SETTINGS, **inference)  # type: ignore[arg-type]
    return layer(ModelConfig(coupling=coupling, features=features, inference=own)).double()


def embeddings(pairs: int = 1, n: int = N, m: int = M) -> dict[str, Tensor]:
    return {"source_embedding": normal(pairs, n, SIZE, seed=1), "target_embedding": normal(pairs, m, SIZE, seed=2)}


def logits(outlier: float | None = None, moving: float | None = None, pairs: int = 1) -> ExtraLogUnary:
    return ExtraLogUnary(*(None if value is None else torch.full((pairs, N), value).double() for value in (outlier, moving)))


def assert_identical(found: Prediction, expected: Prediction) -> None:
    for name in ("association", "cluster", "motions", "log_association", "log_cluster", "association_confidence"):
        assert torch.equal(getattr(found, name), getattr(expected, name)), name


# --- without them -------------------------------------------------------------------------------------------------------------


def test_a_model_without_the_option_has_the_weights_it_had() -> None:
    plain, able = make_model(), make_model("dot")
    assert len(list(plain.parameters())) == 43
    more = set(able.state_dict()) - set(plain.state_dict())
    assert more == {"association_weights.embedding", "association_weights.embedding_data"}
    assert set(plain.state_dict()) < set(able.state_dict())
    assert [len(vector) for vector in able.weight_vectors] == [23, 21]


@pytest.mark.parametrize("coupling", ["motions", "lattice"])
def test_absent_inputs_change_no_bit(coupling: str) -> None:
    batch, start = scene(2)
    plain = make_model(coupling=coupling)(batch, start)
    assert_identical(make_model("cosine", coupling=coupling)(batch, start), plain)
    assert_identical(make_model(coupling=coupling)(batch, start, extra_log_unary=ExtraLogUnary()), plain)


@pytest.mark.parametrize("coupling", ["motions", "lattice"])
def test_inputs_that_say_nothing_change_nothing(coupling: str) -> None:
    batch, start = scene(2)
    plain = make_model(coupling=coupling)(batch, start)
    model = make_model("dot", coupling=coupling)
    silent = {name: torch.zeros_like(value) for name, value in embeddings(2).items()}
    found = model(batch, start, **silent, extra_log_unary=logits(0.0, 0.0, 2))
    assert_close(found.log_association, plain.log_association.detach())
    assert_close(found.log_cluster, plain.log_cluster.detach())


# --- embeddings ---------------------------------------------------------------------------------------------------------------


@given(st.integers(1, 4), st.integers(1, 3), st.integers(1, 3), st.integers(1, 5), st.integers(0, 99))
def test_similarity(n: int, m: int, K: int, C: int, seed: int) -> None:
    source, target = normal(2, n, C, seed=seed), normal(2, m, C, seed=seed + 1)
    masks = torch.ones(2, n, dtype=torch.bool), torch.ones(2, m, dtype=torch.bool)
    candidates = torch.arange(2 * n * K).view(2, n, K) % m
    weights = torch.ones(()).double(), torch.full((), 0.5).double()
    dot = Embeddings.of(source, target, masks, "dot", weights)
    cosine = Embeddings.of(source, target, masks, "cosine", weights)
    for b in range(2):
        for i in range(n):
            for k in range(K):
                one, other = source[b, i], target[b, candidates[b, i, k]]
                assert_close(dot.similarity(candidates)[b, i, k], one @ other / math.sqrt(C))
                expected = one @ other / one.norm() / other.norm()
                assert_close(
                    cosine.similarity(candidates)[b, i, k],
                    expected,
                    tolerance=1e-2 if min(one.norm(), other.norm()) < 0.1 else 1e-4,
                )
    assert_close(dot.data_score(candidates), dot.similarity(candidates) / 2)


@pytest.mark.parametrize("embedding", ["dot", "cosine"])
@pytest.mark.parametrize("coupling", ["motions", "lattice"])
def test_alike_points_are_associated(coupling: str, embedding: str) -> None:
    batch, start = scene()
    model = make_model(embedding, coupling=coupling, candidates=0)
    wanted = torch.arange(N) % M  # one after the other, so that the chain's order does not matter
    wanted = wanted.roll(2)
    with torch.no_grad():
        model.association_weights["embedding"].fill_(1000.0)
    codes = torch.eye(M, dtype=torch.float64)
    found = model(batch, start, source_embedding=codes[wanted][None], target_embedding=codes[None])
    assert found.association[0].tolist() == wanted.tolist()


def test_the_share_in_the_data_score_has_the_data_boosters_weight() -> None:
    batch, start = scene()
    model = make_model("dot")
    given_ = embeddings()
    with torch.no_grad():
        model.association_weights["data_boosting"].fill_(0.5)
        model.association_weights["embedding"].fill_(0.8)
        direct = model(batch, start, **given_)
        model.association_weights["embedding"].fill_(0.2)
        model.association_weights["embedding_data"].fill_(1.2)
        shared = model(batch, start, **given_)
    assert_close(shared.log_association, direct.log_association)


def test_the_outlier_booster_sees_the_similarity() -> None:
    batch, start = scene()
    model = make_model("dot")
    with torch.no_grad():
        model.association_weights["outlier_boosting"].fill_(1.0)
        model.association_weights["embedding"].fill_(0.0)
        model.association_weights["embedding_data"].fill_(1.0)
    lead = torch.tensor([12])  # the best data score among the booster's inputs
    model.boosters.outlier.set_stumps(lead, torch.tensor([5.0]), torch.tensor([3.0]), torch.tensor([-3.0]))
    unlike, alike = (torch.full((1, n, SIZE), value).double() for n, value in ((N, 0.0), (N, 10.0)))
    target = torch.full((1, M, SIZE), 1.0).double()
    apart = model(batch, start, source_embedding=unlike, target_embedding=target).log_association[..., -1]
    near = model(batch, start, source_embedding=alike, target_embedding=target).log_association[..., -1]
    assert (near < apart).all()


@pytest.mark.parametrize("layer", [JointScanCRF, MatchingCRF])
@pytest.mark.parametrize("embedding", ["dot", "cosine"])
def test_gradients_reach_embeddings_and_their_weights(embedding: str, layer: type[JointScanCRF]) -> None:
    batch, start = scene(2)
    model = make_model(embedding, layer)
    with torch.no_grad():
        model.association_weights["data_boosting"].fill_(0.5)
    given_ = {name: value.requires_grad_() for name, value in embeddings(2).items()}
    start = start.background_alone() if layer is MatchingCRF else start
    found = model(batch, start, **given_)
    assert found.association_confidence is not None
    (found.association_confidence.sum() + found.motions.sum()).backward()
    for value, mask in zip(given_.values(), (batch.source_mask, batch.target_mask), strict=True):
        assert value.grad is not None
        assert value.grad.isfinite().all()
        assert not value.grad[~mask].any()
    source = given_["source_embedding"].grad
    assert source is not None
    assert (source.abs().sum(-1) > 0)[batch.source_mask].all()
    for name in ("embedding", "embedding_data"):
        slope = model.association_weights[name].grad
        assert slope is not None
        assert slope != 0


# --- log potentials -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("coupling", ["motions", "lattice"])
def test_a_point_can_be_called_an_outlier(coupling: str) -> None:
    batch, start = scene(2)
    model = make_model(coupling=coupling)
    found = model(batch, start, extra_log_unary=logits(1000.0, pairs=2))
    assert (found.association == -1).all()
    assert (found.cluster == -1).all()
    found = model(batch, start, extra_log_unary=logits(-1000.0, pairs=2))
    assert (found.association >= 0)[batch.source_mask].all()
    assert (found.cluster >= 0)[batch.source_mask].all()


@pytest.mark.parametrize("coupling", ["motions", "lattice"])
def test_a_point_can_be_called_moving_or_not(coupling: str) -> None:
    batch, start = scene(2)
    model = make_model(coupling=coupling)
    assert (model(batch, start, extra_log_unary=logits(moving=1000.0, pairs=2)).cluster == 1)[batch.source_mask].all()
    assert (model(batch, start, extra_log_unary=logits(moving=-1000.0, pairs=2)).cluster <= 0).all()


def test_log_potentials_are_nats() -> None:
    """A chain of one point: its beliefs are its potentials."""
    batch, start = scene(n=1, m=1)
    model = make_model(iterations=1)
    some = ExtraLogUnary(torch.full((1, 1), 0.7).double(), torch.full((1, 1), -0.4).double())
    plain, found = model(batch, start), model(batch, start, extra_log_unary=some)
    for log, shift in (("log_cluster", [0.0, -0.4, 0.7]), ("log_association", [0.0, 0.7])):
        expected = torch.log_softmax(getattr(plain, log) + torch.tensor(shift).double(), -1)
        assert_close(getattr(found, log), expected.detach(), tolerance=1e-6)


def test_the_choice_of_movers_hears_of_moving_points() -> None:
    batch, start = scene()
    model = make_model()
    config = model.config.inference
    from torchcrf_scan.inference.joint import first_state

    def worth(extra: ExtraLogUnary | None) -> float:
        view = model.view(batch, model.learned_inputs(batch, extra_log_unary=extra))
        state = first_state(view, start, config)
        return float(evidence(view, start, state, model.fitted, config)[0, 1])

    assert worth(logits(moving=2.0)) > worth(None) > worth(logits(moving=-2.0))


@pytest.mark.parametrize("layer", [JointScanCRF, ClusteringCRF])
def test_gradients_reach_the_log_potentials(layer: type[JointScanCRF]) -> None:
    batch, start = scene(2)
    outlier, moving = normal(2, N, seed=3).requires_grad_(), normal(2, N, seed=4).requires_grad_()
    found = make_model(layer=layer)(batch, start, extra_log_unary=ExtraLogUnary(outlier, moving))
    assert found.cluster_confidence is not None
    found.cluster_confidence.sum().backward()
    for value in (outlier, moving):
        assert value.grad is not None
        assert value.grad.isfinite().all()
        assert value.grad[batch.source_mask].any()
        assert not value.grad[~batch.source_mask].any()


@settings(max_examples=10)
@given(st.integers(0, 50))
def test_padding_is_not_looked_at(seed: int) -> None:
    batch, start = scene(2)
    model = make_model("cosine")
    clean, rubbish = embeddings(2), embeddings(2)
    extra, spoilt = (ExtraLogUnary(normal(2, N, seed=seed), normal(2, N, seed=seed + 1)) for _ in range(2))
    for name, mask in (("source_embedding", batch.source_mask), ("target_embedding", batch.target_mask)):
        rubbish[name][~mask] = torch.nan
    for value in (spoilt.outlier, spoilt.moving):
        assert value is not None
        value[~batch.source_mask] = torch.inf
    found = model(batch, start, **rubbish, extra_log_unary=spoilt)
    assert_identical(found, model(batch, start, **clean, extra_log_unary=extra))


# --- what goes wrong ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"source_embedding": normal(1, N, 3)}, r"target_embedding: expected both"),
        ({"source_embedding": normal(1, N, 3), "target_embedding": normal(1, M, 4)}, r"target_embedding: expected both .* same C"),
        ({"source_embedding": normal(1, N - 1, 3), "target_embedding": normal(1, M, 3)}, r"source_embedding: expected shape"),
        ({"source_embedding": normal(1, N), "target_embedding": normal(1, M, 3)}, r"source_embedding: expected shape"),
        ({"extra_log_unary": ExtraLogUnary(moving=normal(1, N, 1))}, r"extra_log_unary\.moving: expected shape \(1, 12\)"),
        ({"extra_log_unary": ExtraLogUnary(outlier=normal(1, M))}, r"extra_log_unary\.outlier: expected shape"),
    ],
)
def test_wrong_shapes_are_named(wrong: dict[str, object], message: str) -> None:
    batch, start = scene()
    with pytest.raises(ValueError, match=message):
        make_model("dot")(batch, start, **wrong)


def test_embeddings_need_a_model_that_knows_them() -> None:
    batch, start = scene()
    with pytest.raises(ValueError, match=r"source_embedding: expected none for a model with features\.embedding none"):
        make_model()(batch, start, **embeddings())


def test_flooding_does_not_take_them() -> None:
    batch, start = scene()
    with pytest.raises(ValueError, match="schedule: expected sweep with embeddings"):
        make_model(schedule="flooding")(batch, start, extra_log_unary=logits(1.0))


def test_compiled_code_does_not_take_embeddings_and_says_so() -> None:
    batch, start = scene()
    settings_ = {"backend": "compiled", "motion_weights": "hard", "embedding": "dot"}
    with torch.no_grad(), pytest.raises(ValueError, match=r"backend: expected for compiled no embeddings"):
        make_model(**settings_)(batch, start, **embeddings())
    smooth = JointScanCRF(ModelConfig(features=FeatureConfig(smooth=0.1), inference=InferenceConfig(backend="compiled")))
    with torch.no_grad(), pytest.raises(ValueError, match=r"backend: expected for compiled .* smooth: 0\.1"):
        smooth.double()(batch, start)


def test_where_compiled_code_would_answer_tensors_do() -> None:
    batch, start = scene()
    own = {"motion_weights": "hard", "stop_early": True, "iterations": 5, "embedding": "dot"}
    with torch.no_grad():
        found, expected = (make_model(backend=backend, **own)(batch, start, **embeddings()) for backend in ("auto", "eager"))
    assert torch.equal(found.association, expected.association)
    assert torch.equal(found.cluster, expected.cluster)
    assert_close(found.log_association, expected.log_association)
    assert_close(found.log_cluster, expected.log_cluster)
    assert_close(found.motions, expected.motions)


@torch.no_grad()
def test_compiled_code_takes_log_potentials() -> None:
    batch, start = scene()
    own = {"motion_weights": "hard", "stop_early": True, "iterations": 5}
    given = logits(0.3, 0.2)
    compiled, eager = (make_model(backend=backend, **own)(batch, start, extra_log_unary=given) for backend in ("compiled", "eager"))
    plain = make_model(backend="compiled", **own)(batch, start)
    assert torch.equal(compiled.cluster, eager.cluster)
    assert_close(compiled.log_cluster, eager.log_cluster, tolerance=1e-6)
    assert_close(compiled.log_association, eager.log_association, tolerance=1e-6)
    assert not torch.allclose(compiled.log_cluster, plain.log_cluster)


# --- saving -------------------------------------------------------------------------------------------------------------------


def test_a_saved_layer_comes_back(tmp_path: Path) -> None:
    batch, start = scene()
    model = make_model("cosine")
    with torch.no_grad():
        model.association_weights["embedding"].fill_(2.5)
    model.save_pretrained(tmp_path)
    run_time = {name: getattr(model.config.inference, name) for name in RUN_TIME}  # not saved beside weights
    again = JointScanCRF.from_pretrained(tmp_path, **run_time).double()
    assert again.config == model.config
    assert_identical(again(batch, start, **embeddings()), model(batch, start, **embeddings()))


def test_the_shipped_weights_can_begin_a_layer() -> None:
    plain = JointScanCRF.from_pretrained(backend="eager")
    model = JointScanCRF.from_pretrained(features={"embedding": "dot", "smooth": 0.1, "learn_stumps": True}, backend="eager")
    assert model.association_weights["embedding"] == 1
    for name, value in plain.state_dict().items():
        assert torch.equal(model.state_dict()[name], value), name
    assert "boosters.data.table" in dict(model.named_parameters())
