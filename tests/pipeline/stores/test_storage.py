"""Objects behind URLs, over HTTP to a real S3 API: found, fetched once, tried again, refused in plain words, no secret told."""

import http.server
import os
import sys
import threading
from functools import partial

import pytest

from cadence.errors import ConfigError, DeviceError, InputError
from pipeline.progress import Progress
from pipeline.stores import objects as storage
from pipeline.stores import stores
from pipeline.stores.objects import describe, fetch, find_objects, list_folder, read_bytes, remove, write_file
from pipeline.stores.stores import MissingObject
from pipeline.stores.urls import is_url, masked, shown, url_name

pytest_plugins = ("fixtures.s3",)
QUIET = Progress(quiet=True)


def put(tmp_path, url, content=b"some bytes"):
    source = tmp_path / "source"
    source.write_bytes(content)
    write_file(source, url)


def every(name):
    return True


@pytest.mark.parametrize(
    ("url", "expected"),
    [
        ("s3://bucket/a log.mcap", "s3://bucket/a log.mcap"),
        ("s3://key:secret@bucket/a.mcap", "s3://bucket/a.mcap"),
        ("https://me:secret@host:8080/x/a.mcap?X-Amz-Signature=secret#top", "https://host:8080/x/a.mcap"),
        ("/a/path?with=signs#and@more", "/a/path?with=signs#and@more"),
        ("s3://bucket/strange?key", "s3://bucket/strange?key"),
        ("s3://bucket/2026-??/a#1.mcap", "s3://bucket/2026-??/a#1.mcap"),
        ("gs://me:p@ss@bucket/a.mcap?Signature=secret&Expires=1", "gs://bucket/a.mcap"),
        ("abfs://container/a.mcap?sv=1&sig=secret", "abfs://container/a.mcap"),
        ("https:/me:secret@host/a.mcap?sig=secret", "https:/host/a.mcap"),
    ],
)
def test_what_may_be_secret_is_not_shown(url, expected):
    assert shown(url) == expected


def test_urls_in_a_text_are_masked_and_the_rest_stays():
    text = "https:/me:secret@host/a?sig=secret: not found; see 'ftp://u:secret@host/b', s3://b/c?X-Amz-Signature=secret."
    assert masked(text) == "https:/host/a: not found; see 'ftp://host/b', s3://b/c."
    assert masked("a/b?c=d: 12:30/13:30, me@home; C:/x?y=z") == "a/b?c=d: 12:30/13:30, me@home; C:/x?y=z"


def test_names_and_kinds_of_urls():
    assert url_name("https://host/x/a%20b.mcap?token=1/2") == "a b.mcap"
    assert url_name("s3://bucket/x/100%20.mcap") == "100%20.mcap"
    assert url_name("s3://bucket/folder/") == "folder"
    assert is_url("s3://b") and is_url("gs://b/k") and not is_url("/a/b") and not is_url("C:/x") and not is_url("a:b")


def test_find_an_object_a_prefix_and_a_pattern(s3, tmp_path):
    for name in ("x/a.mcap", "x/deep/b.mcap", "x/notes.txt", "xy/c.mcap"):
        put(tmp_path, f"s3://sea/{name}", name.encode())

    def names(url):
        return [(found.url, found.size_bytes) for found in find_objects(url, lambda name: name.endswith(".mcap"))]

    both = [("s3://sea/x/a.mcap", 8), ("s3://sea/x/deep/b.mcap", 13)]
    assert names("s3://sea/x") == names("s3://sea/x/") == names("s3://sea/x/**/*.mcap") == both
    assert names("s3://sea/x/*.mcap") == both[:1]
    assert names("s3://sea/x/notes.txt") == [("s3://sea/x/notes.txt", 11)]  # named itself: no matter how it ends
    assert len(names("s3://sea")) == 3
    assert names("s3://sea/none.mcap") == [("s3://sea/none.mcap", 0)]
    assert names("s3://sea/none/*.mcap") == []
    seen = []
    find_objects("s3://sea/x", lambda name: bool(seen.append(name)))
    assert seen == ["a.mcap", "deep/b.mcap", "notes.txt"]  # relative: hidden folders above do not matter


def test_etags_change_with_the_content(s3, tmp_path):
    put(tmp_path, "s3://sea/a", b"one")
    first = describe("s3://sea/a")
    put(tmp_path, "s3://sea/a", b"two")
    second = describe("s3://sea/a")
    assert first.etag and first.etag != second.etag and first.size_bytes == second.size_bytes == 3
    assert list_folder("s3://sea/") == {"a": second} and list_folder("s3://sea/none") == {}


