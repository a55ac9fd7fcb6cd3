"""Comparison with another checkout of this package: the same calls, in turns, in one process each; ratios of processor times.

Both processes run the same small program, which uses only the interface common to all versions of the package.
"""

from __future__ import annotations

import os
import statistics
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import Any

from torchcrf_scan.data.pair_file import write_pair
from torchcrf_scan.errors import TorchCRFScanError
from torchcrf_scan.scan import ScanPair

BATCH = 32
ROUNDS = 3  # of the rows with a gradient
STEP = 16  # pairs of a step of training
TASKS = {
    "cold, one pair": "match",
    "warm, one pair": "match_warm",
    f"cold, batch of {BATCH}": "match_batch",
    f"warm, batch of {BATCH}": "match_batch_warm",
    f"{ROUNDS} rounds forward and backward, one pair": "rounds",
    f"{ROUNDS} rounds forward and backward, a pair of {BATCH}": "rounds_batch",
    "pseudo-likelihood and its gradient, a pair": "likelihood",
    f"step of an encoder on {STEP} fresh pairs, a pair": "step",
}
WORLDS = "street,fast_street,model_cars,model_cars_dominant,indoor,street_dominant,still_street,still_indoor"
LEARNING = [  # of an encoder, on the worlds that the checkouts have in common
    *("--learning.objective=likelihood", "--gradient.objective=likelihood", f"--gradient.worlds=[{WORLDS}]"),
    *("--learning.predicted_share=0.5", "--learning.disturbance=1.2", "--gradient.fresh=1", "--gradient.workers=0"),
    *(
        f"--gradient.batch_size={STEP}",
        f"--gradient.part={STEP // 2}",
        "--gradient.augment.dropout=0.3",
        "--gradient.augment.noise=1.5",
    ),
]
PROGRAM = f"""
import sys, time, torch
from dataclasses import replace
torch.set_num_threads(1)
from torchcrf_scan import JointScanCRF, ScanPairBatch
from torchcrf_scan.data.pair_file import read_pair

name, *files = sys.argv[1:]
model = JointScanCRF.from_pretrained(name)
soft = JointScanCRF.from_pretrained(name, motion_weights="soft", stop_early=False, iterations={ROUNDS})
pairs = [read_pair(file) for file in files]
warm = [replace(pair, initial_motion=pair.annotation.motions[0] + [0.003, 0.02, -0.02]) for pair in pairs]
many, many_warm = (([*of] * {BATCH})[:{BATCH}] for of in (pairs, warm))
batches = {{}}

def rounds(some):
    if len(some) not in batches:
        batch = ScanPairBatch.collate(some)
        with torch.no_grad():
            batches[len(some)] = batch.without_truth(), soft.initialise(batch.without_truth())
    batch, start = batches[len(some)]
    soft.zero_grad()
    answer = soft(batch, start)
    inside = batch.source_mask[..., None]
    (answer.log_cluster.exp() * inside).sum().add(answer.motions.square().sum()).backward()

def likelihood():
    model.zero_grad()
    (-model.pseudo_log_likelihood(ScanPairBatch.collate(many)).sum()).backward()

def step():
    if not learning:
        from torchcrf_scan.experiment.parser import config_of, settings_parser
        from torchcrf_scan.learning.gradient import Learner, portions_from
        from torchcrf_scan.learning.objectives import make_objective
        from torchcrf_scan.learning.ranks import Ranks
        parser = settings_parser()
        config, alone = config_of(parser.instantiate(parser.parse_args({LEARNING}))), Ranks()
        learner = Learner(JointScanCRF.from_pretrained("encoder"), config.gradient, alone)
        learning.extend([learner, make_objective(config), portions_from(0, config, [], alone)])
    learner, objective, portions = learning
    learner.descend(objective, portions)

learning = []
tasks = {{
    "match": (1, lambda k: model.match_pairs([pairs[k % len(pairs)]])),
    "match_warm": (1, lambda k: model.match_pairs([warm[k % len(pairs)]])),
    "match_batch": ({BATCH}, lambda k: model.match_pairs(many, {BATCH})),
    "match_batch_warm": ({BATCH}, lambda k: model.match_pairs(many_warm, {BATCH})),
    "rounds": (1, lambda k: rounds(pairs[:1])),
    "rounds_batch": ({BATCH}, lambda k: rounds(many)),
    "likelihood": ({BATCH}, lambda k: likelihood()),
    "step": ({STEP}, lambda k: step()),
}}
for line in sys.stdin:
    task, turn = line.split()
    count, run = tasks[task]
    began = time.process_time()
    run(int(turn))
    print(1e3 * (time.process_time() - began) / count, flush=True)
"""


def compare(pairs: Sequence[ScanPair], model: str, other: Path, repeats: int) -> list[dict[str, Any]]:
    """Rows of milliseconds a pair of this package and of another checkout, medians of calls in turns, and the ratio of both.

    Args:
        pairs: annotated pairs. model: name of a shipped model. other: folder that contains the other `torchcrf_scan`.
        repeats: timed calls of every task, after one to warm up.
    """
    if not (other / "torchcrf_scan" / "__init__.py").is_file():
        raise TorchCRFScanError(f"--beside: expected a folder that holds torchcrf_scan, got {other}")
    here = Path(__file__).resolve().parents[2]
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        files = [folder / f"{k}.npz" for k in range(len(pairs))]
        for file, pair in zip(files, pairs, strict=True):
            write_pair(file, pair)
        processes = [stack.enter_context(_start(tree, model, files)) for tree in (here, other)]
        rows = []
        for name, task in TASKS.items():
            times: tuple[list[float], list[float]] = ([], [])
            for turn in range(repeats + 1):
                for process, of in zip(processes, times, strict=True):
                    of.append(_ask(process, task, turn))
            mine, theirs = (statistics.median(of[1:]) for of in times)
            rows.append({"stage": "beside", "task": name, "ms_per_pair": mine, "other_ms_per_pair": theirs, "ratio": mine / theirs})
        return rows


def _start(tree: Path, model: str, files: Sequence[Path]) -> subprocess.Popen[str]:
    environment = {**os.environ, "PYTHONPATH": str(tree)}
    command = [sys.executable, "-c", PROGRAM, model, *map(str, files)]
    pipe = subprocess.PIPE
    return subprocess.Popen(command, cwd=files[0].parent, env=environment, text=True, stdin=pipe, stdout=pipe)


def _ask(process: subprocess.Popen[str], task: str, turn: int) -> float:
    assert process.stdin is not None
    assert process.stdout is not None
    with suppress(BrokenPipeError):  # reported below
        process.stdin.write(f"{task} {turn}\n")
        process.stdin.flush()
    answer = process.stdout.readline()
    if not answer:
        with suppress(BrokenPipeError):
            process.stdin.close()
        raise TorchCRFScanError(f"--beside: expected a time of {task}, got a process that ended with {process.wait()}")
    return float(answer)
