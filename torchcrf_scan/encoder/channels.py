"""The channels that the encoder sees of a point, and what they are measured with; for tensors and loops alike."""

from __future__ import annotations

BESIDE = (-2, -1, 1, 2)  # points of its own scan that a point is compared with

WINDOW = 6  # beams of the other scan to each side, among which the nearest point is looked for

PROFILE = 3  # of them that are shown to the encoder one by one

FARTHEST = 20.0  # units; farther is all the same

LARGEST_TURN = 5.0  # beam steps, likewise

NOWHERE = 2.5  # stands for a difference of ranges where there is no other point

NEAR = 3.0  # units within which a mover counts where nobody knows its reach

LONGEST_CHORD = 4.0  # units; neighbouring points farther apart are no surface between them

CHANNELS = (
    *(f"range of the point {k:+d} beside" for k in BESIDE),
    *("turn to the point before", "turn to the point after", "footprint over noise", "range over the usual range"),
    *(f"range of the other scan's beam {k:+d}" for k in range(-PROFILE, PROFILE)),
    *("turn from the beam before", "turn to the beam after", "distance to its nearest point", "distance to its surface"),
    *("seen through", "hidden", "distance under the best mover", "probability of that mover", "gain of the best mover", "is there"),
)
