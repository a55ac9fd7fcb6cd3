"""What a test gets that serves the page."""

import subprocess
from collections.abc import Callable
from pathlib import Path

Serve = Callable[[Path], tuple[subprocess.Popen[str], str]]  # of the output: the process and the page's address
