"""Third-party libraries on the same work: registration of the same pair, decoding of the same chain; missing ones are noted."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping
from importlib import import_module
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchcrf_scan.baselines.libraries import register_open3d, register_small_gicp
from torchcrf_scan.batch import initial_motion_of
from torchcrf_scan.inference.messages import chain_beliefs
from torchcrf_scan.scan import Floats, Ints, ScanPair

NODES, STATES = 361, (16, 17)
SEED = 1
Register = Callable[[ScanPair], Floats]
Decode = Callable[[], object]


# --- registration -------------------------------------------------------------------------------------------------------------


def load_small_gicp() -> Register:
    """small_gicp's ICP from the pair's initial motion."""
    import_module("small_gicp")
    return lambda pair: register_small_gicp(pair, initial_motion_of(pair))


def load_open3d() -> Register:
    """Open3D's ICP from the pair's initial motion."""
    import_module("open3d")
    return lambda pair: register_open3d(pair, initial_motion_of(pair))


REGISTRATIONS: Mapping[str, Callable[[], Register]] = {"small_gicp ICP": load_small_gicp, "Open3D ICP": load_open3d}


# --- one chain ----------------------------------------------------------------------------------------------------------------


def make_chain(nodes: int, states: int) -> tuple[Tensor, Tensor]:
    """Log potentials (N, S) of the nodes and (S, S) of every edge, in a form common to all libraries."""
    generator = torch.Generator().manual_seed(SEED)
    return torch.randn(nodes, states, generator=generator), torch.randn(states, states, generator=generator)


def viterbi(log_unary: Floats, log_pairwise: Floats) -> Ints:
    """(N,) best labelling in plain numpy, one step per node. log_unary: (N, S); log_pairwise: (N-1, S, S)."""
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
    """The backend `eager`: max-marginals of every node, both directions."""
    edges, mask = transition.expand(1, len(unary) - 1, -1, -1).contiguous(), torch.ones(1, len(unary), dtype=torch.bool)
    return torch.no_grad()(lambda: chain_beliefs(unary[None], edges, mask)[0].argmax(-1))


def chain_of_compiled(unary: Tensor, transition: Tensor) -> Decode:
    """The backend `compiled`: the same in machine code."""
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
        warnings.simplefilter("ignore")  # it warns about the range of its arguments
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


CHAINS: Mapping[str, tuple[Callable[[Tensor, Tensor], Decode], str]] = {  # name: decoder of the chain, its result
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
    """The result of `make` and "", or None and the reason if a library is missing or unusable."""
    try:
        return make(*arguments), ""
    except (ImportError, OSError, AttributeError, RuntimeError, TypeError) as error:
        return None, f"not installed or not usable: {str(error).splitlines()[0] if str(error) else type(error).__name__}"
