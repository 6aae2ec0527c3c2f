"""`cadence view`: what is missing is run, what is there stays, and a served folder shows nothing else."""

import http.client
import json
import os
import re
import signal
import socket
import subprocess
import sys
import threading
from pathlib import Path

import pytest
from fixtures.line_logs import straight_line, write_log

import cli
from cadence.errors import DeviceError
from pipeline.view import browser
from pipeline.view.server import Server

FAST = [
    "--set", "infer.checkpoint=none", "--set", "infer.num_hypotheses=4", "--set", "infer.grid.history_steps=16",
    "--set", "infer.grid.horizon_steps=8", "--set", "infer.grid.stride_steps=16",
]  # fmt: skip


@pytest.fixture
def opened(monkeypatch) -> list[str]:
    """The pages that a browser was told to open; there is one."""
    pages: list[str] = []
    monkeypatch.setenv("BROWSER", "a browser")
    monkeypatch.setattr("webbrowser.open", lambda address: pages.append(address) or True)
    return pages


@pytest.fixture
def served(tmp_path):
    """A folder with one report that is served, and its server."""
    folder = tmp_path / "results"
    (folder / "a").mkdir(parents=True)
    (folder / "a" / "report.html").write_text("<p>Überblick</p>", encoding="utf-8")
    (folder / ".hidden").mkdir()
    (folder / ".hidden" / "key").write_text("secret")
    (tmp_path / "outside.txt").write_text("secret")
    (folder / "link.txt").symlink_to(tmp_path / "outside.txt")
    with Server(folder, ["a/report.html"]) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        yield folder, server
        server.shutdown()
        thread.join()


def ask(server: Server, path: str, method: str = "GET", host: str | None = None) -> tuple[int, bytes, dict[str, str]]:
    connection = http.client.HTTPConnection("127.0.0.1", server.server_port, timeout=10)
    connection.putrequest(method, path, skip_host=True)
    connection.putheader("Host", host or f"localhost:{server.server_port}")
    connection.endheaders()
    answer = connection.getresponse()
    body = answer.read()
    connection.close()
    return answer.status, body, dict(answer.getheaders())


def test_a_log_is_run_once_and_its_report_opened(tmp_path, opened, capsys):
    log, out = write_log(tmp_path / "boat.mcap", straight_line()), tmp_path / "out"
    assert cli.main(["view", str(log), "--out", str(out), "-q", *FAST]) == 0
    page = out / "boat" / "report.html"
    assert opened == [page.resolve().as_uri()] and str(page) in capsys.readouterr().out
    made = {path.name: path.stat().st_mtime_ns for path in (out / "boat").iterdir()}
    assert cli.main(["view", str(log), "--out", str(out), "-q"]) == 0, "without its settings nothing is made again"
    assert cli.main(["view", str(out / "boat"), "-q"]) == 0
    assert {path.name: path.stat().st_mtime_ns for path in (out / "boat").iterdir()} == made and len(opened) == 3
    page.unlink()
    assert cli.main(["view", str(out / "boat"), "-q"]) == 0 and page.is_file()
    manifest = json.loads((out / "boat" / "infer.manifest.json").read_text())
    assert manifest["config"]["num_hypotheses"] == 4, "what is missing is made with the settings of what is there"
    assert (out / "boat" / "hypotheses.parquet").stat().st_mtime_ns == made["hypotheses.parquet"]
    write_log(log, straight_line(20))
    assert cli.main(["view", str(log), "--out", str(out), "-q"]) == 0
    assert json.loads((out / "boat" / "catalogue.json").read_text())["health"]["num_messages"] == 20, (
        "the log is another one now"
    )


def test_what_cannot_be_seen_is_one_line(tmp_path, opened, capsys):
    (tmp_path / "none").mkdir()
    several = tmp_path / "logs"
    several.mkdir()
    for name in ("a", "b"):
        write_log(several / f"{name}.mcap", straight_line())
    (tmp_path / "bad.mcap").write_bytes(b"no log at all")
    cases = [
        (tmp_path / "gone", 3, "not found"),
        (tmp_path / "none", 3, "holds no MCAP log"),
        (several, 3, "holds 2 logs"),
        (tmp_path / "bad.mcap", 3, "is not an MCAP file"),
        ("s3://bucket/log.mcap", 3, "is a URL"),
    ]
    for target, code, says in cases:
        assert cli.main(["view", str(target), "--out", str(tmp_path / "out"), "-q"]) == code
        told = capsys.readouterr().err
        assert says in told and told.count("\n") == 1
    assert not opened


