"""Simulated logs: whole or absent, the same bytes for the same settings, readable with the stock reader, resumable."""

import dataclasses
import functools
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.writer import Writer
from mcap_protobuf.decoder import DecoderFactory as ProtobufFactory
from mcap_ros2.decoder import DecoderFactory as RosFactory

from cadence.errors import ConfigError, DeviceError
from cadence.recordings import Recordings
from cadence.worlds.episode import Episode
from cadence.worlds.narco import NarcoConfig, simulate_narco
from cadence.worlds.patrol import PatrolConfig, simulate_patrol
from cadence.worlds.prison import PrisonConfig, simulate_prison, simulate_prison_batch
from pipeline.config import read_config
from pipeline.episodes.recordings import RecordingsConfig, load_recordings
from pipeline.logs.reader import open_log
from pipeline.manifest import read_manifest
from pipeline.mapping.guess import suggest_mapping
from pipeline.progress import Progress
from pipeline.simulate.stage import SimulateConfig, simulate

QUIET = Progress(quiet=True)
SHORT = SimulateConfig(seed=6, patrol=PatrolConfig(duration_s=1200.0, detection_rate=0.3))


def short(config: SimulateConfig = SHORT, **changes: Any) -> SimulateConfig:
    """With other settings of the world patrol."""
    return dataclasses.replace(config, patrol=dataclasses.replace(config.patrol, **changes))


def decoded(path: Path) -> Iterator[tuple[str, int, Any]]:
    """Topic, log time and message of everything in a log, with the stock reader and CRCs on; JSON as a dict."""
    with path.open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        factories = (ProtobufFactory(), RosFactory())
        for schema, channel, message in reader.iter_messages():
            if channel.message_encoding == "json":
                yield channel.topic, message.log_time, json.loads(message.data)
            else:
                decoders = (factory.decoder_for(channel.message_encoding, schema) for factory in factories)
                decode = next(decoder for decoder in decoders if decoder is not None)
                yield channel.topic, message.log_time, decode(message.data)


def position(message: Any) -> tuple[float, float]:
    """x and y (or longitude and latitude) of any form's message."""
    if isinstance(message, dict):
        if "latitude" in message:
            return message["longitude"], message["latitude"]
        point = message["position"] if "position" in message else message["pose"]["position"]
        return point["x"], point["y"]
    if hasattr(message, "latitude"):
        return message.longitude, message.latitude
    pose = message.pose.pose if hasattr(message.pose, "pose") else message.pose
    return pose.position.x, pose.position.y


def expected(config: SimulateConfig, index: int = 0) -> Episode:
    """The episode that a log must hold."""
    return simulate_patrol(config.patrol, np.random.default_rng([config.seed, index]))


def metadata(path: Path) -> dict[str, dict[str, str]]:
    return dict(open_log(path).metadata())


def test_a_log_holds_its_episode(tmp_path: Path) -> None:
    result = simulate(tmp_path, SHORT, QUIET)
    (path,) = result.outputs
    episode = expected(SHORT)
    rows = list(decoded(path))
    truth = np.array([position(m) for topic, _, m in rows if topic == "/truth/smuggler_1"])
    np.testing.assert_allclose(truth, episode.truth_m[0], atol=6e-4)
    boat = np.array([position(m) for topic, _, m in rows if topic == "/sensors/boat_1/pose"])
    np.testing.assert_allclose(boat, episode.sensors_m[0], atol=6e-4)
    detections = [(time_ns, m) for topic, time_ns, m in rows if topic == "/detections"]
    seen = episode.detections
    assert len(detections) == len(seen) > 0
    np.testing.assert_allclose([position(m) for _, m in detections], seen.position_m, atol=6e-4)
    covariance = np.array([m["position_covariance"] for _, m in detections]).reshape(-1, 3, 3)[:, :2, :2]
    np.testing.assert_allclose(covariance, seen.covariance_m2, atol=6e-4)
    assert [m["sensor_id"] for _, m in detections] == [episode.sensor_ids[sensor] for sensor in seen.sensor]
    assert [time_ns for time_ns, _ in detections] == (1700000000 * 10**9 + seen.step * 10**10).tolist()
    assert [time_ns for _, time_ns, _ in rows] == sorted(time_ns for _, time_ns, _ in rows)


