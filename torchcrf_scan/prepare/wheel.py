"""The wheel of this package, which is for one platform where it carries machine code. Imports nothing of the package."""

from __future__ import annotations

from pathlib import Path

from setuptools.command.bdist_wheel import bdist_wheel

CARRIED = "torchcrf_scan/machine/*.json"  # one beside every extension


class MachineWheel(bdist_wheel):
    """A wheel for every platform, unless there is machine code in the source tree, or in the folder that it is packed from."""

    def finalize_options(self) -> None:
        """Decides on the wheel's tag."""
        super().finalize_options()
        if any(Path().glob(CARRIED)) or any(Path().glob(f"build/lib*/{CARRIED}")):
            self.root_is_pure = False
