"""What is released: a wheel, for one platform where it carries machine code, and sources. Imports nothing of the package."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from setuptools.command.bdist_wheel import bdist_wheel
from setuptools.command.sdist import sdist

CARRIED = "torchcrf_scan/machine/*.json"  # one beside every extension


class MachineWheel(bdist_wheel):
    """A wheel for every platform, unless there is machine code in the source tree, or in the folder that it is packed from."""

    def finalize_options(self) -> None:
        """Decides on the wheel's tag."""
        super().finalize_options()
        if any(Path().glob(CARRIED)) or any(Path().glob(f"build/lib*/{CARRIED}")):
            self.root_is_pure = False


class Sources(sdist):
    """The package's sources, without machine code and without tests, which are whole in the repository alone."""

    def make_release_tree(self, base_dir: str, files: Sequence[str]) -> None:
        """Copies the files to the folder that is packed."""
        super().make_release_tree(base_dir, [file for file in files if not file.startswith(("tests/", "torchcrf_scan/machine/"))])
