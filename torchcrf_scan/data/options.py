"""What a user may tell a reader about a recording that the recording does not."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeVar

from torchcrf_scan.errors import TorchCRFScanError

Made = TypeVar("Made")

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
        on_bad: called with the error of a malformed line or message, which is then left out; None: the error is raised. A damaged
            or cut file ends the reading with an error in either case.
    """

    topic: str | None = None
    odometry: str | None = None
    no_return: float | None = None
    on_bad: Callable[[ValueError], None] | None = None

    def __post_init__(self) -> None:
        if self.no_return is not None and not self.no_return > 0:
            raise TorchCRFScanError(f"no_return: expected metres above 0, got {self.no_return}")

    def attempt(self, make: Callable[[], Made]) -> Made | None:
        """What `make` makes of a line or message; None if that is malformed and left out, else its ValueError is raised."""
        try:
            return make()
        except ValueError as error:
            if self.on_bad is None:
                raise
            self.on_bad(error)
            return None


AS_RECORDED = ReadOptions()
