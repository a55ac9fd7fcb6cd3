"""Tables and figures of causes: points, movers, oracles, gates in metres, the worst pairs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Any

from torchcrf_scan.evaluation.causes.blame import CAUSES, Blame
from torchcrf_scan.evaluation.causes.movers import FALSE_KINDS, FATES
from torchcrf_scan.evaluation.causes.outliers import Gate, OutlierCase, best_gate
from torchcrf_scan.evaluation.measures import percent
from torchcrf_scan.evaluation.table import Cell, Table

MOST_SEQUENCES = 6  # with columns of their own
CAUSES_NOTE = (
    "A point is wrong if its association is beyond +-2 or its cluster is wrong; each has one cause, the first that holds. A "
    "mover's motion is right within two units (half a spacing, twice the noise) of the true one, or an eighth of the way travelled."
)
FATES_NOTE = (
    "Movers of at least five points with a counterpart; found: covered with an IoU of 0.5. False movers count answered clusters."
)
ORACLES_NOTE = (
    "What the answer would be with a part of the truth in hand. Right outlier decisions: the motions stay, points taken back get "
    "the nearest target under them. The others: the same model from another start."
)
GATE_NOTE = (
    "A point is an outlier if the nearest target point under its cluster's answered motion is farther than the gate. The gate is "
    "chosen with the labels of these very pairs, the best there is: a bound, not a method."
)


def sequences_of(blames: Sequence[Blame]) -> dict[str, list[Blame]]:
    """The pairs by sequence, in alphabetical order."""
    names = sorted({of.sequence for of in blames})
    return {name: [of for of in blames if of.sequence == name] for name in names}


def causes_table(blames: Sequence[Blame]) -> Table:
    """Wrong points by cause, their share of all wrong points, and the share by sequence where there are few of these."""
    parts = sequences_of(blames)
    parts = parts if 1 < len(parts) <= MOST_SEQUENCES else {}
    rows = [_cause_row(name, k, blames, parts) for k, name in enumerate(CAUSES)]
    wrong, points = sum(of.wrong for of in blames), sum(of.points for of in blames)
    pairs = sum(of.wrong > 0 for of in blames)
    shares = [percent(sum(of.wrong for of in part), sum(of.points for of in part)) for part in parts.values()]
    rows.append(("all wrong points", float(wrong), 100.0 if wrong else float("nan"), float(pairs), *(100.0 for _ in parts)))
    rows.append(("share of all points (%)", float(points), percent(wrong, points), float(len(blames)), *shares))
    columns = ("cause", "points", "share of wrong (%)", "pairs", *(f"{name or 'no sequence'} (%)" for name in parts))
    return Table("Where wrong points come from", columns, tuple(rows), (0, 0, 1, 0, *(1 for _ in parts)), CAUSES_NOTE)


def _cause_row(name: str, k: int, blames: Sequence[Blame], parts: Mapping[str, Sequence[Blame]]) -> tuple[Cell, ...]:
    def share(part: Sequence[Blame]) -> float:
        return percent(sum(int(of.counts[k]) for of in part), sum(of.wrong for of in part))

    counts = [int(of.counts[k]) for of in blames]
    return (name, float(sum(counts)), share(blames), float(sum(n > 0 for n in counts)), *map(share, parts.values()))


def fates_table(blames: Sequence[Blame]) -> Table:
    """True movers by what became of them, and answered movers that are none by kind."""
    fates = [mover.fate for of in blames for mover in of.fates]
    rows: list[tuple[Cell, ...]] = [(fate, float(fates.count(fate)), percent(fates.count(fate), len(fates))) for fate in FATES]
    rows.append(("all movers", float(len(fates)), 100.0 if fates else float("nan")))
    false = {kind: sum(of.false_movers[kind] for of in blames) for kind in FALSE_KINDS}
    rows += [(f"false mover: {kind}", float(count), float("nan")) for kind, count in false.items()]
    return Table("What became of the movers", ("fate", "movers", "share (%)"), tuple(rows), (0, 0, 1), FATES_NOTE)


def oracles_table(wrong: int, oracles: Mapping[str, int]) -> Table:
    """Wrong points of today's answer and of every oracle's."""
    rows = [("the answer as it is", float(wrong), float("nan"))]
    rows += [(name, float(count), percent(wrong - count, wrong)) for name, count in oracles.items()]
    return Table("What oracles would save", ("known", "wrong points", "fewer by (%)"), tuple(rows), (0, 0, 1), ORACLES_NOTE)


def gates_of(cases: Mapping[str, Sequence[OutlierCase]]) -> dict[str, Gate]:
    """The best gate of every group of pairs."""
    return {name: best_gate(of) for name, of in cases.items()}


def gates_table(gates: Mapping[str, Gate]) -> Table:
    """The best single gate in metres of every group of pairs, and the outlier errors that it would remove."""
    rows = tuple(
        (
            name,
            of.metres,
            float(of.answered),
            float(of.errors),
            float(of.answered - of.errors),
            percent(of.answered - of.errors, of.answered),
        )
        for name, of in gates.items()
    )
    columns = ("pairs", "gate (m)", "outlier errors", "with the gate", "fewer", "fewer by (%)")
    return Table("A single gate in metres at the answered motions", columns, rows, (0, 2, 0, 0, 0, 1), GATE_NOTE)


def worst_of(blames: Sequence[Blame], count: int) -> list[int]:
    """Numbers of the pairs with the most wrong points, the worst first; none without a wrong point."""
    order = sorted(range(len(blames)), key=lambda b: -blames[b].wrong)[:count]
    return [b for b in order if blames[b].wrong > 0]


def worst_table(blames: Sequence[Blame], count: int) -> Table:
    """The worst pairs with their most frequent cause."""
    rows = []
    for of in (blames[b] for b in worst_of(blames, count)):
        counts = of.counts
        rows.append((of.name, float(of.wrong), percent(of.wrong, of.points), CAUSES[counts.argmax()], float(counts.max())))
    columns = ("pair", "wrong points", "of its points (%)", "most frequent cause", "by it")
    return Table("The worst pairs", columns, tuple(rows), (0, 0, 1, 0, 0))


def figures(blames: Sequence[Blame], oracles: Mapping[str, int], gates: Mapping[str, Gate]) -> dict[str, Any]:
    """All numbers of the tables, with those of every sequence and every pair, for `--json`."""
    return {
        "all": _counted(blames),
        "sequences": {name: _counted(part) for name, part in sequences_of(blames).items()},
        "pairs": {of.name: _counted([of]) for of in blames},
        "oracles": dict(oracles),
        "gates": {name: asdict(gate) for name, gate in gates.items()},
    }


def _counted(blames: Sequence[Blame]) -> dict[str, Any]:
    fates = [mover.fate for of in blames for mover in of.fates]
    return {
        "points": sum(of.points for of in blames),
        "wrong": sum(of.wrong for of in blames),
        "causes": {name: sum(int(of.counts[k]) for of in blames) for k, name in enumerate(CAUSES)},
        "fates": {fate: fates.count(fate) for fate in FATES},
        "false_movers": {kind: sum(of.false_movers[kind] for of in blames) for kind in FALSE_KINDS},
    }
