"""The layouts of the arguments of all entries, as answers for small simulated pairs show them."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
import torch

from torchcrf_scan.data.simulate import simulate_pairs
from torchcrf_scan.data.worlds import SimulatorConfig
from torchcrf_scan.learning import hypothesis_fit
from torchcrf_scan.loops.jit import ENTRIES, Entry
from torchcrf_scan.loops.layout import Layout, layouts_of
from torchcrf_scan.model import JointScanCRF
from torchcrf_scan.scan import Scan, ScanPair


def record_layouts() -> dict[str, list[Layout]]:
    found: dict[str, list[Layout]] = {}

    def watch(entry: Entry, arguments: tuple[Any, ...]) -> None:
        layouts = layouts_of(entry.python, arguments)
        if found.setdefault(entry.name, layouts) != layouts:
            raise TypeError(f"{entry.name}: expected always the same layouts, got {found[entry.name]} and {layouts}")

    Entry.watch = staticmethod(watch)
    answer_examples()
    return found


def answer_examples() -> None:
    import time
    config = SimulatorConfig(beams=31, range_max=30.0)
    t=time.process_time()
    pair = simulate_pairs(config, 1, 1, 0)[0]
    print('sim',time.process_time()-t); t=time.process_time()
    JointScanCRF.from_pretrained().match_pairs([pair])
    print('cold',time.process_time()-t); t=time.process_time()
    guess = ScanPair(pair.source, pair.target, pair.dt, initial_motion=np.array([0.0, 0.1, 0.0]))
    empty = Scan.from_ranges(np.full(31, np.inf), angle_min=-1.0, angle_increment=0.1)
    JointScanCRF.from_pretrained("encoder", iterations=0).match_pairs([guess, ScanPair(empty, pair.target, 0.1)])
    print('guess',time.process_time()-t); t=time.process_time()
    views = hypothesis_fit.view_pair(pair, 0, 1)
    hypothesis_fit._count_accepted(hypothesis_fit.HypothesisScore(), views[0])
    print('fit',time.process_time()-t); t=time.process_time()


if __name__ == "__main__":
    found = record_layouts()
    print(set(ENTRIES) - set(found))
    json.dump(found, open("/tmp/layouts.json", "w"), indent=1)
