"""The command and its server: who is answered, what is refused, and what is told in one line."""

import sys
from contextlib import closing
from http.client import HTTPConnection
from pathlib import Path
from urllib.parse import urlsplit

import pytest
from command_line import ROOT, load_main
from serving import Serve, saved, shown, window

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


def test_wrong_arguments_are_told(pair_files: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("bokeh", reason="the library bokeh is not installed (extra `annotate`)")

    def error(*options: str) -> str:
        assert main(["annotate", str(pair_files), *options]) == 1
        return capsys.readouterr().err

    assert "--output: expected another folder than that of the pairs" in error("--output", str(pair_files))
    assert "--port: expected 0 to 65535, got 70000" in error("--output", str(tmp_path), "--port=70000")
    assert "--outlier_distance: expected metres above 0" in error("--output", str(tmp_path), "--outlier_distance=0")


def test_the_page_is_opened_in_the_browser_if_wanted(
    pair_files: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    server = pytest.importorskip("torchcrf_scan.annotate.server", reason="the library bokeh is not installed (extra `annotate`)")
    opened: list[str] = []
    monkeypatch.setattr("webbrowser.open", opened.append)
    monkeypatch.setattr(server, "serve", lambda server: server.stop())
    one = sorted(pair_files.glob("*.npz"))[0]
    assert main(["annotate", str(one), "--output", str(tmp_path)]) == 0
    assert opened == []
    assert main(["annotate", str(one), "--output", str(tmp_path), "--open"]) == 0
    told = capsys.readouterr().out.splitlines()
    assert told[1].startswith("1 pair, annotations in ")
    assert opened == [told[1].split()[-1]]


def test_a_log_is_annotated_and_learned_from(serve: Serve, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """From the log to the files, which `evaluate` and `train.py` take, without one that was begun but not finished."""
    log, output = tmp_path / "drive.csv", tmp_path / "annotated"
    assert main(["simulate", "--output", str(log), "--drive=13", "--simulator.beams=91", "--seed=3"]) == 0
    process, address = serve(output, "--every=3", files=log)
    names = {f"drive_{k:05d}" for k in (0, 3, 6, 9)}
    finished: list[str] = []
    with window(address) as keys:
        for _ in range(3):
            finished.append(shown(address))
            keys.press(".", "o", "Enter")
        begun = shown(address)
        keys.press(".", "u")
        assert saved(output, begun).ignore.any()
    assert {*finished, begun} == names
    assert {path.name for path in output.iterdir()} == {".annotate", *(f"{name}.npz" for name in finished)}
    for name in finished:
        assert (saved(output, name).body == -1).any()
    assert main(["annotate", str(log), "--output", str(output)]) == 1
    assert "expected nobody at work here" in capsys.readouterr().err
    process.kill()
    process.join()
    assert main(["evaluate", str(output)]) == 0
    assert "**Overview**" in capsys.readouterr().out
    tiny = ["--learning.max_steps=2", "--learning.booster_examples=200", "--learning.folds=0"]
    config = ["--config", str(ROOT / "configs" / "mine.yaml"), "--data.train", str(output), "--output", str(tmp_path / "run")]
    assert load_main()([*config, *tiny]) == 0
    assert (tmp_path / "run" / "model").is_dir()


def test_a_missing_library_is_told(
    pair_files: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    for name in [name for name in sys.modules if name.startswith(("bokeh", "torchcrf_scan.annotate.server"))]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "bokeh", None)
    assert main(["annotate", str(pair_files), "--output", str(tmp_path)]) == 1
    assert "annotate: expected bokeh (pip install torchcrf-scan[annotate])" in capsys.readouterr().err