def test_only_what_is_in_the_folder_is_served(served):
    folder, server = served
    status, _, headers = ask(server, "/")
    assert (status, headers["Location"]) == (302, "/a/report.html")
    status, body, headers = ask(server, "/a/report.html?x=1")
    assert (status, body.decode()) == (200, "<p>Überblick</p>") and headers["Content-Type"] == "text/html; charset=utf-8"
    assert ask(server, "/a/report.html", "HEAD")[:2] == (200, b"")
    hidden = [
        "/../outside.txt",
        "/%2e%2e/outside.txt",
        "/a/..%2f..%2f..%2foutside.txt",
        "/link.txt",
        "/.hidden/key",
        "/a",
        "/nothing",
    ]
    hidden += ["//etc/passwd", f"/{folder.parent}/outside.txt", "/a\\..\\..\\outside.txt", "/%00", "/" + "a" * 5000]
    for path in hidden:
        assert ask(server, path)[:2] == (404, b""), path
    for host in ("evil.example", f"evil.example:{server.server_port}", ""):
        assert ask(server, "/a/report.html", host=host or "127.0.0.1")[:2] == (421, b"")
    assert ask(server, "/a/report.html", "POST")[0] == 501


def test_it_listens_to_this_machine_alone(served):
    assert served[1].server_address[0] == "127.0.0.1"
    with pytest.raises(DeviceError, match=r"cannot be used"):
        Server(served[0], ["a/report.html"], served[1].server_port)
    with pytest.raises(DeviceError, match=r"port 99999"):
        Server(served[0], ["a/report.html"], 99999)
    elsewhere = socket.gethostbyname(socket.gethostname())
    if not elsewhere.startswith("127."):
        with pytest.raises(OSError):
            socket.create_connection((elsewhere, served[1].server_port), timeout=2).close()


def test_several_missions_are_listed(served):
    folder, _ = served
    with Server(folder, ["a/report.html", "b & c/report.html"]) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        _, body, _ = ask(server, "/")
        assert b'<a href="/a/report.html">a</a>' in body and b'href="/b%20%26%20c/report.html">b &amp; c</a>' in body
        assert ask(server, "/", "HEAD")[1] == b""
        server.shutdown()
        thread.join()


def test_served_until_interrupted(tmp_path, served):
    folder, _ = served
    # whoever runs the tests in the background may have had interrupts ignored, and children would inherit it
    start = "import signal, sys; signal.signal(signal.SIGINT, signal.default_int_handler); import cli; sys.exit(cli.main())"
    words = [sys.executable, "-c", start, "view", str(folder), "--serve"]
    environment = {**os.environ, "PYTHONPATH": str(Path(cli.__file__).parent)}
    with subprocess.Popen(words, stdout=subprocess.PIPE, text=True, env=environment, cwd=tmp_path) as process:
        line = process.stdout.readline()
        address = re.match(r"http://127\.0\.0\.1:(\d+)/", line)
        assert address, line
        connection = http.client.HTTPConnection("127.0.0.1", int(address[1]), timeout=20)
        connection.request("GET", "/a/report.html")
        answer = connection.getresponse()
        assert answer.status == 200 and answer.read()
        connection.close()
        process.send_signal(signal.SIGINT)
        try:
            assert process.wait(30) == 0
        finally:
            process.kill()


def test_where_there_is_no_screen_nothing_is_opened(monkeypatch, tmp_path):
    for name in ("BROWSER", "DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr(sys, "platform", "linux")
    assert not browser.has_browser() and not browser.open_page(tmp_path)
    monkeypatch.setenv("DISPLAY", ":0")
    assert browser.has_browser()
    monkeypatch.setattr(sys, "platform", "darwin")
    monkeypatch.setenv("SSH_CONNECTION", "10.0.0.1")
    assert not browser.has_browser()
