"""`torchcrf-scan`, on a disk that is full while a file is there: python full_disk.py FILE ARGUMENTS."""

import errno
import os
import sys
from pathlib import Path

from torchcrf_scan.cli import main

flag, sync = Path(sys.argv[1]), os.fsync


def fsync(number: int) -> None:
    if flag.exists():
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
    sync(number)


if __name__ == "__main__":
    os.fsync = fsync
    sys.exit(main(sys.argv[2:]))
