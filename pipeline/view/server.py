"""A folder's files for browsers on this machine: on the loopback address alone, nothing outside the folder, nothing hidden."""

import html
import http.server
import shutil
import threading
import urllib.parse
from collections.abc import Callable, Sequence
from http import HTTPStatus
from pathlib import Path
from typing import Any

from cadence.errors import DeviceError

HOST = "127.0.0.1"
_TYPES = {
    ".html": "text/html; charset=utf-8", ".json": "application/json", ".geojson": "application/geo+json",
    ".csv": "text/csv; charset=utf-8", ".md": "text/plain; charset=utf-8", ".png": "image/png", ".svg": "image/svg+xml",
}  # fmt: skip


class Server(http.server.ThreadingHTTPServer):
    """Serves the files in a folder; the first page is the report, or a list of reports."""

    daemon_threads = True

    def __init__(self, folder: Path, pages: Sequence[str], port: int = 0) -> None:
        self.folder, self.pages = folder.resolve(), tuple(pages)
        try:
            super().__init__((HOST, port), _Handler)
        except (OSError, OverflowError) as error:
            raise DeviceError(f"port {port}: cannot be used ({error}); give another one with --port, or none") from error

    @property
    def address(self) -> str:
        """Where the first page is."""
        return f"http://{HOST}:{self.server_port}/"

    @property
    def hosts(self) -> frozenset[str]:
        """How a browser on this machine calls it: a page from elsewhere whose name leads here is not answered."""
        return frozenset(f"{name}:{self.server_port}" for name in (HOST, "localhost"))


class _Handler(http.server.BaseHTTPRequestHandler):
    server: Server
    server_version = "cadence"
    sys_version = ""

    def do_GET(self) -> None:
        self._answer(has_body=True)

    def do_HEAD(self) -> None:
        self._answer(has_body=False)

    def log_message(self, format: str, *arguments: Any) -> None:  # the name is http.server's
        """Nothing: the terminal is the user's."""

    def _answer(self, has_body: bool) -> None:
        if self.headers.get("Host") not in self.server.hosts:
            self._refuse(HTTPStatus.MISDIRECTED_REQUEST)
            return
        path = urllib.parse.unquote(urllib.parse.urlsplit(self.path).path)
        if path == "/":
            self._first_page(has_body)
            return
        file = self._file(path)
        if file is None:
            self._refuse(HTTPStatus.NOT_FOUND)
            return
        with file.open("rb") as content:
            self._head(HTTPStatus.OK, _TYPES.get(file.suffix, "application/octet-stream"), file.stat().st_size)
            if has_body:
                shutil.copyfileobj(content, self.wfile)

    def _first_page(self, has_body: bool) -> None:
        if len(self.server.pages) == 1:
            self.send_response(HTTPStatus.FOUND)
            self.send_header("Location", "/" + urllib.parse.quote(self.server.pages[0]))
            self.send_header("Content-Length", "0")
            self.end_headers()
            return
        body = _list(self.server.pages).encode()
        self._head(HTTPStatus.OK, _TYPES[".html"], len(body))
        if has_body:
            self.wfile.write(body)

    def _file(self, path: str) -> Path | None:
        """The file that a path of a URL means, where it lies inside the folder and no part of its name is hidden."""
        if "\\" in path or "\0" in path:
            return None
        try:
            found = (self.server.folder / path.lstrip("/")).resolve()
            inner = found.relative_to(self.server.folder)
            is_shown = found.is_file() and not any(part.startswith(".") for part in inner.parts)
        except (OSError, ValueError):
            return None
        return found if is_shown else None

    def _head(self, status: HTTPStatus, kind: str, size: int) -> None:
        self.send_response(status)
        for name, value in (("Content-Type", kind), ("Content-Length", str(size)), ("X-Content-Type-Options", "nosniff")):
            self.send_header(name, value)
        self.send_header("Cache-Control", "no-store")  # a report is made again under the same name
        self.end_headers()

    def _refuse(self, status: HTTPStatus) -> None:
        self._head(status, "text/plain; charset=utf-8", 0)


def serve(folder: Path, pages: Sequence[str], port: int, tell: Callable[[str], object]) -> None:
    """Serve until the user interrupts; `tell` hears the address first. `DeviceError` where the port is taken."""
    with Server(folder, pages, port) as server:
        tell(f"{server.address}  (this machine alone; Ctrl-C ends it)")
        thread = threading.Thread(target=server.serve_forever, daemon=True)
        thread.start()
        try:
            while thread.is_alive():
                thread.join(1.0)
        except KeyboardInterrupt:  # how it is meant to end
            server.shutdown()


def _list(pages: Sequence[str]) -> str:
    items = "".join(
        f'<li><a href="/{urllib.parse.quote(page)}">{html.escape(page.rpartition("/")[0])}</a></li>' for page in pages
    )
    head = '<!doctype html><html lang="en"><meta charset="utf-8"><meta name="viewport" content="width=device-width">'
    body = f"<body style='font:16px sans-serif;margin:2em'><h1>Missions</h1><ul>{items}</ul></body>"
    return f"{head}<title>Missions</title>{body}</html>"