def test_counts_agree_with_the_statistics(tmp_path: Path) -> None:
    (path,) = simulate(tmp_path, SHORT, QUIET).outputs
    with path.open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None and summary.statistics is not None
    topics = [topic for topic, _, _ in decoded(path)]
    assert summary.statistics.message_count == len(topics)
    counts = {summary.channels[i].topic: n for i, n in summary.statistics.channel_message_counts.items()}
    assert counts == {topic: topics.count(topic) for topic in set(topics)}
    assert counts["/scene/obstacles"] == 21  # once a minute


def test_metadata_tells_how_the_log_came_about(tmp_path: Path) -> None:
    (path,) = simulate(tmp_path, short(num_agents=2), QUIET).outputs
    mission = {key: json.loads(value) for key, value in metadata(path)["mission"].items()}
    assert mission["world"] == "patrol" and mission["seed"] == 6 and mission["step_s"] == 10.0
    assert mission["agents"] == ["smuggler_1", "smuggler_2"]
    episode = expected(short(num_agents=2))
    assert mission["measured_detection_rate"] == pytest.approx(episode.is_detected().mean(), abs=1e-6)


def test_obstacles_are_those_of_the_terrain(tmp_path: Path) -> None:
    (path,) = simulate(tmp_path, SHORT, QUIET).outputs
    obstacles = json.loads(metadata(path)["cadence.obstacles"]["obstacles"])
    terrain = expected(SHORT).terrain
    rings = [o["rings_m"] for o in obstacles if o["kind"] == "polygon"]
    assert len(rings) == len(terrain.polygons_m)
    for (ring,), polygon in zip(rings, terrain.polygons_m, strict=True):
        assert ring[0] == ring[-1]
        np.testing.assert_allclose(ring[:-1], polygon, atol=6e-4)
    circles = [[o["x_m"], o["y_m"], o["radius_m"]] for o in obstacles if o["kind"] == "circle"]
    np.testing.assert_allclose(circles, terrain.circles_m, atol=6e-4)
    scene = next(message for topic, _, message in decoded(path) if topic == "/scene/obstacles")
    assert len(scene.entities) == len(obstacles)


@pytest.mark.parametrize("georeferenced", [False, True])
@pytest.mark.parametrize("encoding", ["protobuf", "json", "cdr"])
def test_every_form_says_the_same(tmp_path: Path, encoding: Any, georeferenced: bool) -> None:
    config = dataclasses.replace(SHORT, encoding=encoding, georeferenced=georeferenced, latitude_deg=50.0, longitude_deg=-2.0)
    (path,) = simulate(tmp_path, config, QUIET).outputs
    rows = list(decoded(path))
    truth = np.array([position(m) for topic, _, m in rows if topic == "/truth/smuggler_1"])
    found = np.array([position(m) for topic, _, m in rows if topic.startswith("/detections")])
    if georeferenced:
        # Metres per degree on WGS 84 at 50 degrees: 71 696 (longitude), 111 229 (latitude); good to 0.5 % over 15 km.
        scale, datum, error = np.array([71696.0, 111229.0]), [-2.0, 50.0], 100.0
    else:
        scale, datum, error = np.ones(2), [0.0, 0.0], 1e-3
    episode = expected(config)
    np.testing.assert_allclose((truth - datum) * scale, episode.truth_m[0], atol=error)
    np.testing.assert_allclose((found - datum) * scale, episode.detections.position_m, atol=error)


@pytest.mark.parametrize("georeferenced", [False, True])
@pytest.mark.parametrize("encoding", ["protobuf", "json", "cdr"])
def test_the_mapping_finds_everything_unaided(tmp_path: Path, encoding: Any, georeferenced: bool) -> None:
    config = dataclasses.replace(short(num_agents=2, duration_s=300.0), encoding=encoding, georeferenced=georeferenced)
    (path,) = simulate(tmp_path, config, QUIET).outputs
    mapping = suggest_mapping(open_log(path).channels)
    is_named = not georeferenced and encoding != "cdr"
    assert [source.topic for source in mapping.detections] == ["/detections" if is_named else "/detections/{agent}"]
    assert [source.topic for source in mapping.truth] == ["/truth/{agent}"]
    assert [source.topic for source in mapping.poses] == ["/sensors/{sensor}/pose"]


def test_the_same_settings_give_the_same_bytes(tmp_path: Path) -> None:
    first = simulate(tmp_path / "a", dataclasses.replace(SHORT, num_episodes=2), QUIET).outputs
    second = simulate(tmp_path / "b", dataclasses.replace(SHORT, first_index=1), QUIET).outputs
    assert first[1].name == second[0].name == "patrol-6-0001.mcap"
    assert first[1].read_bytes() == second[0].read_bytes()
    assert first[0].read_bytes() != first[1].read_bytes()


