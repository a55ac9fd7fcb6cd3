"""An output in a process of its own gets every result, and its failure or death is told, never waited for."""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from results import true_results

from torchcrf_scan.commands import apart
from torchcrf_scan.commands.apart import Apart
from torchcrf_scan.commands.outputs import Add, Output, Outputs
from torchcrf_scan.result import ScanResult
from torchcrf_scan.whole_file import whole_file

RESULTS = true_results(3)


def held_signals() -> str:
    """The signals that this process does not get."""
    return ",".join(sorted(signal.Signals(one).name for one in signal.pthread_sigmask(signal.SIG_BLOCK, ())))


@contextmanager
def stamps_file(path: Path, fault: str = "") -> Iterator[Add]:
    """The process's number and the signals that it does not get, then a stamp a line; it fails as asked for."""
    with whole_file(path) as file:
        file.write(f"{os.getpid()} {held_signals()}\n".encode())
        count = 0

        def add(result: ScanResult) -> None:
            nonlocal count
            count += 1
            if count == 2 and fault == "disk":
                raise OSError("disk full")
            if count == 2 and fault == "dies":
                os.kill(os.getpid(), signal.SIGKILL)
            file.write(f"{result.stamp}\n".encode())

        yield add
        if fault == "end":
            raise ValueError("nothing to show")


def told(output: Output, results: list[ScanResult]) -> list[str]:
    """What goes wrong when results are added to an output."""
    failures: list[str] = []
    with Outputs({"out": output}, failures) as add:
        for result in results:
            add(result)
    return failures


def test_every_result_arrives_in_order_in_another_process(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The process does not get Ctrl-C and termination, which its parent sees; that is as before afterwards."""
    monkeypatch.setattr(apart, "WAITING", 2)
    results, held = true_results(40), held_signals()
    assert told(Apart(stamps_file, tmp_path / "a"), results) == []
    number, signals, *stamps = (tmp_path / "a").read_text().split()
    assert int(number) != os.getpid()
    assert [float(stamp) for stamp in stamps] == [result.stamp for result in results]
    assert signals == "SIGINT,SIGTERM"
    assert held_signals() == held


@pytest.mark.usefixtures("fast_start")
@pytest.mark.parametrize(
    ("fault", "expected"),
    [("disk", "out: disk full"), ("dies", "out: its process ended early, with exit code -9"), ("end", "out: nothing to show")],
)
def test_a_fault_is_told_once_and_the_run_goes_on(tmp_path: Path, fault: str, expected: str) -> None:
    """More results than may wait, and than the pipe holds, hang nothing."""
    assert told(Apart(stamps_file, tmp_path / "a", fault), RESULTS[:1] * 400) == [expected]
    assert not (tmp_path / "a").exists()


def failing_elsewhere(path: Path) -> None:
    with Outputs({"out": Apart(stamps_file, path)}, []) as add:
        add(RESULTS[0])
        raise OSError("elsewhere")


@pytest.mark.usefixtures("fast_start")
def test_an_error_elsewhere_leaves_nothing(tmp_path: Path) -> None:
    with pytest.raises(OSError, match="elsewhere"):
        failing_elsewhere(tmp_path / "a")
    assert not list(tmp_path.iterdir())


PARENT = """
import sys
from pathlib import Path
sys.path[:0] = sys.argv[2:]
from test_apart import Apart, RESULTS, stamps_file
if __name__ == "__main__":
    with Apart(stamps_file, Path(sys.argv[1])) as add:
        add(RESULTS[0])
        print("added", flush=True)
        sys.stdin.read()
"""


def test_a_killed_parent_leaves_no_process_and_no_file(tmp_path: Path) -> None:
    script, out = tmp_path / "parent.py", tmp_path / "out"
    script.write_text(PARENT)
    out.mkdir()
    here = Path(__file__).parent
    command = [sys.executable, str(script), str(out / "a"), str(here), str(here.parent), str(here.parents[1])]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as parent:
        assert parent.stdout is not None
        assert parent.stdout.readline() == b"added\n"
        deadline = time.monotonic() + 60
        while not list(out.iterdir()) and time.monotonic() < deadline:
            time.sleep(0.05)
        (child,) = out.iterdir()
        parent.kill()
    while list(out.iterdir()) and time.monotonic() < deadline:
        time.sleep(0.05)
    assert not list(out.iterdir()), child
