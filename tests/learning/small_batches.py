"""Small batches of every awkward kind, with models and inputs of every kind, for tests of losses and their gradients."""

from dataclasses import dataclass, replace

import torch
from support import generator, make_points
from torch import Tensor

from torchcrf_scan import ClusteringCRF, ExtraLogUnary, JointScanCRF, MatchingCRF
from torchcrf_scan.batch import ScanPairBatch, Truth
from torchcrf_scan.config import FeatureConfig, InferenceConfig, ModelConfig
from torchcrf_scan.geometry import se2
from torchcrf_scan.inference.start import Start
from torchcrf_scan.learning.settings import UnrolledConfig

MOTIONS = torch.tensor([[0.05, -0.3, 0.1], [-0.1, 0.9, 0.3], [0.2, -0.2, -1.0]], dtype=torch.float64)
KINDS = ("ordinary", "duplicates", "line", "origin", "all outliers", "one point", "empty", "far", "padding", "unmoved")
SIZE = 4  # of embeddings


@dataclass(frozen=True)
class Case:
    """A batch with a start, and a model with what it is given beside them."""

    model: JointScanCRF
    batch: ScanPairBatch
    start: Start
    inputs: dict[str, object]
    config: UnrolledConfig

    @property
    def leaves(self) -> dict[str, Tensor]:
        """Everything that gradients are asked for."""
        extra = self.inputs.get("extra_log_unary") or ExtraLogUnary()
        given = {name: value for name, value in self.inputs.items() if isinstance(value, Tensor)}
        given |= {"source": self.batch.source, "target": self.batch.target, "start": self.start.motions}
        given |= {f"extra.{name}": getattr(extra, name) for name in ("outlier", "moving")}  # type: ignore[dict-item]
        return {**dict(self.model.named_parameters()), **{name: value for name, value in given.items() if value is not None}}