def test_finished_episodes_are_left_alone(tmp_path: Path) -> None:
    config = dataclasses.replace(SHORT, num_episodes=3)
    first = simulate(tmp_path, dataclasses.replace(config, num_episodes=2), QUIET)
    before = [path.stat().st_mtime_ns for path in first.outputs]
    more = simulate(tmp_path, config, QUIET)
    assert more.status == "done" and more.summary["num_written"] == 1
    assert [path.stat().st_mtime_ns for path in more.outputs[:2]] == before
    again = simulate(tmp_path, config, QUIET)
    assert again.status == "skipped" and again.summary == {**more.summary, "num_written": 0}
    assert simulate(tmp_path, config, QUIET, force=True).summary["num_written"] == 3
    other = simulate(tmp_path, short(config, detection_rate=0.1), QUIET)
    assert other.summary["num_written"] == 3


def test_a_killed_call_goes_on_where_it_was(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    config = dataclasses.replace(SHORT, num_episodes=3)
    whole = [path.read_bytes() for path in simulate(tmp_path / "whole", config, QUIET).outputs]
    finish, calls = Writer.finish, []

    def killed(self: Writer) -> None:
        calls.append(self)
        if len(calls) == 2:
            raise KeyboardInterrupt
        finish(self)

    out = tmp_path / "cut"
    monkeypatch.setattr(Writer, "finish", killed)
    with pytest.raises(KeyboardInterrupt):
        simulate(out, config, QUIET)
    assert [path.name for path in out.iterdir()] == ["patrol-6-0000.mcap"]
    left = out / ".patrol-6-0001.mcap.0123abcd"
    left.mkdir()
    (left / "patrol-6-0001.mcap").write_bytes(b"from a call that had no time to clean up")
    monkeypatch.undo()
    result = simulate(out, config, QUIET)
    assert result.summary["num_written"] == 2
    assert [path.read_bytes() for path in result.outputs] == whole
    assert not list(out.glob(".*"))


def test_a_damaged_episode_is_written_again(tmp_path: Path) -> None:
    (path,) = simulate(tmp_path, SHORT, QUIET).outputs
    whole = path.read_bytes()
    damages = (whole[: len(whole) // 2], bytes([*whole[:9000], whole[9000] ^ 4, *whole[9001:]]), b"")
    for damage in damages:
        path.write_bytes(damage)
        assert simulate(tmp_path, SHORT, QUIET).summary["num_written"] == 1
        assert path.read_bytes() == whole


def test_the_manifest_repeats_the_run(tmp_path: Path) -> None:
    config = dataclasses.replace(SHORT, num_episodes=2)
    result = simulate(tmp_path / "a", config, QUIET)
    manifest = read_manifest("simulate", tmp_path / "a")
    assert manifest is not None
    assert list(manifest["outputs"]) == [path.name for path in result.outputs]
    repeated = read_config(SimulateConfig, manifest["config"])
    assert repeated == config
    simulate(tmp_path / "b", repeated, QUIET)
    assert read_manifest("simulate", tmp_path / "b") == manifest


def test_an_unwritable_folder_is_one_line(tmp_path: Path) -> None:
    blocked = tmp_path / "file"
    blocked.write_text("")
    with pytest.raises(DeviceError, match=r"file: cannot write there .* choose another --out"):
        simulate(blocked, SHORT, QUIET)


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("num_episodes", 0),
        ("seed", -1),
        ("latitude_deg", 95.0),
        ("patrol", {"detection_rate": 0.9}),
        ("prison", {"set": "mid"}),
        ("prison", {"factor": -1.0}),
        ("narco", {"set": "med"}),
        ("world", "mars"),
        ("encoding", "xml"),
    ],
)
def test_impossible_settings_are_one_line(key: str, value: Any) -> None:
    with pytest.raises(ConfigError) as caught:
        read_config(SimulateConfig, {key: value}, "simulate")
    assert "\n" not in str(caught.value)


PRISON = SimulateConfig(world="prison", seed=4, prison=PrisonConfig("med"))


@functools.cache
def prison_episode() -> Episode:
    """What the log of `PRISON` must hold."""
    return simulate_prison(PRISON.prison, 4, 0)


@functools.cache
def low_prison() -> Recordings:
    """What logs of the second episode of the set `low` must hold, in whatever form."""
    return simulate_prison_batch(PrisonConfig("low"), 4, np.array([1]))


@pytest.fixture(scope="module")
def prison_log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    (path,) = simulate(tmp_path_factory.mktemp("prison"), PRISON, QUIET).outputs
    return path


def test_a_log_of_the_prison_holds_its_episode(prison_log: Path) -> None:
    episode = prison_episode()
    rows = list(decoded(prison_log))
    truth = np.array([position(m) for topic, _, m in rows if topic == "/truth/fugitive"])
    np.testing.assert_array_equal(truth, episode.truth_m[0])
    detections = [m for topic, _, m in rows if topic == "/detections"]
    assert len(detections) == len(episode.detections) > 0
    assert [m["sensor_id"] for m in detections] == [episode.sensor_ids[sensor] for sensor in episode.detections.sensor]
    poses = [[(p.position.x, p.position.y) for p in m.poses] for topic, _, m in rows if topic == "/trackers"]
    np.testing.assert_array_equal(poses, np.moveaxis(episode.sensors_m[-6:], 0, 1))
    assert {topic for topic, _, _ in rows} == {"/truth/fugitive", "/detections", "/trackers", "/scene/obstacles"}


def test_the_prison_log_has_the_metadata_of_the_original_logs(prison_log: Path) -> None:
    assert prison_log.name == "prison-med-4-0000.mcap"
    mission = {key: json.loads(value) for key, value in metadata(prison_log)["mission"].items()}
    assert (mission["scenario"], mission["step_s"], mission["cell_m"], mission["map_side_m"]) == (
        "prison_escape",
        60,
        21,
        50988,
    )
    assert mission["mountains"] == [{"x_m": 33600.0, "y_m": 37800.0, "keep_out_radius_m": 2940.0}]
    episode = prison_episode()
    assert np.shape(mission["hideout_known_to_trackers"]) == (1, 2) and np.shape(mission["cameras"]) == (78, 2)
    np.testing.assert_array_equal(mission["cameras"], episode.sensors_m[:78, 0])
    assert mission["detection_factor"] == PRISON.prison.detection_factor


@pytest.mark.parametrize("encoding", ["protobuf", "json", "cdr"])
def test_logs_of_the_prison_are_read_as_the_episodes_they_hold(tmp_path: Path, encoding: Any) -> None:
    config = dataclasses.replace(PRISON, encoding=encoding, prison=PrisonConfig("low"), first_index=1)
    simulate(tmp_path / "logs", config, QUIET)
    found = load_recordings(RecordingsConfig(data=tmp_path / "logs"), tmp_path / "cache", QUIET)
    made = low_prison()
    for name in ("position_m", "is_detected", "tracker_m", "known_goal_m"):
        np.testing.assert_allclose(getattr(found.recordings, name), getattr(made, name), atol=0.01, err_msg=name)
    assert found.scale_m == 50988.0 and len(found.obstacles[0].circles) == 1


def test_a_log_of_narco_holds_its_episode(tmp_path: Path) -> None:
    config = SimulateConfig(world="narco", seed=2, narco=NarcoConfig("high"))
    (path,) = simulate(tmp_path, config, QUIET).outputs
    episode = simulate_narco(config.narco, 2, 0)
    rows = list(decoded(path))
    truth = np.array([position(m) for topic, _, m in rows if topic == "/truth/smuggler"])
    np.testing.assert_allclose(truth, episode.truth_m[0], atol=6e-4)
    poses = [[(p.position.x, p.position.y) for p in m.poses] for topic, _, m in rows if topic == "/trackers"]
    np.testing.assert_allclose(poses, np.moveaxis(episode.sensors_m, 0, 1), atol=6e-4)
    assert path.name == "narco-high-2-0000.mcap"
    assert json.loads(metadata(path)["mission"]["scenario"]) == "smuggler"


def test_settings_of_other_worlds_change_nothing(tmp_path: Path) -> None:
    simulate(tmp_path, SHORT, QUIET)
    other = dataclasses.replace(SHORT, prison=PrisonConfig("high"))
    assert simulate(tmp_path, other, QUIET).summary["num_written"] == 0


def test_episodes_simulated_together_are_those_simulated_alone(tmp_path: Path) -> None:
    several = simulate(tmp_path / "a", dataclasses.replace(PRISON, num_episodes=2), QUIET).outputs
    alone = simulate(tmp_path / "b", dataclasses.replace(PRISON, first_index=1), QUIET).outputs
    assert several[1].read_bytes() == alone[0].read_bytes()
