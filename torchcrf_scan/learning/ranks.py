"""The processes of one training run: a single one, or those started by `torchrun`, on one machine or several."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import timedelta
from typing import TypeVar, cast

import torch
from torch import Tensor, distributed, nn

from torchcrf_scan.errors import TorchCRFScanError

T = TypeVar("T")
CPU = torch.device("cpu")
PATIENCE = timedelta(hours=24)  # the others wait for the staged fit of the first one


@dataclass(frozen=True, slots=True)
class Ranks:
    """This process among all, and its `device`. A single process does not communicate."""

    rank: int = 0
    world: int = 1
    device: torch.device = CPU

    @property
    def is_first(self) -> bool:
        """Whether this process is the one that writes."""
        return self.rank == 0

    def sum(self, values: Tensor) -> Tensor:
        """The sum over all processes, the same in each of them."""
        if self.world > 1:
            distributed.all_reduce(values)
        return values

    def gather(self, value: T) -> list[T]:
        """Every process's object, by rank."""
        if self.world == 1:
            return [value]
        everyone: list[T | None] = [None] * self.world
        distributed.all_gather_object(everyone, value)
        return cast(list[T], everyone)

    def share(self, value: T) -> T:
        """The first process's object, in all processes."""
        if self.world == 1:
            return value
        box = [value]
        distributed.broadcast_object_list(box)
        return box[0]

    def share_weights(self, module: nn.Module) -> None:
        """Copies the first process's parameters and buffers to every process."""
        state = {name: value.cpu() for name, value in module.state_dict().items()}
        module.load_state_dict(self.share(state))


ALONE = Ranks()


@contextmanager
def join(device: str = "auto", environment: Mapping[str, str] = os.environ) -> Iterator[Ranks]:
    """Joins the processes started by `torchrun`, if any, and leaves them at the end; nccl on GPUs, gloo on CPUs.

    device: `auto`, `cpu` or `cuda`.

    Raises:
        TorchCRFScanError: `cuda` on a machine without.
    """
    has_gpu = torch.cuda.is_available()
    if device == "cuda" and not has_gpu:
        raise TorchCRFScanError("gradient.device: expected cpu or auto on a machine without a GPU, got cuda")
    on_gpu = has_gpu and device != "cpu"
    place = torch.device("cuda", int(environment.get("LOCAL_RANK", 0))) if on_gpu else torch.device("cpu")
    world = int(environment.get("WORLD_SIZE", 1))
    if world == 1:
        yield Ranks(device=place)
        return
    if on_gpu:
        torch.cuda.set_device(place)
    distributed.init_process_group("nccl" if on_gpu else "gloo", timeout=PATIENCE)
    try:
        yield Ranks(distributed.get_rank(), world, place)
    finally:
        distributed.destroy_process_group()
