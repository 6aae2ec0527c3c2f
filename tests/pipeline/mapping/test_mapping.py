"""Sources as configured, and what the names of topics suggest."""

import tomllib
from dataclasses import dataclass

import pytest

from cadence.errors import ConfigError
from pipeline.config import read_config
from pipeline.extract.config import ExtractConfig
from pipeline.mapping.guess import SuggestedMapping, dense_sources, suggest_mapping
from pipeline.mapping.sources import SourceConfig, resolve_paths


@dataclass(frozen=True)
class FakeChannel:
    topic: str
    schema_name: str
    schema_data: bytes = b"{}"
    message_count: int | None = 5


def suggest(*channels: tuple[str, str]) -> SuggestedMapping:
    return suggest_mapping([FakeChannel(topic, schema) for topic, schema in channels])


FIX = "foxglove.LocationFix"
POSE = "geometry_msgs/msg/PoseStamped"
SCENE = "foxglove.SceneUpdate"


def test_roles() -> None:
    expected = {
        "/truth/T0": (FIX, "truth"),
        "/ground_truth/pose": (POSE, "truth"),
        "/groundTruth/T1": (POSE, "truth"),
        "/truth/target/pose": (POSE, "truth"),
        "/contacts/A": (FIX, "detections"),
        "/radar/tracks": ("vision_msgs/msg/Detection3DArray", "detections"),
        "/front": ("radar_msgs/msg/RadarTracks", "detections"),
        "/front/scan": ("radar_msgs/msg/RadarScan", "detections"),
        "/perception/objects": ("autoware_auto_perception_msgs/msg/TrackedObjects", "detections"),
        "/traffic": ("mavros_msgs/msg/ADSBVehicle", "detections"),
        "/lidar/detections": (SCENE, "detections"),
        "/scene/obstacles": (SCENE, "obstacles"),
        "/truth/scene": (SCENE, "truth"),
        "/anything": ("mission.Detection", "detections"),
        "/detections": ("my.Own", "detections"),
        "/trackers": ("foxglove.PosesInFrame", "poses"),
        "/odom": ("nav_msgs/msg/Odometry", "poses"),
        "/somewhere": (POSE, "positions"),
        "/tf_static": ("tf2_msgs/msg/TFMessage", "tf"),
        "/map": ("nav_msgs/msg/OccupancyGrid", "obstacles"),
        "/obstacles": ("my.Shapes", "obstacles"),
    }
    expected |= {
        "/fmu/out/vehicle_global_position": ("px4_msgs/msg/VehicleGlobalPosition", "poses"),
        "/fmu/out/transponder_report": ("px4_msgs/msg/TransponderReport", "detections"),
        "/vicon/fox": ("geometry_msgs/msg/TransformStamped", "truth"),
        "/fox": ("geometry_msgs/msg/TransformStamped", "tf"),
        "/rigid_bodies": ("mocap4r2_msgs/msg/RigidBodies", "truth"),
        "/adsb/aircraft": ("foxglove.GeoJSON", "detections"),
        "/fence": ("foxglove.GeoJSON", "obstacles"),
        "/ais": ("", "detections"),
    }
    neither: dict[str, str] = {
        "/goal_pose": POSE, "/setpoint/target": "mavros_msgs/msg/PositionTarget", "/targets/path": "nav_msgs/msg/Path",
        "/targets/markers": "visualization_msgs/msg/MarkerArray", "/uav/target_pose": POSE, "/chat": "",
    }  # fmt: skip
    neither |= {"/rosout/report": "rcl_interfaces/msg/Log", "/radar/image": "sensor_msgs/msg/Image", "/imu": "sensor_msgs/Imu"}
    neither |= {"/scene": SCENE, "/cadence/detection_fix/A": FIX}
    found = suggest(*((topic, schema) for topic, (schema, _) in expected.items()), *neither.items())
    assert found.roles == {topic: role for topic, (_, role) in expected.items()}


def test_topics_of_one_pattern_become_one_source() -> None:
    found = suggest(("/truth/A", FIX), ("/truth/B", FIX), ("/contacts/A", FIX), ("/trackers/7", FIX))
    assert found.truth == (SourceConfig("/truth/{agent}", message_type="LocationFix"),)
    assert found.detections == (SourceConfig("/contacts/{agent}", message_type="LocationFix"),)
    assert found.poses == (SourceConfig("/trackers/{sensor}", message_type="LocationFix"),)


