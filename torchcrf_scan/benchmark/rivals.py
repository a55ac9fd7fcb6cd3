"""Other people's libraries on the same work: registration of the same pair, decoding of the same chain; absent ones are noted."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping
from importlib import import_module
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchcrf_scan.baselines.libraries import REACH, planar_motion
from torchcrf_scan.inference.messages import chain_beliefs
from torchcrf_scan.scan import Floats, Ints, Scan, ScanPair

ITERATIONS = 50
NODES, STATES = 361, (16, 17)
SEED = 1
Register = Callable[[ScanPair], Floats]
Decode = Callable[[], object]


# --- registration -------------------------------------------------------------------------------------------------------------


def _flat_cloud(scan: Scan) -> Floats:
    """(N, 3) points at height 0."""
    return np.column_stack([scan.points, np.zeros(len(scan))])


def _spatial(pair: ScanPair) -> Floats:
    """(4, 4) rigid transform of the prior motion, the identity without one."""
    theta, x, y = (0.0, 0.0, 0.0) if pair.initial_motion is None else pair.initial_motion
    transform = np.eye(4)
    transform[:2, :2] = [[np.cos(theta), -np.sin(theta)], [np.sin(theta), np.cos(theta)]]
    transform[:2, 3] = x, y
    return transform


def load_small_gicp() -> Register:
    """small_gicp's ICP with one thread, its clouds and its tree made anew."""
    small_gicp: Any = import_module("small_gicp")

    def register(pair: ScanPair) -> Floats:
        target, source = (small_gicp.PointCloud(_flat_cloud(scan)) for scan in (pair.target, pair.source))
        options = {"registration_type": "ICP", "max_correspondence_distance": REACH, "max_iterations": ITERATIONS}
        found = small_gicp.align(target, source, init_T_target_source=_spatial(pair), num_threads=1, **options)
        return planar_motion(found.T_target_source)

    return register


def load_open3d() -> Register:
    """Open3D's point-to-point ICP; it chooses its threads itself."""
    open3d: Any = import_module("open3d")

    def register(pair: ScanPair) -> Floats:
        clouds = [open3d.utility.Vector3dVector(_flat_cloud(scan)) for scan in (pair.source, pair.target)]
        source, target = (open3d.geometry.PointCloud(points) for points in clouds)
        found = open3d.pipelines.registration.registration_icp(source, target, REACH, _spatial(pair))
        return planar_motion(found.transformation)

    return register


REGISTRATIONS: Mapping[str, Callable[[], Register]] = {"small_gicp ICP": load_small_gicp, "Open3D ICP": load_open3d}


# --- one chain ----------------------------------------------------------------------------------------------------------------


def make_chain(nodes: int, states: int) -> tuple[Tensor, Tensor]:
    """Log potentials (N, S) of the nodes and (S, S) of every edge, which all libraries can take."""
    generator = torch.Generator().manual_seed(SEED)
    return torch.randn(nodes, states, generator=generator), torch.randn(states, states, generator=generator)


def viterbi(log_unary: Floats, log_pairwise: Floats) -> Ints:
    """(N,) best labelling in plain numpy, a step a node. log_unary: (N, S); log_pairwise: (N-1, S, S)."""
    score, back = log_unary[0], np.empty(log_pairwise.shape[:2], dtype=np.int64)
    for i, edge in enumerate(log_pairwise):
        total = score[:, None] + edge  # (S, S)
        back[i] = total.argmax(0)
        score = total.max(0) + log_unary[i + 1]
    labels = np.empty(len(log_unary), dtype=np.int64)
    labels[-1] = score.argmax()
    for i in range(len(back) - 1, -1, -1):
        labels[i] = back[i, labels[i + 1]]
    return labels


def chain_of_eager(unary: Tensor, transition: Tensor) -> Decode:
    """The reference: max-marginals of every node, both directions."""
    edges, mask = transition.expand(1, len(unary) - 1, -1, -1).contiguous(), torch.ones(1, len(unary), dtype=torch.bool)
    return torch.no_grad()(lambda: chain_beliefs(unary[None], edges, mask)[0].argmax(-1))


def chain_of_compiled(unary: Tensor, transition: Tensor) -> Decode:
    """The same in machine code."""
    messages: Any = import_module("torchcrf_scan.loops.messages")
    nodes, edges = unary.double().numpy(), transition.double().expand(len(unary) - 1, -1, -1).contiguous().numpy()
    return lambda: messages.max_marginals(nodes, edges).argmax(-1)


def chain_of_numpy(unary: Tensor, transition: Tensor) -> Decode:
    """The best labelling, one direction, in float64."""
    nodes, edges = unary.double().numpy(), transition.double().expand(len(unary) - 1, -1, -1).contiguous().numpy()
    return lambda: viterbi(nodes, edges)


def chain_of_pytorch_crf(unary: Tensor, transition: Tensor) -> Decode:
    """The best labelling, one direction; the library has one transition matrix for all edges."""
    crf = import_module("torchcrf").CRF(unary.shape[1], batch_first=True)
    with torch.no_grad():
        crf.transitions.copy_(transition)
        crf.start_transitions.zero_()
        crf.end_transitions.zero_()
    mask = torch.ones(1, len(unary), dtype=torch.bool)
    return torch.no_grad()(lambda: np.array(crf.decode(unary[None], mask)[0]))


def _struct_chain(unary: Tensor, transition: Tensor) -> Any:
    edges = transition.T + unary[1:, :, None]  # (N-1, S, S), row = state of the later node
    edges[0] += unary[0]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # it says nothing of the range of its arguments
        return import_module("torch_struct").LinearChainCRF(edges[None])


def struct_argmax(unary: Tensor, transition: Tensor) -> Decode:
    """The best labelling, by the gradient of the best score."""
    _struct_chain(unary, transition)

    def decode() -> Tensor:
        best = _struct_chain(unary, transition).argmax[0].detach()  # (N-1, S, S)
        return torch.cat([best[:1].sum(1).argmax(-1), best.sum(2).argmax(-1)])

    return decode


def struct_marginals(unary: Tensor, transition: Tensor) -> Decode:
    """Sum-product marginals of every edge, by the gradient of log Z; it has no max-marginals."""
    _struct_chain(unary, transition)
    return lambda: _struct_chain(unary, transition).marginals


CHAINS: Mapping[str, tuple[Callable[[Tensor, Tensor], Decode], str]] = {  # name: what decodes the chain, what it gives
    "eager": (chain_of_eager, "max-marginals of every node"),
    "compiled": (chain_of_compiled, "max-marginals of every node"),
    "pytorch-crf": (chain_of_pytorch_crf, "best labelling alone; it has one transition matrix for all edges"),
    "torch-struct argmax": (struct_argmax, "best labelling alone"),
    "torch-struct marginals": (struct_marginals, "sum-product marginals; it has no max-marginals"),
    "numpy Viterbi": (chain_of_numpy, "best labelling alone"),
}
OUR_CHAINS = ("eager", "compiled")
WITHOUT_LABELS = ("torch-struct marginals",)


def load(make: Callable[..., Any], *arguments: object) -> tuple[Any, str]:
    """What it makes, and "", or nothing and the reason where a library is not there or cannot be used."""
    try:
        return make(*arguments), ""
    except (ImportError, OSError, AttributeError, RuntimeError, TypeError) as error:
        return None, f"not installed or not usable: {str(error).splitlines()[0] if str(error) else type(error).__name__}"
