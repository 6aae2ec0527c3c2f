"""Positions read many at once: the same rows, in the same order, and the same counts as from messages one by one."""

import io
from collections import Counter
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fixtures.ros_messages import Builder, store_with
from hypothesis import given
from hypothesis import strategies as st
from mcap.writer import Writer

from cadence.errors import ConfigError, InputError
from pipeline.extract.channel_reader import ChannelReader
from pipeline.extract.covariances import stated_covariance, stated_covariances
from pipeline.extract.positions import Positions
from pipeline.extract.reading import read_positions
from pipeline.logs import cdr_fields
from pipeline.logs.decode import UndecodableChannel
from pipeline.logs.reader import MissionLog, open_log, open_parts
from pipeline.mapping.sources import SourceConfig
from pipeline.progress import Progress

ROS = Builder(store_with())
ODOMETRY = "nav_msgs/msg/Odometry"
FIX = "sensor_msgs/msg/NavSatFix"
VALUES = st.sampled_from([0.0, 1.0, -2.5, 4.0, 1e-200, 1e200, np.nan, np.inf, -np.inf])
MATRICES = {size: st.lists(VALUES, min_size=size, max_size=size) for size in (4, 6, 9, 36)}


def odometry(x: float, stamp_ns: int = 5, frame: str = "map", covariance: Any = None) -> bytes:
    pose = ROS.uncertain_pose()
    pose.pose.position.x = x
    if covariance is not None:
        pose.covariance = np.array(covariance, np.float64)
    message = ROS(ODOMETRY, header=ROS.header(frame, stamp_ns), child_frame_id="base", pose=pose)
    return bytes(ROS.store.serialize_cdr(message, ODOMETRY))


def fix(latitude: float, status: int, kind: int) -> bytes:
    message = ROS(
        FIX, header=ROS.header("gps"), status=ROS("sensor_msgs/msg/NavSatStatus", status=status, service=1),
        latitude=latitude, longitude=-1.25, altitude=7.0, position_covariance=np.array([4.0, 1, 0, 1, 9, 0, 0, 0, 16]),
        position_covariance_type=kind,
    )  # fmt: skip
    return bytes(ROS.store.serialize_cdr(message, FIX))


def write(path: Path, name: str, messages: list[tuple[int, bytes]], chunk_size: int = 2**20) -> Path:
    """Messages by log time and data; a chunk is closed when it has `chunk_size` bytes."""
    file = io.BytesIO()
    writer = Writer(file, chunk_size=chunk_size)
    writer.start()
    text = ROS.store.generate_msgdef(name, ros_version=2)[0]
    channel = writer.register_channel("/seen", "cdr", writer.register_schema(name, "ros2msg", text.encode()))
    for i, (time_ns, data) in enumerate(messages):
        writer.add_message(channel, time_ns, data, time_ns + 1, i)
    writer.finish()
    path.write_bytes(file.getvalue())
    return path


def read(log: MissionLog, **source: Any) -> tuple[list[Positions], Counter[str]]:
    """The rows of two readers of the one channel."""
    stated = [SourceConfig("/seen", **source), SourceConfig("/seen", time="publish_time", agent="own")]
    readers = [
        ChannelReader(log.channels[0], each, role, True, {}) for each, role in zip(stated, ("detections", "truth"), strict=True)
    ]
    counts = read_positions(log, readers, Progress(quiet=True))
    return [reader.finish() for reader in readers], counts


def assert_same(log: MissionLog, monkeypatch: pytest.MonkeyPatch, **source: Any) -> tuple[list[Positions], Counter[str]]:
    """Both ways agree to the bit."""
    rows, counts = read(log, **source)
    with monkeypatch.context() as patch:
        patch.setattr(ChannelReader, "field_columns", refused)
        others, other_counts = read(log, **source)
    assert counts == other_counts
    for mine, other in zip(rows, others, strict=True):
        for item in fields(Positions):
            one, two = getattr(mine, item.name), getattr(other, item.name)
            assert one.dtype == two.dtype and one.shape == two.shape, item.name
            assert one.tolist() == two.tolist() if one.dtype == object else one.tobytes() == two.tobytes(), item.name
    return rows, counts


