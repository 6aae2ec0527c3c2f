import json

import numpy as np
import pytest
from fixtures.line_logs import straight_line, write_log
from fixtures.recorder import NUM_MESSAGES, START_NS, STEP_NS, recording
from mcap.writer import Writer

from cadence.errors import InputError, NothingDetectedError
from pipeline.catalogue import open_catalogued_log, read_catalogue
from pipeline.extract.config import ExtractConfig
from pipeline.extract.stage import extract
from pipeline.files import hash_file
from pipeline.ingest.stage import IngestConfig, ingest
from pipeline.logs.reader import open_log
from pipeline.missions import CATALOGUE_NAME
from pipeline.progress import Progress

QUIET = Progress(quiet=True)


def ingested(log, directory, force=False):
    return ingest(log, directory, IngestConfig(), QUIET, force)


@pytest.fixture
def log(tmp_path):
    path = tmp_path / "flight.mcap"
    path.write_bytes(recording())
    return path


def test_catalogue_states_what_the_log_holds(log, tmp_path):
    result = ingested(log, tmp_path / "out")
    assert result.status == "done" and [path.name for path in result.outputs] == [CATALOGUE_NAME]
    catalogue = read_catalogue(tmp_path / "out")
    assert catalogue.path == log and catalogue.sha256 == hash_file(log) and catalogue.size_bytes == log.stat().st_size
    assert (catalogue.start_ns, catalogue.end_ns) == (START_NS, START_NS + (NUM_MESSAGES - 1) * STEP_NS)
    assert catalogue.duration_s == pytest.approx((NUM_MESSAGES - 1) / 10)
    assert catalogue.metadata_names == ("mission",) and catalogue.health == open_log(log).health
    first = catalogue.channels[0]
    assert (first.topic, first.encoding, first.schema_name, first.num_messages) == ("/a", "json", "Item", NUM_MESSAGES // 3)
    assert first.mean_rate_hz == pytest.approx(1 / 0.3) and first.median_gap_s == pytest.approx(0.3)
    assert first.is_decodable and first.reason is None
    assert result.summary["num_messages"] == NUM_MESSAGES and json.dumps(result.summary)


def test_real_flight(shared_data, tmp_path):
    ingested(shared_data / "flights" / "cubs2_cub_stabilize.mcap", tmp_path)
    catalogue = read_catalogue(tmp_path)
    pose = next(channel for channel in catalogue.channels if channel.topic == "/cub1/pose")
    assert pose.num_messages == 19703 and pose.mean_rate_hz == pytest.approx(99.5, rel=0.01) and pose.frame_id == "qualisys"
    times = [m.log_time_ns for m in open_log(catalogue.path).messages({"/cub1/pose"})]
    assert pose.median_gap_s == pytest.approx(np.median(np.diff(times)) / 1e9)
    assert catalogue.roles["/cub1/pose"] and "/pose" in catalogue.suggested_mapping


def test_second_run_is_skipped_until_something_changes(log, tmp_path):
    out = tmp_path / "out"
    assert [ingested(log, out).status for _ in range(2)] == ["done", "skipped"]
    assert ingested(log, out, force=True).status == "done"
    log.write_bytes(recording(num_messages=30))
    assert ingested(log, out).status == "done" and read_catalogue(out).health.num_messages == 30


def test_moved_log_is_found_where_it_is_now(log, tmp_path):
    out, moved = tmp_path / "out", tmp_path / "elsewhere" / log.name
    ingested(log, out)
    moved.parent.mkdir()
    log.rename(moved)
    with pytest.raises(InputError, match="not there any more"):
        open_catalogued_log(read_catalogue(out))
    assert ingested(moved, out).status == "done"
    assert open_catalogued_log(read_catalogue(out)).path == moved


def test_relative_path_becomes_absolute(log, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    ingested(log.relative_to(tmp_path), tmp_path / "out")
    assert read_catalogue(tmp_path / "out").path == log


def test_changed_log_is_not_read_as_the_catalogued_one(log, tmp_path):
    ingested(log, tmp_path / "out")
    catalogue = read_catalogue(tmp_path / "out")
    assert len(list(open_catalogued_log(catalogue).messages())) == NUM_MESSAGES
    content = bytearray(log.read_bytes())
    content[len(content) // 2] ^= 1
    log.write_bytes(content)
    with pytest.raises(InputError, match="changed after"):
        open_catalogued_log(catalogue)


def test_undecodable_channels_are_named_and_stop_nothing(tmp_path):
    path = tmp_path / "log.mcap"
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        event = writer.register_schema("a/srv/S_Event", "ros2msg", b"int32 a\n---\nint32 b\n")
        image = writer.register_schema("a/msg/Image", "ros2msg", b"uint8[] data\nstring name\n")
        for topic, encoding, schema, data in (
            ("/event", "cdr", event, b"\0\1\0\0"),
            ("/image", "cdr", image, b"\0\1\0\0\xff\xff\xff\x7f"),
            ("/blob", "flatbuffer", 0, b"xyz"),
            ("/plain", "json", 0, b'{"frame_id": "map"}'),
        ):
            writer.add_message(writer.register_channel(topic, encoding, schema), 1, data, 1)
        writer.finish()
    result = ingested(path, tmp_path / "out")
    channels = {channel.topic: channel for channel in read_catalogue(tmp_path / "out").channels}
    assert result.summary["undecodable"] == ["/event", "/image", "/blob"]
    assert [channels[topic].is_decodable for topic in ("/event", "/image", "/blob", "/plain")] == [False, False, False, True]
    assert "flatbuffer" in channels["/blob"].reason and channels["/plain"].frame_id == "map"
    assert channels["/plain"].mean_rate_hz is None


def test_damaged_log_is_ingested_and_its_loss_is_in_the_catalogue(log, tmp_path):
    log.write_bytes(log.read_bytes()[:5000])
    result = ingested(log, tmp_path / "out")
    health = read_catalogue(tmp_path / "out").health
    assert not health.is_complete and health.problems and 0 < health.num_messages < NUM_MESSAGES
    assert result.summary["is_complete"] is False and health == open_log(log).health


@pytest.mark.parametrize(
    ("data", "words"),
    [(b"", "empty"), (b"x" * 99, "not an MCAP"), (recording(num_messages=0), "no message")],
    ids=["empty", "text", "none"],
)
def test_unusable_log_leaves_nothing_behind(data, words, tmp_path):
    path, out = tmp_path / "bad.mcap", tmp_path / "out"
    path.write_bytes(data)
    with pytest.raises(InputError, match=words):
        ingested(path, out)
    assert not out.exists() or list(out.iterdir()) == []
    with pytest.raises(InputError, match="not found"):
        ingested(tmp_path / "gone.mcap", out)
    with pytest.raises(InputError, match="folder"):
        ingested(tmp_path, out)


def test_a_sound_log_without_a_message_is_no_failure_of_a_batch(tmp_path):
    path = tmp_path / "none.mcap"
    path.write_bytes(recording(num_messages=0))
    with pytest.raises(NothingDetectedError, match="no message was recorded"):
        ingested(path, tmp_path / "out")
    path.write_bytes(recording(num_messages=0, has_summary=False)[:-60])
    with pytest.raises(InputError, match="no message") as error:
        ingested(path, tmp_path / "out")
    assert not isinstance(error.value, NothingDetectedError)


def test_catalogue_that_is_absent_damaged_or_old_is_refused(log, tmp_path):
    out = tmp_path / "out"
    with pytest.raises(InputError, match=r"out: not found; `cadence run LOG --out results` makes one"):
        read_catalogue(out)
    ingested(log, out)
    whole = json.loads((out / CATALOGUE_NAME).read_text())
    for text in (
        "{",
        "[]",
        json.dumps(whole | {"version": 99}),
        json.dumps(whole | {"channels": 3}),
        json.dumps(whole | {"x": 1}),
    ):
        (out / CATALOGUE_NAME).write_text(text)
        with pytest.raises(InputError, match="--force"):
            read_catalogue(out)
    assert ingested(log, out).status == "done"  # the stage does not trust its damaged output either


def test_same_log_gives_the_same_bytes(log, tmp_path):
    written = []
    for name in ("one", "two"):
        ingested(log, tmp_path / name)
        written.append((tmp_path / name / CATALOGUE_NAME).read_bytes())
    assert written[0] == written[1]


@pytest.fixture
def parts(tmp_path):
    """One target, recorded in two files."""
    folder = tmp_path / "bag"
    folder.mkdir()
    fixes = straight_line()
    (folder / "metadata.yaml").write_text("relative_file_paths:\n  - bag_0.mcap\n  - bag_1.mcap\n")
    return [write_log(folder / f"bag_{i}.mcap", fixes[6 * i : 6 * i + 6]) for i in range(2)]


def test_parts_are_one_mission(parts, tmp_path):
    out = tmp_path / "out"
    assert ingested(parts, out).summary["parts"] == [str(path) for path in parts]
    catalogue = read_catalogue(out)
    assert catalogue.name == "bag" and catalogue.path == parts[0] and catalogue.health.num_messages == 12
    assert [(part.path, part.sha256, part.size_bytes) for part in catalogue.parts] == [
        (path, hash_file(path), path.stat().st_size) for path in parts
    ]
    assert [channel.num_messages for channel in catalogue.channels] == [12]
    assert len(list(open_catalogued_log(catalogue).messages())) == 12
    assert extract(out, ExtractConfig(), QUIET).summary["num_detections"] == 12
    assert ingested(parts, out).status == ingested(parts[0].parent, out).status == "skipped"  # the folder is its parts
    assert ingested(parts[:1], out).status == "done"


def test_changed_and_missing_parts_are_noticed(parts, tmp_path):
    out = tmp_path / "out"
    ingested(parts, out)
    catalogue = read_catalogue(out)
    whole = parts[1].read_bytes()
    parts[1].write_bytes(whole[:-20])
    with pytest.raises(InputError, match=r"bag_1\.mcap: was changed after"):
        open_catalogued_log(catalogue)
    assert ingested(parts, out).status == "done" and read_catalogue(out).health.problems
    parts[1].unlink()
    with pytest.raises(InputError, match=r"bag_1\.mcap: the log that was ingested is not there"):
        open_catalogued_log(catalogue)
    result = ingested(parts[:1], out)
    assert not result.summary["is_complete"] and "bag_1.mcap: is named in" in result.summary["problems"][0]


def test_parts_of_one_name_are_refused(parts, tmp_path):
    other = tmp_path / "other"
    other.mkdir()
    (other / parts[0].name).write_bytes(parts[1].read_bytes())
    with pytest.raises(InputError, match="same name"):
        ingested([parts[0], other / parts[0].name], tmp_path / "out")
