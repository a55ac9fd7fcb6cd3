"""The time between scans, from stamps that may stand still, go back, jump by years, or be coarser than the scans come."""

from __future__ import annotations

import logging

import numpy as np

from torchcrf_scan.scan import Bools, Floats

logger = logging.getLogger(__name__)

USUAL = 0.1  # seconds between scans of a log that does not tell
SHORTEST, LONGEST = 0.01, 86400.0  # seconds; what is outside is no time between scans of one log
STANDING = 0.1  # share of steps of zero from which on a clock is coarser than the scans come
BOUNDS = 0.02, 10.0  # seconds; of a step that is made up


def plausible_steps(stamps: Floats) -> tuple[Floats, Bools]:
    """The time between consecutive scans, and where it was made up.

    A step that cannot be is replaced by the median of those that can; where many stamps stand still, all by their mean.

    Args:
        stamps: (S,) seconds, as recorded.

    Returns:
        (S-1,) seconds, all above 0, and (S-1,) bool.
    """
    with np.errstate(invalid="ignore", over="ignore"):
        steps = np.diff(np.asarray(stamps, dtype=np.float64))
    forward = np.isfinite(steps) & (steps > 0) & (steps < LONGEST)
    standing = steps == 0
    if len(steps) and standing.mean() > STANDING:
        elapsed = steps[forward].sum() / max(int((forward | standing).sum()), 1)
        return np.full(len(steps), _bounded(elapsed)), np.ones(len(steps), dtype=bool)
    usual = float(np.median(steps[forward])) if forward.any() else 0.0
    wrong = ~forward | (steps < min(SHORTEST, usual / 10))
    return np.where(wrong, _bounded(usual), steps), wrong


def _bounded(seconds: float) -> float:
    return float(np.clip(seconds, *BOUNDS)) if seconds > 0 else USUAL


def steps_with_a_word(stamps: Floats, name: str) -> Floats:
    """(S-1,) `plausible_steps`, and one warning if any was made up. name: of the recording."""
    steps, wrong = plausible_steps(stamps)
    if wrong.any():
        logger.warning(
            "%s: the stamps do not tell the time between %d of %d pairs of scans; taken as %.3g s, so speeds there are a guess",
            name, wrong.sum(), len(steps), np.median(steps[wrong]),
        )  # fmt: skip
    return steps
