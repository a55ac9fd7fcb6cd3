"""One process among many: alone nothing is sent; of two, both have the same."""

import os
from pathlib import Path

import pytest
import torch
from forked import run_ranks
from torch import nn

from torchcrf_scan.learning.ranks import ALONE, join


def work(folder: Path) -> None:
    """What every process of two does."""
    rank = int(os.environ["RANK"])
    with join("cpu") as ranks:
        assert (ranks.rank, ranks.world, ranks.is_first) == (rank, 2, rank == 0)
        layer = nn.Linear(2, 1)
        nn.init.constant_(layer.weight, float(rank + 5))
        ranks.share_weights(layer)
        found = {
            "sum": ranks.sum(torch.tensor([1.0, float(rank)], dtype=torch.float64)),
            "gathered": ranks.gather({"rank": rank}),
            "shared": ranks.share(["first"] if ranks.is_first else ["second"]),
            "weight": layer.weight.detach(),
        }
    torch.save(found, folder / f"{rank}.pt")


def test_two_processes_agree(tmp_path: Path) -> None:
    assert run_ranks(work, tmp_path) == [0, 0]
    for rank in range(2):
        found = torch.load(tmp_path / f"{rank}.pt", weights_only=True)
        assert found["sum"].tolist() == [2.0, 1.0]
        assert found["gathered"] == [{"rank": 0}, {"rank": 1}]
        assert found["shared"] == ["first"]
        assert found["weight"].tolist() == [[5.0, 5.0]]


def test_alone_nothing_changes() -> None:
    with join("cpu", {}) as ranks:
        assert ranks == ALONE
        assert ranks.is_first
        assert ranks.sum(torch.tensor(3.0)) == 3
        assert ranks.gather("x") == ["x"]
        assert ranks.share("x") == "x"
        layer = nn.Linear(2, 1)
        before = layer.weight.clone()
        ranks.share_weights(layer)
        assert torch.equal(layer.weight, before)


@pytest.mark.skipif(torch.cuda.is_available(), reason="needs a machine without a GPU")
def test_a_gpu_that_is_not_there_is_an_error() -> None:
    with pytest.raises(ValueError, match=r"gradient\.device: expected cpu or auto"), join("cuda", {}):
        pass