def test_a_fetch_goes_on_where_it_was_cut(s3, tmp_path, monkeypatch):
    monkeypatch.setattr(storage, "BLOCK_BYTES", 1000)
    content = os.urandom(4500)
    put(tmp_path, "s3://sea/log.mcap", content)
    found = describe("s3://sea/log.mcap")
    original = storage.attempt

    def cut(action, url, is_output=False, num_attempts=5):
        if s3.count("GET", "log.mcap") == 3:
            raise KeyboardInterrupt
        return original(action, url, is_output, num_attempts)

    monkeypatch.setattr(storage, "attempt", cut)
    with pytest.raises(KeyboardInterrupt):
        fetch(found, tmp_path, QUIET)
    assert not (tmp_path / "log.mcap").exists()  # never half a log under its name
    monkeypatch.setattr(storage, "attempt", original)
    s3.requests.clear()
    assert fetch(found, tmp_path, QUIET).read_bytes() == content
    assert s3.count("GET", "log.mcap") == 2  # 4500 bytes are five blocks, three were there
    s3.requests.clear()
    assert fetch(found, tmp_path, QUIET).read_bytes() == content
    assert s3.requests == []


def test_what_was_fetched_of_an_earlier_content_is_not_mixed_in(s3, tmp_path, monkeypatch):
    put(tmp_path, "s3://sea/log.mcap", b"old content")
    fetch(describe("s3://sea/log.mcap"), tmp_path, QUIET)
    put(tmp_path, "s3://sea/log.mcap", b"new content")
    assert fetch(describe("s3://sea/log.mcap"), tmp_path, QUIET).read_bytes() == b"new content"
    old = describe("s3://sea/log.mcap")
    (tmp_path / "other").mkdir()
    put(tmp_path, "s3://sea/log.mcap", b"other bytes")
    with pytest.raises(InputError, match="was changed while it was fetched"):
        fetch(old, tmp_path / "other", QUIET)
    assert list((tmp_path / "other").iterdir()) == []


@pytest.mark.parametrize("status", ["500 Internal Server Error", "503 Slow Down"])
def test_a_server_that_fails_at_first_is_asked_again(s3, tmp_path, status):
    put(tmp_path, "s3://sea/a", b"content")
    for method, path, count in (("HEAD", "a", 2), ("GET", "a", 3), ("PUT", "b", 2)):
        s3.fail(method, path, status, count)
    assert fetch(describe("s3://sea/a"), tmp_path, QUIET).read_bytes() == b"content"
    put(tmp_path, "s3://sea/b", b"more")
    assert read_bytes("s3://sea/b") == b"more"
    assert all(fault.count == 0 for fault in s3.faults)


def test_a_server_that_always_fails_is_given_up(s3, tmp_path):
    put(tmp_path, "s3://sea/a")
    s3.fail("GET", "a", count=100)
    with pytest.raises(DeviceError, match=r"s3://sea/a: the store does not answer as it should, tried 5 times .* run again"):
        read_bytes("s3://sea/a")
    assert s3.count("GET", "a") == 5


def test_a_server_that_is_silent_is_given_up(s3, tmp_path, monkeypatch):
    put(tmp_path, "s3://sea/a")
    monkeypatch.setattr(stores, "READ_TIMEOUT_S", 0.2)
    monkeypatch.setattr(stores, "NUM_ATTEMPTS", 2)
    s3.fail("GET", "a", count=2, pause_s=1.0)
    with pytest.raises(DeviceError, match="does not answer"):
        read_bytes("s3://sea/a")


def test_nobody_listens(s3, new_clients, monkeypatch):
    monkeypatch.setenv("AWS_ENDPOINT_URL", "http://127.0.0.1:9")
    with pytest.raises(DeviceError, match=r"does not answer.*check the connection"):
        describe("s3://sea/other")


def test_nobody_listens_where_a_store_is_asked_at_once(monkeypatch):
    monkeypatch.setattr("pipeline.stores.stores.FIRST_PAUSE_S", 0.0)
    with pytest.raises(DeviceError, match=r"ftp://127.0.0.1:9/a.mcap: the store does not answer.*check the connection"):
        describe("ftp://user:secret@127.0.0.1:9/a.mcap?token=abc")


def test_what_is_not_there_is_said_once_and_plainly(s3, tmp_path):
    with pytest.raises(MissingObject, match=r"s3://sea/none.mcap: not found; check the URL"):
        describe("s3://sea/none.mcap")
    for act in (describe, read_bytes, list_folder, lambda url: find_objects(url, every)):
        with pytest.raises(InputError, match="there is no such bucket") as failure:
            act("s3://lake/a.mcap")
        assert not isinstance(failure.value, MissingObject)
    with pytest.raises(DeviceError, match=r"s3://lake/a: there is no such bucket; make it"):
        put(tmp_path, "s3://lake/a")
    with pytest.raises(InputError, match="is a folder"):
        put(tmp_path, "s3://sea/x/a")
        describe("s3://sea/x")
    remove("s3://sea/none")
    assert s3.count("HEAD", "none.mcap") == 1  # asking again would not bring it


