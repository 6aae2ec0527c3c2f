"""A real S3 API server on this machine (moto over HTTP) that can be told to fail, and that remembers what was asked."""

import contextlib
import logging
import threading
import time
import urllib.request
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

import pytest

from pipeline import stores

ENVIRONMENT = {"AWS_ACCESS_KEY_ID": "user", "AWS_SECRET_ACCESS_KEY": "open-sesame", "AWS_DEFAULT_REGION": "us-east-1"}


@dataclass
class Fault:
    """How the next `count` requests whose method and path fit are answered."""

    method: str
    path: str
    status: str
    count: int
    pause_s: float


@dataclass
class S3Server:
    """The application in front of moto's, and the address at which it listens."""

    application: Any
    url: str = ""
    faults: list[Fault] = field(default_factory=list)
    requests: list[tuple[str, str]] = field(default_factory=list)

    def __call__(self, environ: dict[str, Any], start_response: Any) -> Any:
        method, path = environ["REQUEST_METHOD"], environ["PATH_INFO"]
        self.requests.append((method, path))
        fault = next((f for f in self.faults if f.count and f.method == method and f.path in path), None)
        if fault is None:
            return self.application(environ, start_response)
        fault.count -= 1
        time.sleep(fault.pause_s)
        start_response(fault.status, [("Content-Type", "application/xml"), ("Content-Length", "0")])
        return [b""]

    def fail(
        self, method: str, path: str, status: str = "500 Internal Server Error", count: int = 1, pause_s: float = 0.0
    ) -> None:
        """Answer the next `count` requests that fit with a status, after a pause."""
        self.faults.append(Fault(method, path, status, count, pause_s))

    def count(self, method: str, path: str) -> int:
        """Requests of the method whose path holds `path`."""
        return sum(asked == method and path in where for asked, where in self.requests)


@contextlib.contextmanager
def serve_s3() -> Iterator[S3Server]:
    """Run the server in a thread until the context is left."""
    from moto.moto_server.werkzeug_app import DomainDispatcherApplication, create_backend_app
    from werkzeug.serving import make_server

    logging.getLogger("werkzeug").setLevel(logging.ERROR)
    server = S3Server(DomainDispatcherApplication(create_backend_app))
    http = make_server("127.0.0.1", 0, server, threaded=True)
    server.url = f"http://127.0.0.1:{http.server_port}"
    thread = threading.Thread(target=http.serve_forever, daemon=True)
    thread.start()
    try:
        yield server
    finally:
        http.shutdown()
        thread.join()
        http.server_close()


@pytest.fixture(scope="session")
def s3_server() -> Iterator[S3Server]:
    """One server for all tests: clients are slow to make, and are kept by address."""
    pytest.importorskip("s3fs", reason="needs the extra s3")
    pytest.importorskip("moto", reason="needs moto")
    with serve_s3() as server:
        yield server


@pytest.fixture
def s3(s3_server: S3Server, monkeypatch: pytest.MonkeyPatch) -> S3Server:
    """The server with nothing in it but an empty bucket `sea`, and this process with credentials for it."""
    for name, value in {**ENVIRONMENT, "AWS_ENDPOINT_URL": s3_server.url}.items():
        monkeypatch.setenv(name, value)
    monkeypatch.setattr(stores, "FIRST_PAUSE_S", 0.01)
    s3_server.faults.clear()
    for method, path in (("POST", "moto-api/reset"), ("PUT", "sea")):
        request = urllib.request.Request(f"{s3_server.url}/{path}", method=method)
        urllib.request.urlopen(request).close()
    s3_server.requests.clear()
    return s3_server


@pytest.fixture
def new_clients(s3: S3Server) -> Iterator[None]:
    """Clients are made anew in this test, from its environment."""
    import fsspec

    fsspec.filesystem("s3").clear_instance_cache()
    yield
    fsspec.filesystem("s3").clear_instance_cache()
