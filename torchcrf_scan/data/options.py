"""What a user may tell a reader about a recording that the recording does not."""

from __future__ import annotations

from dataclasses import dataclass

AUTO = "auto"  # the only topic with odometry


@dataclass(frozen=True, slots=True)
class ReadOptions:
    """How to read a recording.

    Attributes:
        topic: of the scans, in a bag, or the kind of line in a CARMEN log (FLASER, ROBOTLASER1 ...); None: the only one, or
            CARMEN's front laser.
        odometry: topic of nav_msgs/Odometry in a bag, or `auto`: the only one. None: a bag's is not read. Formats whose scans
            carry their odometry always give it.
        no_return: metres; readings from there on mean that nothing came back. None: as the recording says or shows.
    """

    topic: str | None = None
    odometry: str | None = None
    no_return: float | None = None

    def __post_init__(self) -> None:
        if self.no_return is not None and not self.no_return > 0:
            raise ValueError(f"no_return: expected metres above 0, got {self.no_return}")


AS_RECORDED = ReadOptions()
