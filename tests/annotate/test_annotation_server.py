"""The command and its server: who is answered, what is refused, and what is told in one line."""

import sys
from contextlib import closing
from http.client import HTTPConnection
from pathlib import Path
from urllib.parse import urlsplit

import pytest

from torchcrf_scan.annotate.keys import ACTIONS
from torchcrf_scan.cli import main


def test_other_hosts_and_origins_are_refused(address: str) -> None:
    port = urlsplit(address).port
    upgrade = {
        "Connection": "Upgrade",
        "Upgrade": "websocket",
        "Sec-WebSocket-Version": "13",
        "Sec-WebSocket-Key": "AAAAAAAAAAAAAAAAAAAAAA==",
    }

    def status(path: str, **headers: str) -> int:
        with closing(HTTPConnection("127.0.0.1", port, timeout=60)) as connection:
            connection.request("GET", path, headers={"Host": f"127.0.0.1:{port}", **headers})
            return connection.getresponse().status

    assert status("/") == status("/", Host=f"localhost:{port}") == status("/", Origin=f"http://127.0.0.1:{port}") == 200
    for wrong in ({"Host": f"evil.example:{port}"}, {"Host": "127.0.0.1"}, {"Origin": "http://evil.example"}, {"Origin": "null"}):
        for path in ("/", "/autoload.js?bokeh-autoload-element=a", "/static/js/bokeh.min.js"):
            assert status(path, **wrong) == 404
        assert status("/ws", **upgrade, **wrong) == 404
    assert status("/ws", **upgrade, Origin=f"http://127.0.0.1:{port}") != 404


def test_the_page_loads_nothing_from_elsewhere(address: str) -> None:
    with closing(HTTPConnection("127.0.0.1", urlsplit(address).port, timeout=60)) as connection:
        connection.request("GET", "/")
        page = connection.getresponse().read().decode()
    assert 'src="/static/js/bokeh.min.js' in page
    assert "https://" not in page


def test_every_key_has_its_action() -> None:
    pytest.importorskip("bokeh", reason="the library bokeh is not installed (extra `annotate`)")
    from torchcrf_scan.annotate.page import BUTTONS, Page

    assert all(callable(getattr(Page, f"_{action}")) for action in ACTIONS.values())
    assert {key for row in BUTTONS for _, key in row} <= set(ACTIONS)


def test_wrong_arguments_are_told(pair_files: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("bokeh", reason="the library bokeh is not installed (extra `annotate`)")

    def error(*options: str) -> str:
        assert main(["annotate", str(pair_files), *options]) == 1
        return capsys.readouterr().err

    assert "--output: expected another folder than that of the pairs" in error("--output", str(pair_files))
    assert "--port: expected 0 to 65535, got 70000" in error("--output", str(tmp_path), "--port=70000")
    assert "--outlier_distance: expected metres above 0" in error("--output", str(tmp_path), "--outlier_distance=0")


def test_a_missing_library_is_told(
    pair_files: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    for name in [name for name in sys.modules if name.startswith(("bokeh", "torchcrf_scan.annotate.server"))]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "bokeh", None)
    assert main(["annotate", str(pair_files), "--output", str(tmp_path)]) == 1
    assert "annotate: expected bokeh (pip install torchcrf-scan[annotate])" in capsys.readouterr().err
