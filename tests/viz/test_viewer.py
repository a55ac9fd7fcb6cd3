"""Results reach the viewer's file; a viewer that takes nothing holds nobody up."""

import resource
import socket
import sys
import time
from pathlib import Path

import pytest
from results import true_results

from torchcrf_scan.viz import viewer

rerun = pytest.importorskip("rerun", reason="the library rerun-sdk is not installed (extra `viewer`)")


def test_a_file_for_the_viewer_holds_every_result(tmp_path: Path) -> None:
    results = true_results(12)
    with viewer.writing_rerun(tmp_path / "a.rrd") as show:
        for result in results:
            show(result)
    assert [path.name for path in tmp_path.iterdir()] == ["a.rrd"]
    assert (tmp_path / "a.rrd").stat().st_size > 10_000
    assert (tmp_path / "a.rrd").read_bytes()[:4] in (b"RRF2", b"RRIO")


def test_a_full_disk_is_told_and_leaves_nothing(tmp_path: Path) -> None:
    """The limit of a file's size stands for the end of the disk."""

    def write() -> None:
        with viewer.writing_rerun(tmp_path / "a.rrd") as show:
            for result in true_results(12):
                show(result)

    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (8192, before[1]))
    try:
        with pytest.raises(OSError, match="File too large"):
            write()
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert not list(tmp_path.iterdir())


def test_a_viewer_that_takes_nothing_holds_nobody_up(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(viewer, "PATIENCE", 0.5)
    results = true_results(4)
    with socket.create_server(("127.0.0.1", 0)) as server:
        begin = time.perf_counter()
        with viewer.showing(f"rerun+http://127.0.0.1:{server.getsockname()[1]}/proxy") as show:
            fed = time.perf_counter()
            for _ in range(200):
                for result in results:
                    show(result)
            taken = time.perf_counter() - fed
        assert taken < 2.0
        assert time.perf_counter() - begin < 20.0


def test_a_missing_library_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "rerun", None)
    with pytest.raises(ValueError, match=r"--visualize: expected the extra torchcrf-scan\[viewer\]"):
        viewer.check_viewer("--visualize")
