"""The layouts of all entries' arguments, as the answers to a few small simulated pairs show them."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch

from torchcrf_scan.batch import ScanPairBatch
from torchcrf_scan.data.simulate import simulate_pairs
from torchcrf_scan.data.worlds import SimulatorConfig
from torchcrf_scan.learning.hypothesis_fit import fit_hypothesis_score, view_pair
from torchcrf_scan.loops import chains
from torchcrf_scan.loops.jit import ENTRIES, Entry, in_python
from torchcrf_scan.loops.layout import Layout, layouts_of
from torchcrf_scan.model import JointScanCRF
from torchcrf_scan.scan import Scan, ScanPair

BEAMS = 31


def record_layouts() -> dict[str, list[Layout]]:
    """Entry: the layouts of its arguments.

    Raises:
        TypeError: the examples call an entry with different layouts, or do not call it at all.
    """
    found: dict[str, list[Layout]] = {}

    def watch(entry: Entry, arguments: tuple[Any, ...]) -> None:
        layouts = layouts_of(entry.python, arguments)
        if found.setdefault(entry.name, layouts) != layouts:
            raise TypeError(f"{entry.name}: expected always the same layouts, got {found[entry.name]} and {layouts}")

    with in_python(watch):
        answer_examples()
    if missing := sorted(ENTRIES.keys() - found.keys()):
        raise TypeError(f"expected examples that call every entry, got none for {', '.join(missing)}")
    return found


def answer_examples() -> None:
    """Runs a cold pair, one with a guess, an empty scan, gradients, and what fits the movers' score."""
    pairs = simulate_pairs(SimulatorConfig(beams=BEAMS), 2, 1, 0)
    pair = pairs[0]
    guess = ScanPair(pair.source, pair.target, pair.dt, initial_motion=np.array([0.0, 0.1, 0.0]))
    empty = Scan.from_ranges(np.full(BEAMS, np.inf), angle_min=-1.5, angle_increment=0.1)
    JointScanCRF.from_pretrained().match(pair.source, pair.target)
    JointScanCRF.from_pretrained("encoder", iterations=0).match_pairs([guess, ScanPair(empty, pair.target, pair.dt)])
    soft = JointScanCRF.from_pretrained(motion_weights="soft", iterations=2)
    soft(ScanPairBatch.collate(pairs)).motions.sum().backward()
    soft.pseudo_log_likelihood(ScanPairBatch.collate(pairs))
    nodes, edges = torch.zeros(1, 3, 2, requires_grad=True), torch.zeros(1, 2, 2, 2)
    (chains.MaxMarginals.apply(nodes, edges).sum() + chains.LogPartition.apply(nodes, edges)[0].sum()).backward()
    chains.totals_without(nodes, edges)
    fit_hypothesis_score([view for k, pair in enumerate(pairs) for view in view_pair(pair, k, views=1)])
