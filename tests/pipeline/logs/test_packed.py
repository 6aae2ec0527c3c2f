"""Logs that are compressed as a whole: the same log, whatever is done with it; bombs and broken ones are told."""

import shutil
from collections import namedtuple
from pathlib import Path

import pytest
import zstandard
from fixtures.recorder import NUM_MESSAGES, content, recording, reference

from cadence.errors import DeviceError, InputError
from pipeline.logs import packed
from pipeline.logs.append import write_combined
from pipeline.logs.container import container_remarks
from pipeline.logs.packed import in_proportion, unpacked
from pipeline.logs.parts import group_parts, log_stem, missing_parts, mission_name, recorded_parts
from pipeline.logs.reader import open_log, open_parts, reopen
from pipeline.logs.recorder import Packing
from pipeline.logs.writer import LogWriter
from pipeline.missions import find_missions
from pipeline.progress import Progress
from schemas.channels import AGENTS

WHOLE = recording()
METADATA = """rosbag2_bagfile_information:
  relative_file_paths:
    - bag_0.mcap.zstd
    - bag_1.mcap.zstd
  compression_format: zstd
  compression_mode: FILE
"""


@pytest.fixture
def log(tmp_path: Path) -> Path:
    path = tmp_path / "flight.mcap.zstd"
    path.write_bytes(zstandard.compress(WHOLE[:3000]) + zstandard.compress(WHOLE[3000:]))
    return path


def test_a_packed_log_is_the_log(log: Path) -> None:
    steps: list[int] = []
    found = open_log(log, steps.append)
    assert content(found) == reference(WHOLE) and found.health.is_complete and not found.health.problems
    assert (found.name, found.path, found.parts) == ("flight", log, (log,))
    assert sum(steps) == log.stat().st_size and found.size_bytes == len(WHOLE)
    steps.clear()
    list(found.messages(on_bytes=steps.append))
    assert sum(steps) == found.size_bytes
    assert content(reopen([log], found.health)) == content(found) and container_remarks(log) == ()
    steps.clear()
    open_log(log, steps.append)  # unpacked already
    assert sum(steps) == log.stat().st_size


def test_a_changed_file_is_unpacked_again(log: Path) -> None:
    first = open_log(log)
    log.write_bytes(zstandard.compress(recording(num_messages=3)))
    assert open_log(log).health.num_messages == 3 < first.health.num_messages


def test_few_copies_are_kept(log: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(packed, "_MAX_COPIES", 2)
    copies = []
    for number in range(4):
        other = log.with_name(f"{number}.mcap.zst")
        shutil.copy(log, other)
        copies.append(unpacked(other))
    assert [copy.is_file() for copy in copies] == [False, False, True, True]
    assert unpacked(log.with_name("0.mcap.zst")).read_bytes() == WHOLE


def test_what_is_not_packed_is_left_where_it_is(write_log) -> None:
    path = write_log(WHOLE)
    assert unpacked(path) == path


@pytest.mark.parametrize("cut", [0.5, 0.9])
def test_a_packed_log_that_was_cut_off_is_read_up_to_there(cut: float, tmp_path: Path) -> None:
    whole = recording(num_messages=20_000, chunk_size=20_000)
    data = zstandard.compress(whole)
    path = tmp_path / "cut.mcap.zstd"
    path.write_bytes(data[: int(cut * len(data))])
    log = open_log(path)
    assert 0 < log.health.num_messages < 20_000 and not log.health.is_complete
    path.write_bytes(data[: int(cut * len(data))] + bytes(500) + data[int(cut * len(data)) + 500 :])
    assert 0 < open_log(path).health.num_messages <= 20_000 and not open_log(path).health.is_complete


@pytest.mark.parametrize("content", [b"something else", b"", b"\x89MC"])
def test_what_holds_no_log_is_refused(content: bytes, tmp_path: Path) -> None:
    path = tmp_path / "log.mcap.zstd"
    path.write_bytes(zstandard.compress(content))
    with pytest.raises(InputError, match="holds no MCAP"):
        open_log(path)


def test_a_log_that_does_not_fit_on_the_disk_is_refused(log: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    usage = namedtuple("usage", "total used free")
    monkeypatch.setattr(packed.shutil, "disk_usage", lambda _: usage(2**40, 2**40, 2**20))
    with pytest.raises(DeviceError, match="more than fits into"):
        open_log(log)


@pytest.mark.parametrize(("total", "share"), [(10, 3), (3, 10), (7, 7), (5, 0)])
def test_progress_in_proportion_adds_up(total: int, share: int) -> None:
    steps: list[int] = []
    advance = in_proportion(steps.append, total, share)
    for _ in range(total):
        advance(1)
    assert sum(steps) == share and all(step > 0 for step in steps)


def test_parts_are_found_packed_or_not(tmp_path: Path) -> None:
    """A folder of rosbag2: one part was unpacked since, beside its packed form."""
    for number, data in enumerate((recording(num_messages=20), WHOLE)):
        (tmp_path / f"bag_{number}.mcap.zstd").write_bytes(zstandard.compress(data))
    (tmp_path / "bag_1.mcap").write_bytes(WHOLE)
    (tmp_path / "metadata.yaml").write_text(METADATA)
    parts = (tmp_path / "bag_0.mcap.zstd", tmp_path / "bag_1.mcap")
    assert recorded_parts(tmp_path) == parts and missing_parts(parts) == () and group_parts([tmp_path]) == [parts]
    (mission,) = find_missions([str(tmp_path)], str(tmp_path / "out"))
    assert mission.parts == tuple(map(str, parts)) and mission.directory == str(tmp_path / "out" / "bag")
    log = open_parts(parts)
    assert log.health.num_messages == NUM_MESSAGES + 20 and log.health.is_complete
    (tmp_path / "bag_1.mcap").unlink()
    assert recorded_parts(tmp_path)[1].name == "bag_1.mcap.zstd"
    (tmp_path / "bag_1.mcap.zstd").unlink()
    assert missing_parts(parts[:1]) == (tmp_path / "bag_1.mcap.zstd",)


def test_packed_logs_of_a_folder_are_missions(tmp_path: Path) -> None:
    for name in ("a.mcap", "b.mcap.zst", "c.mcap.zstd", "b.mcap.zst.part", "d.cadence.mcap.zst"):
        (tmp_path / name).write_bytes(WHOLE if name == "a.mcap" else zstandard.compress(WHOLE))
    found = find_missions([str(tmp_path)], "out")
    assert [Path(mission.parts[0]).name for mission in found] == ["a.mcap", "b.mcap.zst", "c.mcap.zstd"]
    assert [mission.directory for mission in found] == ["out/a", "out/b", "out/c"]


@pytest.mark.parametrize(("name", "stem"), [("a.mcap", "a"), ("a.b.mcap.zstd", "a.b"), ("a.mcap.zst", "a"), ("a.bag", "a")])
def test_names_without_their_endings(name: str, stem: str) -> None:
    assert log_stem(name) == mission_name([Path(name)]) == stem


def test_a_packed_log_is_combined_as_what_it_holds(log: Path, tmp_path: Path) -> None:
    side, combined = tmp_path / "side.mcap", tmp_path / "combined.mcap"
    with LogWriter(side) as writer:
        writer.write(AGENTS, 10**18, b"agents")
    write_combined(log, side, combined, Packing(), Progress(quiet=True))
    assert combined.read_bytes().startswith(WHOLE[:2000])
    assert open_log(combined).health.num_messages == NUM_MESSAGES + 1