def refused(self: ChannelReader) -> Any:
    raise UndecodableChannel("one by one")


@pytest.fixture
def no_decoding(monkeypatch: pytest.MonkeyPatch) -> None:
    """Messages must not be decoded one by one."""

    def fail(self: ChannelReader, *_: Any) -> None:
        raise AssertionError("was decoded by itself")

    monkeypatch.setattr(ChannelReader, "read", fail)


def test_a_flood_is_refused_before_it_is_read_or_as_soon_as_it_comes(tmp_path: Path) -> None:
    log = open_log(write(tmp_path / "a.mcap", ODOMETRY, [(i, odometry(i)) for i in range(2500)], chunk_size=20_000))
    reader = ChannelReader(log.channels[0], SourceConfig("/seen"), "detections", True, {})
    with pytest.raises(InputError, match=r"^/seen: 2500 detections or more, over extract.max_detections = 2000; take a part"):
        read_positions(log, [reader], Progress(quiet=True), max_detections=2000)
    assert not reader.rows.agents
    with pytest.raises(InputError, match=r"--start and --end or --topic"):
        read_positions(log, [reader], Progress(quiet=True), start_ns=0, max_detections=1000)
    assert 1000 < len(reader.rows.agents) < 2500
    fresh = ChannelReader(log.channels[0], SourceConfig("/seen"), "detections", True, {})
    read_positions(log, [fresh], Progress(quiet=True), start_ns=0, end_ns=900, max_detections=1000)
    assert len(fresh.rows.agents) == 900


def test_sound_messages_are_not_decoded_one_by_one(tmp_path: Path, no_decoding: None) -> None:
    messages = [(i, odometry(i, stamp_ns=100 + i)) for i in range(2500)]
    (rows, truth), counts = read(open_log(write(tmp_path / "a.mcap", ODOMETRY, messages)))
    assert rows.first.tolist() == list(range(2500)) and rows.time_ns.tolist() == list(range(100, 2600))
    assert truth.time_ns.tolist() == list(range(1, 2501)) and set(truth.agent) == {"own"} and set(rows.frame_id) == {"map"}
    assert rows.covariance_m2[7].tolist() == [4, 1, 9] and counts["messages"] == 5000 and counts["undecodable"] == 0


