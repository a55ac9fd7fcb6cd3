"""The build of machine code that a process begins for want of it, and does not wait for."""

from __future__ import annotations

import logging
import os
import shutil
import subprocess
import sys
import sysconfig
from pathlib import Path

SWITCH = "TORCHCRF_SCAN_PREPARE"  # environment variable: 0 begins no build
LOG_FILE, PROGRESS_FILE = "build.log", "progress"  # of the folder of machine code

log = logging.getLogger(__name__)


def lacks_compiler() -> bool:
    """Whether no C compiler is there, which an extension module needs to be linked."""
    if sys.platform == "win32":
        return False  # it is not looked for on the path
    chosen = (os.environ.get("CC") or sysconfig.get_config_var("CC") or "cc").split()[0]
    return shutil.which(chosen) is None


class Background:
    """One build at most, of low priority, that outlives the process which began it."""

    def __init__(self) -> None:
        self.process: subprocess.Popen[bytes] | None = None
        self.owner, self.is_over, self.told = os.getpid(), False, ""

    def care(self, folder: Path) -> None:
        """Begins the build, or tells how far it is; is called about once a second while something is missing."""
        if self.is_over or os.environ.get(SWITCH) == "0" or os.getpid() != self.owner:
            return
        if self.process is None:
            self._begin(folder)
        elif self.process.poll() not in (None, 0):
            self.is_over = True
            lines = (folder / LOG_FILE).read_text(errors="replace").strip().splitlines()
            log.warning("no machine code, slow loops go on: %s", lines[-1] if lines else "the build ended early")
        else:
            self._tell(folder)

    def complete(self) -> None:
        """Says that all is there, where this process has waited for it."""
        if self.process is not None and not self.is_over:
            log.warning("machine code is ready and used from now on")
        self.is_over = True

    def _begin(self, folder: Path) -> None:
        if lacks_compiler():
            self.is_over = True
            log.warning("no machine code, slow loops go on (seconds a pair): expected a C compiler (gcc or clang), got none")
            return
        log.warning("no machine code yet: it is built in the background, in a few minutes; meanwhile a pair takes seconds")
        command = [sys.executable, "-P", "-m", "torchcrf_scan.prepare"]  # -P: not what lies in the working directory
        paths = os.pathsep.join([str(Path(__file__).parents[2]), os.environ.get("PYTHONPATH", "")]).rstrip(os.pathsep)
        environment = {**os.environ, "PYTHONPATH": paths, SWITCH: "0"}
        (folder / PROGRESS_FILE).unlink(missing_ok=True)
        with (folder / LOG_FILE).open("ab") as file:
            self.process = subprocess.Popen(
                command, stdin=subprocess.DEVNULL, stdout=file, stderr=file, start_new_session=True, env=environment
            )

    def _tell(self, folder: Path) -> None:
        try:
            progress = (folder / PROGRESS_FILE).read_text()
        except OSError:
            return
        if progress != self.told:
            self.told = progress
            log.warning("machine code: %s", progress)
