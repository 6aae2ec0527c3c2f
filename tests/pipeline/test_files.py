import os
import stat

import pytest

from cadence.errors import DeviceError
from pipeline.files import replacing, write_atomic


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
