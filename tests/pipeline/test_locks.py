"""A folder is held by one process at a time; places that take no folder are named at once."""

import shutil
from pathlib import Path

import pytest

from cadence.errors import DeviceError
from pipeline.locks import locked


def test_a_place_that_takes_no_folder_is_named_and_not_tried_for_ever():
    if not Path("/proc/self").exists():
        pytest.skip("needs /proc, where making a folder says that there is no such folder")
    with pytest.raises(DeviceError, match=r"/proc/nobody/a: cannot write there \(.+\); choose another folder with --out"):
        locked(Path("/proc/nobody/a")).__enter__()


def test_a_file_in_the_way_is_named(tmp_path):
    (tmp_path / "a").write_text("a file")
    with pytest.raises(DeviceError, match="a/b: cannot write there"):
        locked(tmp_path / "a" / "b").__enter__()


def test_a_folder_that_another_process_removes_meanwhile_is_made_again(tmp_path, monkeypatch):
    made = Path.mkdir
    times = []

    def mkdir(self, *arguments, **options):
        made(self, *arguments, **options)
        times.append(self)
        if len(times) < 3:
            shutil.rmtree(self)

    monkeypatch.setattr(Path, "mkdir", mkdir)
    with locked(tmp_path / "a"):
        assert len(times) == 3 and (tmp_path / "a").is_dir()
