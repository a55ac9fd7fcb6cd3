"""Does the alternation of the rounds converge? Tables of the joint objective after each of its steps, and of the rounds used."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from torchcrf_scan.evaluation.measures import mean
from torchcrf_scan.evaluation.table import Cell, Table
from torchcrf_scan.scan import Floats

TOLERANCE = 1e-3  # nats; smaller changes are none: potentials are float32
STEPS = ("clusters", "motions", "associations", "motions again")  # of a round
BETWEEN, ROUND = "candidates of the next round", "a whole round"
COURSE_NOTE = (
    "Sum of the log potentials of both chains in nats (`inference.objective`), -inf where a label has become impossible: the "
    "selection has discarded its cluster."
)
STEPS_NOTE = (
    "Changes of the objective of at least 0.001. Its own falls: of the score of the chain that the step decodes, only where an "
    "earlier association is no candidate any more. Steps from an impossible label are counted apart and left out of the means. "
    "Between two rounds candidates follow the motions, hypothesised movers are selected, empty clusters end."
)
BOUND_NOTE = (
    "Dual bound of the linear programming relaxation minus the score of the decoded labels, at the motions of that pass; 0: the "
    "relaxation is tight and the labels are the best."
)
BEST_NOTE = (
    "At the last motions: the gain of the objective, and of the lattice's own score, from the labels of the alternation to the "
    "best ones of both chains together (the lattice, spec 7.7)."
)


@dataclass(frozen=True, slots=True)
class Course:
    """The rounds of one pair, R of them until it settled or the limit was reached.

    Attributes:
        name: of the pair.
        scores: (R, 5, 2) of the association chain and of the clustering chain: before the round and after each of `STEPS`.
        gaps: (R, 2) bound minus score of both chains' passes.
        has_settled: labels and motions stopped before the limit.
        damped: number of rounds whose motions were halved because labels swung.
        lattice_gap: bound minus score of the lattice at the last motions.
        gain: of the objective, from the last labels to the lattice's at the last motions.
        lattice_gain: the same of the lattice's own score.
    """

    name: str
    scores: Floats
    gaps: Floats
    has_settled: bool
    damped: int
    lattice_gap: float
    gain: float
    lattice_gain: float

    @property
    def objective(self) -> Floats:
        """(R, 5) the sum of both scores."""
        return self.scores.sum(-1)


def convergence_tables(courses: Sequence[Course]) -> list[Table]:
    """The course of every pair, changes by step, rounds used, tightness of the bounds, comparison with the lattice."""
    return [course_table(courses), steps_table(courses), rounds_table(courses), bounds_table(courses), best_table(courses)]


def course_table(courses: Sequence[Course]) -> Table:
    """One row per pair and round."""
    rows: list[tuple[Cell, ...]] = [
        (of.name, float(r + 1), *map(float, row)) for of in courses for r, row in enumerate(of.objective)
    ]
    columns = ("pair", "round", "before", *(f"after {step}" for step in STEPS))
    return Table("The joint objective by round", columns, tuple(rows), (0, 0, *(3 for _ in range(5))), COURSE_NOTE)


def steps_table(courses: Sequence[Course]) -> Table:
    """How often each step makes the objective rise and fall, and by how much."""
    columns = (
        "step",
        "times",
        "from impossible",
        "rises",
        "falls",
        "falls (%)",
        "mean fall",
        "largest fall",
        "mean change",
        "its own falls",
    )
    own = {"clusters": 1, "associations": 0}
    rows: list[tuple[Cell, ...]] = []
    for name, (before, after) in changes(courses).items():
        falls = float("nan") if name not in own else float(np.sum(rise(before, after)[:, own[name]] <= -TOLERANCE))
        rows.append((name, *_change(before.sum(-1), after.sum(-1)), falls))
    return Table("The joint objective by step", columns, tuple(rows), (0, 0, 0, 0, 0, 1, 3, 3, 3, 0), STEPS_NOTE)


def changes(courses: Sequence[Course]) -> dict[str, tuple[Floats, Floats]]:
    """Step -> (T, 2) scores before and after it, of all rounds of all pairs."""
    scores = [of.scores for of in courses]
    ends = {name: (k, k + 1) for k, name in enumerate(STEPS)} | {ROUND: (0, len(STEPS))}
    found = {
        name: (np.concatenate([of[:, a] for of in scores]), np.concatenate([of[:, b] for of in scores]))
        for name, (a, b) in ends.items()
    }
    found[BETWEEN] = np.concatenate([of[:-1, -1] for of in scores]), np.concatenate([of[1:, 0] for of in scores])
    return found


def rise(before: Floats, after: Floats) -> Floats:
    """after - before; inf from impossible to possible, 0 from impossible to impossible."""
    still = np.isneginf(before) & np.isneginf(after)
    return np.where(still, 0.0, after) - np.where(still, 0.0, before)


def _change(before: Floats, after: Floats) -> tuple[float, ...]:
    """The columns of `steps_table` from the objective (T,) before and after a step."""
    possible = np.isfinite(before)
    change = rise(before, after)[possible]
    finite, falls = change[np.isfinite(change)], -change[change <= -TOLERANCE]
    lengths = falls[np.isfinite(falls)]
    return (
        float(len(before)),
        float(np.sum(~possible)),
        float(np.sum(change >= TOLERANCE)),
        float(len(falls)),
        100 * len(falls) / max(len(change), 1),
        mean(lengths),
        float(lengths.max(initial=0.0)),
        mean(finite),
    )


def rounds_table(courses: Sequence[Course]) -> Table:
    """Rounds until labels and motions stop, uses of the guard against cycles, pairs that reach the limit."""
    rounds = np.array([len(of.scores) for of in courses])
    damped = np.array([of.damped for of in courses])
    stopped = np.array([not of.has_settled for of in courses])
    net = np.array([rise(of.objective[0, 1], of.objective[-1, -1]) for of in courses])
    row = (
        float(len(courses)),
        *(float(value) for value in (rounds.mean(), np.median(rounds), rounds.max())),
        *(float(value) for value in (np.sum(damped > 0), damped.sum(), stopped.sum())),
        float(np.sum(net <= -TOLERANCE)),
    )
    columns = (
        "pairs",
        "rounds, mean",
        "median",
        "most",
        "pairs damped",
        "rounds damped",
        "limit used up",
        "objective lower at the end",
    )
    return Table(
        "Rounds", columns, (row,), (0, 2, 1, 0, 0, 0, 0, 0), "Lower at the end: than after the first pass over the clusters."
    )


def bounds_table(courses: Sequence[Course]) -> Table:
    """Largest distance of bound and score, of all rounds and of the last one."""
    gaps = [of.gaps for of in courses]
    size = max((float(np.abs(of.scores[:, -1]).max()) for of in courses), default=float("nan"))
    lattice = max((abs(of.lattice_gap) for of in courses), default=float("nan"))
    rows: list[tuple[Cell, ...]] = []
    for k, name in ((1, "clustering chain"), (0, "association chain")):
        worst = (max(float(np.abs(of[part, k]).max()) for of in gaps) for part in (slice(None), slice(-1, None)))
        rows.append((name, *worst))
    rows.append(("lattice at the last motions", float("nan"), lattice))
    columns = ("pass", "all rounds", "last round")
    return Table("Bound minus score, the largest", columns, tuple(rows), (0, 6, 6), f"{BOUND_NOTE} Scores are up to {size:.0f}.")


def best_table(courses: Sequence[Course]) -> Table:
    """The alternation's labels against the best of both chains together."""
    rows: list[tuple[Cell, ...]] = []
    for name, gains in (
        ("the objective", [of.gain for of in courses]),
        ("the lattice's score", [of.lattice_gain for of in courses]),
    ):
        gain = np.array(gains)
        better, worse = gain[gain >= TOLERANCE], gain[gain <= -TOLERANCE]
        share = 100 / max(len(gain), 1)
        rows.append((name, share * len(better), mean(better), share * len(worse), mean(worse), float(gain.max())))
    columns = ("by", "lattice better (% of pairs)", "by (mean)", "worse (%)", "by (mean)", "largest gain")
    return Table("The alternation against the lattice", columns, tuple(rows), (0, 1, 2, 1, 2, 2), BEST_NOTE)


def convergence_figures(courses: Sequence[Course]) -> Mapping[str, Any]:
    """Entries of `--json` by pair; null for impossible."""

    def numbers(values: Floats) -> list[Any]:
        return [numbers(value) if np.ndim(value) else (float(value) if np.isfinite(value) else None) for value in values]

    return {
        of.name: {
            "association": numbers(of.scores[..., 0]),
            "clustering": numbers(of.scores[..., 1]),
            "gaps": numbers(of.gaps),
            "lattice_gap": of.lattice_gap,
            "settled": of.has_settled,
            "damped": of.damped,
            "gain": of.gain,
            "lattice_gain": of.lattice_gain,
        }
        for of in courses
    }