@pytest.mark.parametrize(
    ("topics", "patterns"),
    [
        (["/camera1/detections", "/camera2/detections"], ["/{sensor}/detections"]),
        (["/camera1/contacts/A7"], ["/{sensor}/contacts/{agent}"]),
        (["/uav1/front/contacts", "/uav2/front/contacts"], ["/{sensor}/front/contacts"]),
        (["/contacts"], ["/contacts"]),
    ],
)
def test_who_sees_stands_before_the_word_and_who_is_seen_after_it(topics: list[str], patterns: list[str]) -> None:
    assert [source.topic for source in suggest(*((topic, FIX) for topic in topics)).detections] == patterns


@pytest.mark.parametrize(
    ("topics", "patterns"),
    [
        (["/vrpn/uav1/truth"], ["/vrpn/{agent}/truth"]),
        (["/uav1/base/truth", "/uav2/base/truth"], ["/{agent}/base/truth"]),
        (["/uav1/ground_truth/odom"], ["/{agent}/ground_truth/odom"]),
        (["/truth"], ["/truth"]),
    ],
)
def test_the_part_that_varies_is_the_agent(topics: list[str], patterns: list[str]) -> None:
    assert [source.topic for source in suggest(*((topic, FIX) for topic in topics)).truth] == patterns


def test_detections_without_identity_stay_unknown_among_several_agents() -> None:
    assert suggest(("/truth/A", FIX), ("/truth/B", FIX), ("/contacts", FIX)).detections[0].agent is None


def test_detections_without_identity_belong_to_the_only_agent() -> None:
    assert suggest(("/truth/fugitive", FIX), ("/detections", "mission.Detection")).detections[0].agent == "fugitive"


def test_but_not_where_they_can_state_one() -> None:
    channels = [FakeChannel("/truth/fugitive", FIX), FakeChannel("/detections", "mission.Detection", b'{"agent_id": {}}')]
    assert suggest_mapping(channels).detections[0].agent is None


def test_empty_channels_are_no_sources() -> None:
    assert suggest_mapping([FakeChannel("/contacts/A", FIX, message_count=0)]).detections == ()


def test_dense_sources_are_agents() -> None:
    channels = [FakeChannel("/cub1/pose", POSE), FakeChannel("/cub2/pose", POSE)]
    assert [source.topic for source in dense_sources(channels, suggest_mapping(channels))] == ["/{agent}/pose"]


def test_toml_reads_back_as_the_same_sources() -> None:
    found = suggest(("/truth/A", FIX), ('/contacts/odd "name"', FIX), ("/trackers", "foxglove.PosesInFrame"), ("/place", POSE))
    config = read_config(ExtractConfig, tomllib.loads(found.to_toml())["extract"])
    assert (config.detections, config.truth, config.poses) == (found.detections, found.truth, found.poses)
    assert '# topic = "/place"' in found.to_toml()


def test_toml_of_unknown_detections_and_of_dense_logs() -> None:
    assert '# x = "position.x"' in suggest(("/detections", "my.Own")).to_toml()
    text = f"own_msgs/Fix[] fixes\n{'=' * 80}\nMSG: own_msgs/Fix\nfloat64 lat\nfloat64 lon\n"
    degrees = FakeChannel("/targets", "own_msgs/msg/Targets", text.encode())
    assert '# latitude = "fixes[:].lat"\n# longitude = "fixes[:].lon"' in suggest_mapping([degrees]).to_toml()
    px4 = FakeChannel("/target", "px4_msgs/msg/Own", b"float32 x\nfloat32 y\n")
    assert '# x = "x"\n# y = "y"\n# frame_convention = "ned"' in suggest_mapping([px4]).to_toml()
    dense = suggest(("/cub1/pose", POSE)).to_toml()
    assert "# [extract.thinning]" in dense and '# [[extract.detections]]\n# topic = "/{agent}/pose"' in dense
    assert suggest(("/imu", "sensor_msgs/Imu")).to_toml() == ""


@pytest.mark.parametrize(
    ("pattern", "topic", "expected"),
    [
        ("/truth/{agent}", "/truth/T0", {"agent": "T0"}),
        ("/truth/{agent}", "/truth/T0/pose", None),
        ("/{sensor}/sees/{agent}", "/cam.1/sees/T-0", {"sensor": "cam.1", "agent": "T-0"}),
        ("/t{agent}_pose", "/t7_pose", {"agent": "7"}),
        ("/a.b", "/a.b", {}),
        ("/a.b", "/axb", None),
    ],
)
def test_patterns(pattern: str, topic: str, expected: dict[str, str] | None) -> None:
    assert SourceConfig(pattern).match(topic) == expected