def test_what_is_odd_is_read_as_before(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Cut, padded, too long, of another byte order, with strings that are none: nine of these cannot be decoded."""
    good = odometry(1.0)
    place = good.index(b"map\0")
    odd = [
        good, good[:-1], good[:30], b"", good + b"\0\0\0", good + b"\0\0\0\0", b"\0\0" + good[2:], b"\0\3" + good[2:],
        b"\1\1" + good[2:], good[:place] + b"\xff" + good[place + 1 :], good[: place + 3] + b"x" + good[place + 4 :],
        odometry(np.nan), odometry(2.0, stamp_ns=0), odometry(3.0, frame="/odom"), odometry(4.0, frame=""),
    ]  # fmt: skip
    for number, data in enumerate(odd):
        log = open_log(write(tmp_path / f"{number}.mcap", ODOMETRY, [(1, good), (2, data), (3, good)]))
        (rows, _), counts = assert_same(log, monkeypatch)
        assert len(rows) + counts["undecodable"] == 3 and rows.log_time_ns[0] == 1
    log = open_log(write(tmp_path / "all.mcap", ODOMETRY, [(i, data) for i, data in enumerate(odd * 90)]))
    (rows, _), counts = assert_same(log, monkeypatch)
    assert counts["undecodable"] == 90 * 9 and len(rows) == 90 * (len(odd) - 9)


@given(data=st.data())
def test_flipped_bits(data: st.DataObject, tmp_path_factory: pytest.TempPathFactory) -> None:
    damaged = bytearray(odometry(1.0))
    bit = data.draw(st.integers(0, 8 * len(damaged) - 1))
    damaged[bit // 8] ^= 1 << bit % 8
    path = tmp_path_factory.mktemp("bits") / "a.mcap"
    log = open_log(write(path, ODOMETRY, [(1, odometry(0.0)), (2, bytes(damaged)), (3, odometry(2.0))]))
    with pytest.MonkeyPatch.context() as monkeypatch:
        assert_same(log, monkeypatch)


def test_overlapping_chunks_and_parts_keep_the_order(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Rows come by log time, those of one time in the order of the files and of their messages."""
    generator = np.random.default_rng(3)
    paths = []
    for part in range(2):
        times = generator.integers(0, 40, 300).tolist()
        messages = [
            (time_ns, odometry(1000 * part + i, stamp_ns=int(generator.integers(1, 99)))) for i, time_ns in enumerate(times)
        ]
        paths.append(write(tmp_path / f"log_{part}.mcap", ODOMETRY, messages, chunk_size=4000))
    for log in (open_log(paths[0]), open_parts(paths)):
        (rows, _), _ = assert_same(log, monkeypatch)
        keys = list(zip(rows.log_time_ns.tolist(), rows.first.tolist(), strict=True))
        assert keys == sorted(keys) and len(keys) in (300, 600)


def test_fixes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    messages = [(i, fix(50.0 + i, status, kind)) for i, (status, kind) in enumerate([(0, 2), (-1, 2), (1, 0), (0, 1), (-1, 0)])]
    (rows, _), counts = assert_same(open_log(write(tmp_path / "a.mcap", FIX, messages)), monkeypatch, sigma_m=3.0)
    assert rows.first.tolist() == [50.0, 52.0, 53.0] and rows.is_geodetic.all() and counts["no_fix"] == 4
    assert rows.covariance_m2.tolist() == [[4, 1, 9], [9, 0, 9], [4, 1, 9]]


@given(matrices=st.lists(MATRICES[36], min_size=1, max_size=4))
def test_covariances_in_messages(matrices: list[list[float]], tmp_path_factory: pytest.TempPathFactory) -> None:
    path = tmp_path_factory.mktemp("covariances") / "a.mcap"
    messages = [(i, odometry(i, covariance=matrix)) for i, matrix in enumerate(matrices)]
    with pytest.MonkeyPatch.context() as monkeypatch:
        assert_same(open_log(write(path, ODOMETRY, messages)), monkeypatch, sigma_m=2.0)


@pytest.mark.parametrize("size", MATRICES)
@given(data=st.data())
def test_covariances_at_once(size: int, data: st.DataObject) -> None:
    matrices = data.draw(st.lists(MATRICES[size], min_size=1, max_size=5))
    found, is_stated, is_bad = stated_covariances(np.array(matrices))
    for i, matrix in enumerate(matrices):
        try:
            wanted = stated_covariance(matrix)
        except ValueError:
            assert is_bad[i] and not is_stated[i]
            continue
        assert not is_bad[i] and is_stated[i] == (wanted is not None)
        assert wanted is None or np.array(wanted).tobytes() == found[i].tobytes()


@pytest.mark.parametrize(
    "source",
    [
        {"agent_path": "child_frame_id", "sensor_path": "header.frame_id"},
        {"agent_path": "header.stamp.sec", "score": "pose.pose.position.z"},
        {"x": "pose.pose.position.x", "y": "pose.pose.position.y", "time": "header.stamp.nanosec"},
        {"time": "log_time", "frame_id": "child_frame_id"},
        {"x": "pose.pose.position.x.@mul(2)", "y": "pose.pose.position.y"},
        {"x": "pose.covariance[0]", "y": "pose.pose.position.y", "covariance": "pose.covariance"},
    ],
)
def test_stated_paths(source: dict[str, str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    messages = [(i, odometry(i, frame=f"f{i % 3}", stamp_ns=i * 10**9 // 3)) for i in range(20)]
    (rows, _), _ = assert_same(open_log(write(tmp_path / "a.mcap", ODOMETRY, messages)), monkeypatch, **source)
    assert len(rows) == 20


@pytest.mark.parametrize(
    ("where", "expected"),
    [
        ("position_covariance_type >= 1 && status.status == 0", [50.0, 53.0]),
        ("status.service & 1", [50.0, 51.0, 52.0, 53.0, 54.0]),
        ('header.frame_id == "gps"', [50.0, 51.0, 52.0, 53.0, 54.0]),
        ("latitude > 52.5", [53.0, 54.0]),
        ("position_covariance_type == COVARIANCE_TYPE_KNOWN", []),
        ("", [50.0, 51.0, 52.0, 53.0, 54.0]),  # not even the type's
    ],
)
def test_conditions(where: str, expected: list[float], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    messages = [(i, fix(50.0 + i, status, kind)) for i, (status, kind) in enumerate([(0, 2), (-1, 2), (1, 0), (0, 1), (-1, 0)])]
    log = open_log(write(tmp_path / "a.mcap", FIX, messages))
    (rows, _), counts = assert_same(log, monkeypatch, where=where)
    assert rows.first.tolist() == expected and counts["unmet"] == 5 - len(expected)
    assert counts["no_fix"] == 2  # of the other reader, which has the type's


def test_standard_deviations(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    messages = [(i, odometry(i, covariance=[9.0 * (i % 2), *[0.0] * 6, 9.0 * (i % 2), *[0.0] * 28])) for i in range(-2, 3)]
    log = open_log(write(tmp_path / "a.mcap", ODOMETRY, [(i + 5, data) for i, data in messages]))
    (rows, _), _ = assert_same(log, monkeypatch, sigma="pose.pose.position.x", sigma_m=5.0)
    assert rows.covariance_m2[:, 0].tolist() == [25.0, 9.0, 25.0, 9.0, 4.0]  # stated, else sigma where it is one, else sigma_m


def test_condition_whose_field_no_message_has(tmp_path: Path) -> None:
    log = open_log(write(tmp_path / "a.mcap", ODOMETRY, [(1, odometry(1.0))]))
    with pytest.raises(
        ConfigError, match=r"no message has path 'pose.valid': no field 'valid'; fields there: pose, covariance"
    ):
        read(log, where="pose.valid && pose.pose.position.x > 0")


def test_path_that_no_message_has_is_named_as_before(tmp_path: Path) -> None:
    log = open_log(write(tmp_path / "a.mcap", ODOMETRY, [(1, odometry(1.0))]))
    with pytest.raises(Exception, match=r"no message has path 'pose.score': no field 'score'; fields there: pose, covariance"):
        read(log, score="pose.score")


def test_types_with_lists_of_structures_are_read_one_by_one(tmp_path: Path) -> None:
    name = "geometry_msgs/msg/PoseArray"
    message = ROS(name, header=ROS.header(), poses=[ROS.pose(), ROS.pose()])
    (rows, _), _ = read(open_log(write(tmp_path / "a.mcap", name, [(1, bytes(ROS.store.serialize_cdr(message, name)))])))
    assert len(rows) == 2


def test_whole_messages_are_walked_to_their_ends(tmp_path: Path) -> None:
    good = odometry(1.0)
    log = open_log(
        write(tmp_path / "a.mcap", ODOMETRY, [(1, good), (2, good[:-8]), (3, good + bytes(4)), (4, good + bytes(3))])
    )
    (batch,) = log.batches()
    fields = [cdr_fields.CdrFields(log.channels[0], ["pose.pose.position.x"], is_whole) for is_whole in (False, True)]
    assert [reader.columns(batch)[0].tolist() for reader in fields] == [[True] * 4, [True, False, False, True]]
