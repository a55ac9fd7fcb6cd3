"""Input channels of the encoder and their constants; shared by tensors and loops."""

from __future__ import annotations

BESIDE = (-2, -1, 1, 2)  # neighbours in its own scan with which a point is compared

WINDOW = 6  # beams of the other scan to each side that are searched for the nearest point

PROFILE = 3  # number of them that are channels of their own

FARTHEST = 20.0  # units; larger distances are clipped

LARGEST_TURN = 5.0  # beam steps; larger angles are clipped

NOWHERE = 2.5  # replaces a difference of ranges if there is no other point

NEAR = 3.0  # units; distance within which a mover counts if its reach is unknown

LONGEST_CHORD = 4.0  # units; neighbouring points farther apart do not form a surface

CHANNELS = (
    *(f"range of the point {k:+d} beside" for k in BESIDE),
    *("turn to the point before", "turn to the point after", "footprint over noise", "range over the usual range"),
    *(f"range of the other scan's beam {k:+d}" for k in range(-PROFILE, PROFILE)),
    *("turn from the beam before", "turn to the beam after", "distance to its nearest point", "distance to its surface"),
    *("seen through", "hidden", "distance under the best mover", "probability of that mover", "gain of the best mover", "is there"),
)
