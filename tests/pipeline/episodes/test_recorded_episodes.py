"""Episodes out of logs and worlds: what is read, what is left out, what is kept."""

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest
from fixtures.small_logs import Row, detection, pose, time_ns, write_log
from mcap.writer import Writer

from cadence.errors import ConfigError, InputError
from cadence.recordings import Recordings
from pipeline.config import read_config
from pipeline.episodes import recordings as recordings_module
from pipeline.episodes.recordings import RecordingsConfig, load_recordings, read_recordings, save_recordings
from pipeline.progress import Progress

QUIET = Progress(quiet=True)
MISSION = {
    "step_s": "60",
    "cell_m": "21.0",
    "map_side_m": "50988.0",
    "hideout_known_to_trackers": "[[4914.0, 3591.0]]",
    "mountains": '[{"x_m": 500.0, "y_m": 900.0, "keep_out_radius_m": 50.0}]',
}


def trackers(time_s: float, *places: tuple[float, float]) -> Row:
    poses = [{"position": {"x": x, "y": y, "z": 0.0}} for x, y in places]
    stamp = {"sec": time_ns(time_s) // 10**9, "nsec": time_ns(time_s) % 10**9}
    return Row("/trackers", "foxglove.PosesInFrame", time_s, {"timestamp": stamp, "frame_id": "map", "poses": poses})


def walk(num_steps: int, seen: tuple[int, ...], off_m: float = 0.0) -> list[Row]:
    """A target that goes 100 m east a step, seen at some steps; a party beside it, a camera, an aircraft."""
    rows = []
    for k in range(num_steps):
        rows.append(pose(60.0 * k, 100.0 * k, 20.0, "/truth/fugitive"))
        rows.append(trackers(60.0 * k, (90.0 * k, 0.0), (7.0, 7.0), (2000.0 * k, 5.0)))
        rows += [detection(60.0 * k, 100.0 * k, 20.0 + off_m, sensor=f"camera_{i}") for i in range(2 if k in seen else 0)]
    return rows


def with_record(path: Path, rows: list[Row], record: dict[str, str], empty_detections: bool = False) -> Path:
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        writer.add_metadata("mission", record)
        channels: dict[str, int] = {}
        names = {row.topic: row.schema for row in rows} | ({"/detections": "mission.Detection"} if empty_detections else {})
        for topic, schema in names.items():
            channels[topic] = writer.register_channel(topic, "json", writer.register_schema(schema, "jsonschema", b"{}"))
        for row in rows:
            at = time_ns(row.time_s)
            writer.add_message(channels[row.topic], at, json.dumps(row.message).encode(), at)
        writer.finish()
    return path


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    data = tmp_path / "logs"
    data.mkdir()
    with_record(data / "a.mcap", walk(12, (3, 4, 9)), MISSION)
    with_record(data / "b.mcap", walk(5, (2,)), MISSION)
    return data


def load(data: Path, *, together: bool = False, **changes: object):
    config = RecordingsConfig(data=data, **changes)  # type: ignore[arg-type]
    return load_recordings(config, data.parent / "cache", QUIET, together)


def pair(num_targets: int = 2, start: int = 0) -> list[Row]:
    """Targets that go 100 m east a step beside each other, six steps; the last one from step `start` on."""
    last = num_targets - 1
    rows = [
        pose(60.0 * k, 100.0 * k, 100.0 * i, f"/truth/T{i}")
        for k in range(6)
        for i in range(num_targets)
        if i < last or k >= start
    ]
    seen = [detection(60.0 * (i + 2), 100.0 * (i + 2), 100.0 * i, agent_id=f"T{i}") for i in range(num_targets)]
    return sorted([*rows, *seen], key=lambda row: row.time_s)


def test_a_folder_of_logs_becomes_episodes(folder: Path) -> None:
    found = load(folder)
    rec = found.recordings
    assert found.names == ("a", "b") and rec.offset.tolist() == [0, 12, 17] and rec.step_s == 60.0
    assert np.array_equal(rec.position_m[:12], np.stack([100.0 * np.arange(12), np.full(12, 20.0)], axis=1))
    assert np.flatnonzero(rec.is_detected).tolist() == [3, 4, 9, 14]
    # the camera stands still; the aircraft comes first
    assert rec.tracker_m.shape == (17, 2, 2)
    assert np.allclose(rec.tracker_m[5], [[10_000.0, 5.0], [450.0, 0.0]])
    assert np.allclose(rec.known_goal_m, [[4914.0, 3591.0]] * 2)
    assert found.scale_m == 2428 * 21.0 and found.left_out == ()
    assert found.obstacles[0] is found.obstacles[1] and np.allclose(found.obstacles[0].circle_array, [[500.0, 900.0, 50.0]])


def test_what_was_read_once_is_kept_by_content(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    first = load(folder)
    (folder / "a.mcap").rename(folder / "z.mcap")

    def never(*_: object) -> None:
        raise AssertionError("read again")

    monkeypatch.setattr(recordings_module, "read_log_episodes", never)
    again = load(folder)
    assert again.names == ("b", "z")
    assert np.array_equal(again.recordings.select([1, 0]).position_m, first.recordings.position_m)
    assert again.scale_m == first.scale_m and np.allclose(again.obstacles[0].circle_array, first.obstacles[0].circle_array)
    with pytest.raises(AssertionError, match="read again"):
        load(folder, tolerance_m=2.0)


def test_logs_without_a_record_or_trackers_are_taken_too(tmp_path: Path) -> None:
    rows = [row for row in walk(6, (1,)) if row.topic != "/trackers"]
    write_log(tmp_path / "plain.mcap", rows)
    found = load(tmp_path)
    assert found.recordings.step_s == 60.0 and found.scale_m is None
    assert found.recordings.tracker_m.shape == (6, 0, 2) and np.isnan(found.recordings.known_goal_m).all()
    assert load(tmp_path, scale_m=10.0).scale_m == 10.0
    half = load(tmp_path, step_s=30.0).recordings
    assert len(half.position_m) == 11 and np.allclose(half.position_m[:, 0], 50.0 * np.arange(11))
    assert np.flatnonzero(half.is_detected).tolist() == [2]


def test_a_detection_counts_from_the_first_step_after_it(tmp_path: Path) -> None:
    rows = [pose(60.0 * k, 100.0 * k, 20.0, "/truth/t") for k in range(5)]
    rows.insert(3, detection(130.0, 100.0 * 130.0 / 60.0, 20.0))
    write_log(tmp_path / "one.mcap", rows)
    assert np.flatnonzero(load(tmp_path).recordings.is_detected).tolist() == [3]


@pytest.mark.parametrize("says", ["channel", "record"])
def test_an_episode_in_which_nothing_was_seen_counts(folder: Path, says: str) -> None:
    record = MISSION | ({"num_detections": "0"} if says == "record" else {})
    with_record(folder / "c.mcap", walk(8, ()), record, empty_detections=says == "channel")
    found = load(folder)
    assert found.names == ("a", "b", "c")
    assert not found.recordings.select([2]).is_detected.any() and len(found.recordings.select([2]).position_m) == 8


def test_several_targets_are_episodes_of_their_own(tmp_path: Path) -> None:
    write_log(tmp_path / "pair.mcap", pair())
    found = load(tmp_path)
    assert found.names == ("pair/T0", "pair/T1") and found.recordings.num_episodes == 2
    assert np.flatnonzero(found.recordings.is_detected).tolist() == [2, 9]


def test_targets_of_a_log_are_one_episode_where_they_are_to_be_drawn_together(tmp_path: Path) -> None:
    data = tmp_path / "logs"
    data.mkdir()
    for name in ("a", "b"):
        write_log(data / f"{name}.mcap", pair())
    write_log(data / "late.mcap", pair(start=1))
    write_log(data / "more.mcap", pair(num_targets=3))
    found = load(data, together=True)
    assert found.names == ("a/T0", "a/T1", "b/T0", "b/T1") and found.recordings.num_episodes == 2
    late, more = found.left_out
    assert "late.mcap: its 2 targets have truth at different steps" in late
    assert "more.mcap: has 3 targets, the logs before it 2" in more
    assert load(data).recordings.num_episodes == 2 + 2 + 2 + 3


@pytest.mark.parametrize(
    ("make", "reason"),
    [
        (lambda path: path.write_bytes(b"not a log"), "not an MCAP file"),
        (lambda path: write_log(path, [row for row in walk(6, (1,)) if row.topic != "/truth/fugitive"]), "has no truth"),
        (lambda path: write_log(path, walk(6, (1, 2), off_m=30.0)), "2 of 2 detections lie more than 1 m from the truth"),
        (lambda path: write_log(path, [*walk(3, (1,)), pose(1000.0, 0.0, 0.0, "/truth/fugitive")]), "truth has a gap of 880 s"),
        (lambda path: with_record(path, walk(6, (1,)), {"step_s": "30"}), "a step of 30 s"),
    ],
)  # fmt: skip
def test_a_faulty_log_is_named_and_left_out(folder: Path, make, reason: str, capsys: pytest.CaptureFixture[str]) -> None:
    make(folder / "faulty.mcap")
    found = load(folder)
    assert found.names == ("a", "b") and len(found.left_out) == 1
    assert "faulty.mcap" in found.left_out[0] and reason in found.left_out[0]
    assert "left out: " in capsys.readouterr().err


def test_where_no_log_can_be_used_the_first_reason_is_given(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="not a folder"):
        load(tmp_path / "nowhere")
    with pytest.raises(InputError, match="holds no log"):
        load(tmp_path)
    write_log(tmp_path / "a.mcap", [detection(0.0, 0.0, 0.0), detection(60.0, 0.0, 0.0)])
    write_log(tmp_path / "b.mcap", [detection(0.0, 0.0, 0.0), detection(60.0, 0.0, 0.0)])
    with pytest.raises(InputError, match=r"a\.mcap: has no truth.*2 logs could not be used"):
        load(tmp_path)


def test_files_of_episodes_are_whole_or_refused(folder: Path) -> None:
    rec = load(folder).recordings
    path = folder / "kept.npz"
    save_recordings(path, rec, scale_m=7.0)
    again, more = read_recordings(path)
    for name, value in vars(rec).items():
        assert np.array_equal(getattr(again, name), value, equal_nan=True)
    assert more == {"scale_m": 7.0} and load(path).scale_m == 7.0 and load(path).names == ("kept-00000", "kept-00001")
    data = path.read_bytes()
    for damaged in (b"", data[: len(data) // 2], data[:200] + b"\0" * 64 + data[264:], b"PK" + data[4:]):
        path.write_bytes(damaged)
        with pytest.raises(InputError, match=r"kept\.npz"):
            read_recordings(path)


def test_a_killed_simulation_goes_on_where_it_was(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    made: list[list[int]] = []

    def simulate(indices) -> Recordings:
        made.append(list(indices))
        length = np.array([3 + index % 4 for index in indices])
        offset = np.concatenate([[0], np.cumsum(length)])
        place = np.repeat(np.asarray(indices, dtype=np.float32), length)[:, None] * np.ones((1, 2), np.float32)
        seen, none = np.ones(len(place), dtype=bool), np.zeros((len(place), 0, 2), np.float32)
        return Recordings(60.0, offset, place, seen, none, np.full((len(length), 2), np.nan, np.float32))

    world = recordings_module._World("settings", simulate, load_obstacles(), 5.0)
    monkeypatch.setattr(recordings_module, "_world", lambda config: world)
    monkeypatch.setattr(recordings_module, "config_as_dict", lambda config: {"settings": str(config)})
    monkeypatch.setattr(recordings_module, "BLOCK", 10)
    config = RecordingsConfig(first_index=5, num_episodes=20)
    whole = load_recordings(config, tmp_path, QUIET)
    assert whole.recordings.position_m[whole.recordings.offset[:-1], 0].tolist() == list(range(5, 25))
    assert [len(block) for block in made] == [4, 5, 10, 5]
    sorted((tmp_path / "worlds").glob("*.npz"))[1].unlink()
    made.clear()
    again = load_recordings(config, tmp_path, QUIET)
    assert [len(block) for block in made] == [4, 10]
    assert np.array_equal(again.recordings.position_m, whole.recordings.position_m)
    made.clear()
    some = load_recordings(dataclasses.replace(config, first_index=12, num_episodes=3), tmp_path, QUIET)
    assert [len(block) for block in made] == [4] and some.names[0] == "prison-low-0-0012"
    assert some.recordings.position_m[some.recordings.offset[:-1], 0].tolist() == [12, 13, 14]


def load_obstacles():
    return recordings_module.Obstacles.none()


@pytest.mark.parametrize("wrong", [{"num_episodes": 0}, {"world": "narco", "set": "med"}, {"step_s": 0.0}, {"world": "moon"}])
def test_settings_that_cannot_be_are_refused(wrong: dict[str, object]) -> None:
    with pytest.raises(ConfigError):
        read_config(RecordingsConfig, wrong)


def test_the_original_simulators_logs(shared_data: Path, tmp_path: Path) -> None:
    folder = shared_data / "prison_reference" / "low"
    found = load_recordings(RecordingsConfig(data=folder, pattern="p_low_000[0-3].mcap"), tmp_path, QUIET)
    rec = found.recordings
    assert len(found.names) == 4 and rec.tracker_m.shape[1] == 6 and found.scale_m == 50_988.0
    pace = np.median(np.hypot(*np.diff(rec.tracker_m[: rec.offset[1]], axis=0).T), axis=1) / 21.0
    assert pace[0] > 20 and (pace[1:] < 8).all()