def test_denied(s3, tmp_path):
    put(tmp_path, "s3://sea/a")
    for method in ("HEAD", "GET", "PUT"):
        s3.fail(method, "a", "403 Forbidden")
    for act in (describe, read_bytes, partial(put, tmp_path)):
        with pytest.raises(DeviceError, match=r"s3://sea/a: access denied .*check the credentials") as failure:
            act("s3://sea/a")
        assert "open-sesame" not in str(failure.value) and "\n" not in str(failure.value)


def test_without_credentials(s3, new_clients, tmp_path, monkeypatch):
    for name in ("AWS_ACCESS_KEY_ID", "AWS_SECRET_ACCESS_KEY"):
        monkeypatch.delenv(name)
    monkeypatch.setenv("AWS_EC2_METADATA_DISABLED", "true")
    monkeypatch.setenv("AWS_SHARED_CREDENTIALS_FILE", str(tmp_path / "none"))
    monkeypatch.setenv("AWS_CONFIG_FILE", str(tmp_path / "none"))
    with pytest.raises(DeviceError, match="no credentials found; set AWS_PROFILE"):
        describe("s3://sea/a")


def test_a_missing_package_and_an_unknown_scheme(monkeypatch):
    with pytest.raises(ConfigError, match="foo:// is not known"):
        describe("foo://a/b")
    monkeypatch.setitem(sys.modules, "s3fs", None)
    monkeypatch.delitem(sys.modules["fsspec.registry"]._registry, "s3", raising=False)
    with pytest.raises(ConfigError, match=r"s3://a/b: s3:// needs a package that is not installed; pip install cadence\[s3\]"):
        describe("s3://a/b")
    with pytest.raises(ConfigError, match="pip install gcsfs"):
        describe("gs://a/b")


def test_a_full_disk_is_not_the_stores_fault(s3, tmp_path):
    put(tmp_path, "s3://sea/a.mcap")
    found = describe("s3://sea/a.mcap")
    fetch(found, tmp_path, QUIET)
    (mark,) = tmp_path.glob(".*")
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / f"{mark.name}.part").symlink_to("/dev/full")
    s3.requests.clear()
    with pytest.raises(DeviceError, match=r"full/.*cannot write \(No space left.*set TMPDIR"):
        fetch(found, tmp_path / "full", QUIET)
    assert s3.count("GET", "a.mcap") == 1


def test_memory_files(tmp_path):
    put(tmp_path, "memory://store/x/a.mcap", b"12345")
    (found,) = find_objects("memory://store/x", every)
    assert (found.name, found.size_bytes) == ("a.mcap", 5) and found.etag
    found = describe(found.url)
    assert fetch(found, tmp_path, QUIET).read_bytes() == b"12345"
    remove("memory://store/x/a.mcap")
    with pytest.raises(MissingObject):
        describe("memory://store/x/a.mcap")


class WebHandler(http.server.SimpleHTTPRequestHandler):
    """Python's web server: it knows no ranges, and wants a signature."""

    def log_message(self, format, *args):
        pass

    def send_head(self):
        if "signature=secret" not in self.path:
            self.send_error(403)
            return None
        return super().send_head()


@pytest.fixture
def web(tmp_path):
    pytest.importorskip("aiohttp", reason="needs the extra s3")
    (tmp_path / "web").mkdir()
    server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), partial(WebHandler, directory=str(tmp_path / "web")))
    thread = threading.Thread(target=server.serve_forever, daemon=True)
    thread.start()
    yield f"http://127.0.0.1:{server.server_port}"
    server.shutdown()
    thread.join()
    server.server_close()


def test_a_web_server_without_ranges(web, tmp_path, monkeypatch):
    monkeypatch.setattr(storage, "BLOCK_BYTES", 1000)
    content = os.urandom(2500)
    (tmp_path / "web" / "a b.mcap").write_bytes(content)
    (found,) = find_objects(f"{web}/a%20b.mcap?signature=secret", every)
    assert found.name == "a b.mcap" and found.size_bytes == 2500 and found.etag
    assert fetch(found, tmp_path, QUIET).read_bytes() == content
    with pytest.raises(MissingObject, match=r"/none.mcap: not found") as failure:
        describe(f"{web}/none.mcap?signature=secret")
    assert "secret" not in str(failure.value)
    with pytest.raises(DeviceError, match="access denied") as failure:
        describe(f"{web}/a%20b.mcap?signature=wrong")
    assert "wrong" not in str(failure.value)


def test_a_web_server_with_ranges(s3, tmp_path, monkeypatch):
    monkeypatch.setattr(storage, "BLOCK_BYTES", 1000)
    put(tmp_path, "s3://sea/a.mcap", os.urandom(2500))
    signed = stores.open_store("s3://sea/a.mcap")[0].sign("sea/a.mcap", expiration=100)
    found = describe(signed)
    assert "Signature" in signed and shown(signed) == f"{s3.url}/sea/a.mcap"
    s3.requests.clear()
    assert fetch(found, tmp_path, QUIET).read_bytes() == (tmp_path / "source").read_bytes()
    assert s3.count("GET", "a.mcap") == 4  # one to ask whether parts can be had