@pytest.mark.parametrize(
    ("table", "message"),
    [
        ({}, "'topic' is missing"),
        ({"topic": "/a", "lat": "x"}, "unknown key 'lat'"),
        ({"topic": "/a/{name}"}, "placeholders are"),
        ({"topic": "/a/{agent}/{agent}"}, "placeholders are"),
        ({"topic": "/a/{agent}", "agent": "T0"}, "only one of agent, {agent} in the topic"),
        ({"topic": "/a", "agent": "T0", "agent_path": "id"}, "only one of agent, agent_path"),
        ({"topic": "/a", "x": "p.x"}, "go together"),
        ({"topic": "/a", "x": "p.x", "y": "p.y", "latitude": "lat", "longitude": "lon"}, "only one of x and y, latitude"),
        ({"topic": "/a", "x": "p.x", "y": "p.y", "range": "r", "bearing": "b"}, "only one of x and y, latitude"),
        ({"topic": "/a", "range": "r", "bearing": "b", "bearing_sigma_deg": 0.0}, "bearing_sigma_deg must be positive"),
        ({"topic": "/a", "range": "r", "bearing": "b", "observer_x_m": 1.0}, "observer_x_m and observer_y_m go together"),
        ({"topic": "/a", "range": "r", "bearing": "b", "observer_heading_deg": 1.0}, "a frame's heading is in transforms"),
        ({"topic": "/a", "x": "/b.p.x", "y": "p.y"}, "leave the topic out"),
        ({"topic": "/a", "frame_convention": "NED"}, "'NED' is not one of enu, ned"),
        ({"topic": "/a", "x": "p.x", "y": "p[.y"}, r"y: message path 'p\[.y'"),
        ({"topic": "/a", "message_type": "Places"}, "message_type 'Places' is not known"),
        ({"topic": "/a", "where": "fix_type => 3"}, "where: condition 'fix_type => 3': expected terms such as"),
        ({"topic": "/a", "sigma_m": 0.0}, "sigma_m"),
    ],
)
def test_wrong_sources(table: dict[str, object], message: str) -> None:
    with pytest.raises(ConfigError, match=message) as caught:
        read_config(SourceConfig, table, "extract.detections[0]")
    assert str(caught.value).startswith("extract.detections[0]") and "\n" not in str(caught.value)


def test_stated_paths_replace_those_of_the_type() -> None:
    paths = resolve_paths(SourceConfig("/a", covariance="cov", agent_path="id"), "foxglove.LocationFix")
    assert (paths.latitude, paths.covariance, paths.agent) == (("latitude",), ("cov",), ("id",))


def test_a_stated_position_takes_nothing_of_the_types_geometry() -> None:
    paths = resolve_paths(SourceConfig("/a", message_type="LocationFix", x="p.x", y="p.y"), "foxglove.LocationFix")
    assert (paths.x, paths.latitude, paths.covariance, paths.altitude) == (("p.x",), (), (), ())
    assert "timestamp" in paths.time


def test_paths_may_hold_their_topic_as_in_foxglove() -> None:
    x = '/det.detections[:]{id=="T0"}.bbox.center.position.x'
    source = SourceConfig("/det", x=x, y="p.y", score="/det{ok==true}.score")
    paths = resolve_paths(source, "my.Own")
    assert (paths.x, paths.y) == (('.detections[:]{id=="T0"}.bbox.center.position.x',), ("p.y",))
    assert paths.score == ("{ok==true}.score",)


def test_no_known_type_and_no_paths() -> None:
    with pytest.raises(ConfigError, match=r"its type, my.Own, is not known; give message paths"):
        resolve_paths(SourceConfig("/a"), "my.Own")


def test_the_older_name_of_a_message_type_is_still_read() -> None:
    older = {"topic": "/fix", "preset": "NavSatFix"}
    assert read_config(SourceConfig, older) == SourceConfig("/fix", message_type="NavSatFix")
    with pytest.raises(ConfigError, match="'preset' is the older name of 'message_type'; give one of the two"):
        read_config(SourceConfig, older | {"message_type": "NavSatFix"})


def test_lines_for_bearings_and_boxes() -> None:
    """What radars and cameras measured, with the accuracies that are taken, and what only the user can say."""
    scans = suggest(("/radar", "radar_msgs/msg/RadarScan"))
    assert "range_sigma_m = 0.5\nbearing_sigma_deg = 1.0" in scans.to_toml()
    assert suggest(("/radar", "radar_msgs/msg/RadarScan"), ("/contacts/A", FIX)).detections[0].topic == "/contacts/{agent}"
    boxes = suggest(("/boxes", "vision_msgs/msg/Detection2DArray")).to_toml()
    assert '# message_type = "Detection2DArray"\n# agent = "NAME"' in boxes and "say whom they show" in boxes
    own = FakeChannel("/contacts", "own/msg/Heard", b"float32 azimuth_deg\nfloat32 range\n")
    lines = suggest_mapping([own]).to_toml()
    assert '# bearing = "azimuth_deg"' in lines and '# bearing_unit = "deg"' in lines and "# range_sigma_m = 10.0" in lines
