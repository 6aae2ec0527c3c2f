import hashlib
import os
import stat
import time

import pytest

from cadence.errors import DeviceError
from pipeline import files
from pipeline.files import hash_file, replacing, write_atomic


def names_in(folder):
    return sorted(path.name for path in folder.iterdir())


def test_write_atomic_replaces_and_honours_the_umask(tmp_path):
    path = tmp_path / "deep" / "x.json"
    before = os.umask(0o022)
    try:
        write_atomic(path, "old")
        write_atomic(path, "new")
    finally:
        os.umask(before)
    assert path.read_text() == "new" and names_in(path.parent) == ["x.json"]
    assert stat.S_IMODE(path.stat().st_mode) == 0o644


def test_write_atomic_that_fails_leaves_no_draft(tmp_path):
    (tmp_path / "x.json").mkdir()
    with pytest.raises(DeviceError, match="cannot write"):
        write_atomic(tmp_path / "x.json", "text")
    assert names_in(tmp_path) == ["x.json"]


def test_a_draft_that_was_not_finished_leaves_what_was_there(tmp_path):
    path = tmp_path / "weights.bin"
    path.write_bytes(b"old")
    with pytest.raises(KeyboardInterrupt), replacing(path) as draft:
        draft.write_bytes(b"ne")
        raise KeyboardInterrupt
    assert path.read_bytes() == b"old" and names_in(tmp_path) == ["weights.bin"]


def test_what_a_killed_process_left_goes_with_the_next_draft(tmp_path):
    left = tmp_path / ".weights.bin.0123abcd"
    left.mkdir()
    (left / "weights.bin").write_bytes(b"half")
    with replacing(tmp_path / "weights.bin") as draft:
        draft.write_bytes(b"new")
        assert not left.exists() and names_in(tmp_path) == [draft.parent.name]
    assert names_in(tmp_path) == ["weights.bin"]


def test_the_folder_of_a_first_draft_that_failed_goes_too(tmp_path):
    with pytest.raises(ValueError), replacing(tmp_path / "cache" / "weights.bin"):
        raise ValueError
    assert names_in(tmp_path) == []


def test_a_changed_file_is_hashed_again_also_with_its_old_size_and_time(tmp_path, monkeypatch):
    monkeypatch.setattr(files, "_SETTLED_NS", 0)
    path = tmp_path / "log.mcap"
    path.write_bytes(b"one")
    before, times = hash_file(path), path.stat()
    time.sleep(0.02)  # more than a tick of the kernel's clock
    path.write_bytes(b"two")
    os.utime(path, ns=(times.st_atime_ns, times.st_mtime_ns))
    assert hash_file(path) == hashlib.sha256(b"two").hexdigest() != before


def test_a_file_that_has_just_been_written_is_read_each_time(tmp_path):
    path = tmp_path / "log.mcap"
    for content in (b"one", b"two"):  # within one tick, as far as the stamps go
        path.write_bytes(content)
        assert hash_file(path) == hashlib.sha256(content).hexdigest()


def test_a_settled_file_is_read_once(tmp_path, monkeypatch):
    path = tmp_path / "log.mcap"
    path.write_bytes(b"one")
    reads = []
    monkeypatch.setattr(files, "_SETTLED_NS", 0)
    monkeypatch.setattr(hashlib, "file_digest", lambda file, name: reads.append(name) or hashlib.new(name, file.read()))
    assert [hash_file(path) for _ in range(3)] == [hashlib.sha256(b"one").hexdigest()] * 3 and len(reads) == 1
