"""Golden answers: what both shipped models say of a few simulated pairs of every world. A refactoring changes none of them.

`python tests/golden.py` writes them anew, after a change that is meant to change answers.
"""

from pathlib import Path

import numpy as np

from torchcrf_scan import JointScanCRF, PairPrediction
from torchcrf_scan.data.simulate import simulate_pairs
from torchcrf_scan.data.worlds import WORLDS

FILE = Path(__file__).parent / "golden.npz"
MODELS = ("simulated", "encoder")
PAIRS, SEED = 4, 41  # of every world
FIELDS = ("association", "cluster", "motions")


def answers(model: str, world: str) -> list[PairPrediction]:
    """The answers of a shipped model to the pairs of a world."""
    return JointScanCRF.from_pretrained(model).match_pairs(simulate_pairs(WORLDS[world], PAIRS, 2, SEED))


def arrays(found: list[PairPrediction]) -> dict[str, np.ndarray]:
    """All pairs in a row: (P,) association, (P,) cluster, (C, 3) motions."""
    return {name: np.concatenate([getattr(answer, name) for answer in found]) for name in FIELDS}


def main() -> None:
    kept = {}
    for model in MODELS:
        for world in WORLDS:
            for name, values in arrays(answers(model, world)).items():
                kept[f"{model}/{world}/{name}"] = values if name == "motions" else values.astype(np.int16)
    np.savez_compressed(FILE, **kept)


if __name__ == "__main__":
    main()