def labelled_scene(n: int = 10, movers: int = 1, seed: int = 4, noise: float = 0.03) -> tuple[ScanPairBatch, Start]:
    """One pair whose points form runs that move as MOTIONS says, its truth, and a start a little off it."""
    source = make_points(n, seed)
    run = torch.arange(n) * (2 * movers + 1) // n
    cluster = torch.where(run % 2 == 1, (run + 1) // 2, 0)
    wobble = noise * torch.randn(n, 2, generator=generator(seed), dtype=torch.float64)
    target = se2.apply(MOTIONS[cluster], source[:, None])[:, 0] + wobble
    real = torch.ones(1, n, dtype=torch.bool)
    truth = Truth(torch.arange(n)[None], cluster[None], MOTIONS[None, : movers + 1], real)
    batch = as_batch(source[None], target[None], real, real, truth)
    return batch, start_at(batch, MOTIONS[None, : movers + 1] + 0.02, truth.association)


def as_batch(source: Tensor, target: Tensor, source_mask: Tensor, target_mask: Tensor, truth: Truth) -> ScanPairBatch:
    B = len(source)
    return ScanPairBatch(
        source=source * source_mask[..., None],
        target=target * target_mask[..., None],
        source_mask=source_mask,
        target_mask=target_mask,
        source_closed=torch.zeros(B, dtype=torch.bool),
        target_closed=torch.zeros(B, dtype=torch.bool),
        dt=torch.full((B,), 0.1).to(source),
        range_noise=torch.full((B,), 0.01).to(source),
        initial_motion=torch.zeros(B, 3).to(source),
        truth=truth,
    )


def start_at(batch: ScanPairBatch, motions: Tensor, association: Tensor, **more: Tensor) -> Start:
    """motions: (B, C, 3), all of them active; tangents point across the beam."""
    across = torch.stack([-batch.target[..., 1], batch.target[..., 0]], dim=-1)
    active = more.pop("active", torch.ones(motions.shape[:2], dtype=torch.bool))
    return Start(motions, active, association, torch.nn.functional.normalize(across, dim=-1), **more)


def random_case(seed: int, dtype: torch.dtype = torch.float64) -> Case:
    """Case number `seed`: N, M <= 12, B <= 3, two rounds."""
    draw = generator(seed)

    def whole(low: int, high: int) -> int:
        return int(torch.randint(low, high + 1, (), generator=draw))

    def choose(*options: object) -> object:
        return options[whole(0, len(options) - 1)]

    def numbers(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=draw, dtype=torch.float64).to(dtype)

    B, N, M, G, C = whole(1, 3), whole(1, 12), whole(1, 12), whole(1, 3), whole(1, 4)
    kinds = [str(choose(*KINDS)) for _ in range(B)]
    batch = random_batch(kinds, N, M, G, seed, dtype)
    motions = torch.cat([MOTIONS, MOTIONS[:1] + 0.001])[:C].to(dtype) + 0.02 * numbers(B, C, 3)
    motions = torch.stack([m + 500.0 if kind == "far" else m for kind, m in zip(kinds, motions, strict=True)])
    has_target = batch.target_mask.sum(-1, keepdim=True)
    association = torch.randint(-1, M, (B, N), generator=draw)
    association = association.masked_fill((association >= has_target) | ~batch.source_mask, -1)
    association = torch.stack([torch.full((N,), -1) if k == "all outliers" else a for k, a in zip(kinds, association, strict=True)])
    more: dict[str, Tensor] = {}
    if choose(True, False):
        more["reach"] = (4 * torch.rand(B, N, C, generator=draw) - 2.8).clamp(min=0).to(dtype) * (torch.arange(C) > 0)
    if choose(True, False):
        more["log_odds"] = numbers(B, C).masked_fill(torch.rand(B, C, generator=draw) < 0.3, -torch.inf)
        more["log_odds"][:, 0] = torch.inf
    start = start_at(batch, motions.requires_grad_(), association, **more)
    batch = replace(batch, source=batch.source.requires_grad_(), target=batch.target.requires_grad_())

    chains = str(choose("joint", "joint", "matching", "clustering"))
    coupling = str(choose("motions", "lattice")) if chains == "joint" else "motions"
    smooth, embedding = float(choose(0.0, 0.2)), str(choose("none", "dot", "cosine"))  # type: ignore[arg-type]
    config = ModelConfig(
        coupling=coupling,
        features=FeatureConfig(
            stumps=6,
            smooth=smooth,
            learn_stumps=smooth > 0 and bool(choose(True, False)),
            embedding=embedding,
            length_unit=str(choose("metre", "spacing")),
            reach=("hard", "soft", "off")[seed % 3],
            left_out=(),
        ),
        inference=InferenceConfig(
            clusters=C + 1 if C > 1 else 2,
            candidates=int(choose(0, 3)),  # type: ignore[call-overload]
            temperature=float(choose(0.0, 0.5, 1.0)),  # type: ignore[arg-type]
            motion_metric=str(choose("point", "line")),
            motion_weights="soft",
            iterations=2,
            stop_early=False,
            backend="eager",
        ),
    )
    layer = {"joint": JointScanCRF, "matching": MatchingCRF, "clustering": ClusteringCRF}[chains]
    model = with_random_weights(layer(config).to(dtype), seed)
    if chains == "matching":
        start = start.background_alone()
    inputs: dict[str, object] = {}
    if embedding != "none":
        inputs["source_embedding"] = (numbers(B, N, SIZE) * (torch.rand(B, N, 1, generator=draw) < 0.8)).requires_grad_()
        inputs["target_embedding"] = (numbers(B, M, SIZE) * (torch.rand(B, M, 1, generator=draw) < 0.8)).requires_grad_()
    if choose(True, False):
        outlier, moving = (3 * numbers(B, N)).requires_grad_(), (3 * numbers(B, N)).requires_grad_()
        inputs["extra_log_unary"] = ExtraLogUnary(outlier, moving if choose(True, False) else None)
    loss = UnrolledConfig(
        iterations=2,
        temperature=float(choose(0.5, 1.0, 3.0)),  # type: ignore[arg-type]
        detach_motion=bool(choose(True, False)),
        deep_supervision=float(choose(0.0, 0.5, 1.0)),  # type: ignore[arg-type]
    )
    return Case(model, batch, start, inputs, loss)


def random_batch(kinds: list[str], N: int, M: int, G: int, seed: int, dtype: torch.dtype) -> ScanPairBatch:
    """One pair of each kind, with a random annotation of G clusters."""
    draw = generator(seed + 1)
    B = len(kinds)
    cluster = torch.randint(-1, G, (B, N), generator=draw)
    rows = []
    for b, kind in enumerate(kinds):
        source = make_points(N, seed + b)
        if kind == "duplicates":
            source = source[:1].expand(N, 2)
        elif kind == "line":
            source = torch.stack([torch.ones(N).double(), torch.arange(N).double()], -1)
        elif kind == "origin":
            source = source * (torch.arange(N) % 2)[:, None]
        moved = se2.apply(MOTIONS[cluster[b].clamp(min=0)], source[:, None])[:, 0]
        rows.append((source, source if kind == "unmoved" else moved))
    source, target = (torch.stack(part).to(dtype) for part in zip(*rows, strict=True))
    place = torch.randint(0, N, (M,), generator=draw) if M > N else torch.arange(M)
    lengths = {"one point": (1, 1), "empty": (0, M), "padding": (N // 2, M // 2)}
    n, m = (torch.tensor([lengths.get(kind, (N, M))[side] for kind in kinds])[:, None] for side in (0, 1))
    source_mask, target_mask = torch.arange(N) < n, torch.arange(M) < m
    is_outlier = torch.tensor([kind == "all outliers" for kind in kinds])[:, None]
    association = torch.arange(N).expand(B, N).masked_fill((cluster < 0) | is_outlier | (torch.arange(N) >= m), -1)
    motions = MOTIONS[:G].to(dtype).expand(B, G, 3).clone()
    motions[torch.rand(B, G, generator=draw) < 0.2] = torch.nan
    known = source_mask & (torch.rand(B, N, generator=draw) < 0.8)
    truth = Truth(association, cluster.masked_fill(is_outlier, -1), motions, known)
    return as_batch(source, target[:, place], source_mask, target_mask, truth)


@torch.no_grad()
def with_random_weights(model: JointScanCRF, seed: int) -> JointScanCRF:
    """Weights of ordinary size and stumps; they need no gradient where they are buffers."""
    draw = generator(seed + 2)
    for weight in (*model.association_weights.values(), *model.clustering_weights.values()):
        weight.copy_(torch.randn((), generator=draw))
    for ensemble in (model.boosters.data, model.boosters.outlier):
        features, stumps = ensemble.thresholds.shape
        left, right = torch.randn(2, stumps, generator=draw)
        ensemble.set_stumps(torch.arange(stumps) % features, -9 * torch.rand(stumps, generator=draw), left, right)
    return model
