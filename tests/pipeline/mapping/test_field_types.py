"""Types of what vehicles, receivers and detectors record, against messages built with the definitions of their packages."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fixtures.field_messages import OBJECTS, PX4, PX4_OLD, RECEIVERS
from fixtures.ros_messages import VISION_FOXY, VISION_HUMBLE, Builder, store_with
from fixtures.small_logs import START_NS, Row, write_log

from pipeline.extract.channel_reader import ChannelReader
from pipeline.extract.positions import Positions
from pipeline.extract.reading import read_positions
from pipeline.logs.reader import open_log
from pipeline.mapping.guess import suggest_mapping
from pipeline.mapping.message_types import type_of_schema
from pipeline.mapping.sources import SourceConfig
from pipeline.progress import Progress

NED, NED_OLD, FIXES, SEEN, ROS = (Builder(store_with(texts)) for texts in (PX4, PX4_OLD, RECEIVERS, OBJECTS, {}))
US = START_NS // 1000
UPPER = np.array([4.0, 1.0, 0.5, 9.0, 0.25, 16.0], np.float32)
NORTH_FIRST = np.zeros(36)
NORTH_FIRST[[0, 1, 2, 6, 7, 8, 12, 13, 14]] = 9.0, 1.0, 0.25, 1.0, 4.0, 0.5, 0.25, 0.5, 16.0


def read(path: Path, rows: list[Row], **source: Any) -> tuple[Positions, ChannelReader]:
    log = open_log(write_log(path / "log.mcap", rows))
    reader = ChannelReader(log.channels[0], SourceConfig(rows[0].topic, **source), "detections", True, {})
    counts = read_positions(log, [reader], Progress(quiet=True))
    assert counts["undecodable"] == counts["bad_covariance"] == 0
    return reader.finish(), reader


def read_ros(path: Path, build: Builder, *messages: Any, **source: Any) -> tuple[Positions, ChannelReader]:
    return read(path, [build.cdr_row(message) for message in messages], **source)


def geo_pose(latitude: float = 50.5) -> Any:
    point = FIXES("geographic_msgs/msg/GeoPoint", latitude=latitude, longitude=-1.25, altitude=7.0)
    return FIXES("geographic_msgs/msg/GeoPose", position=point, orientation=FIXES.turn())


def status(kind: str, value: int) -> Any:
    return FIXES(kind, status=value)


HEAD = {"header": FIXES.header()}
E7 = {"lat": 505_000_000, "lon": -12_500_000}
GEODETIC = {  # type: a valid message, an invalid one, the standard deviation that it states
    "GPSFix": (
        FIXES(
            "gps_msgs/msg/GPSFix", **HEAD, status=status("gps_msgs/msg/GPSStatus", 0), latitude=50.5, longitude=-1.25,
            altitude=7.0, position_covariance=np.diag([4.0, 4.0, 9.0]).ravel(), position_covariance_type=2,
        ),
        FIXES("gps_msgs/msg/GPSFix", **HEAD, status=status("gps_msgs/msg/GPSStatus", -1)),
        2.0,
    ),
    "NavPVT": (
        FIXES("ublox_msgs/msg/NavPVT", **E7, h_msl=7000, height=50_000, h_acc=1500, fix_type=3, flags=1),
        FIXES("ublox_msgs/msg/NavPVT", **E7, fix_type=3, flags=0),
        1.5,
    ),
    "GPSRAW": (
        FIXES("mavros_msgs/msg/GPSRAW", **HEAD, **E7, alt=7000, h_acc=2500, fix_type=3),
        FIXES("mavros_msgs/msg/GPSRAW", **HEAD, **E7, fix_type=1),
        2.5,
    ),
    "BESTPOS": (
        FIXES(
            "novatel_oem7_msgs/msg/BESTPOS", **HEAD, sol_status=status("novatel_oem7_msgs/msg/SolutionStatus", 0), lat=50.5,
            lon=-1.25, hgt=7.0, lat_stdev=0.5,
        ),
        FIXES("novatel_oem7_msgs/msg/BESTPOS", **HEAD, sol_status=status("novatel_oem7_msgs/msg/SolutionStatus", 1)),
        0.5,
    ),
    "SbgGpsPos": (
        FIXES(
            "sbg_driver/msg/SbgGpsPos", **HEAD, status=status("sbg_driver/msg/SbgGpsPosStatus", 0), latitude=50.5,
            longitude=-1.25, altitude=7.0, position_accuracy=FIXES("geometry_msgs/msg/Vector3", x=0.75),
        ),
        FIXES("sbg_driver/msg/SbgGpsPos", **HEAD, status=status("sbg_driver/msg/SbgGpsPosStatus", 1)),
        0.75,
    ),
    "VehicleGlobalPosition": (
        NED("px4_msgs/msg/VehicleGlobalPosition", timestamp=US, lat=50.5, lon=-1.25, alt=7.0, lat_lon_valid=True, eph=0.5),
        NED("px4_msgs/msg/VehicleGlobalPosition", timestamp=US, lat=50.5, lon=-1.25, lat_lon_valid=False),
        0.5,
    ),
    "SensorGps": (
        NED(
            "px4_msgs/msg/SensorGps", timestamp=90_000_000, time_utc_usec=US, latitude_deg=50.5, longitude_deg=-1.25,
            altitude_msl_m=7.0, fix_type=3, eph=2.0,
        ),
        NED("px4_msgs/msg/SensorGps", timestamp=90_000_000, latitude_deg=50.5, longitude_deg=-1.25, fix_type=1),
        2.0,
    ),
    "TransponderReport": (
        NED("px4_msgs/msg/TransponderReport", timestamp=US, icao_address=7, lat=50.5, lon=-1.25, altitude=7.0, flags=3),
        NED("px4_msgs/msg/TransponderReport", timestamp=US, icao_address=7, flags=2),
        None,
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", GEODETIC)
def test_fixes(tmp_path: Path, name: str) -> None:
    valid, invalid, sigma_m = GEODETIC[name]
    rows, reader = read_ros(tmp_path, NED if "px4" in valid.__msgtype__ else FIXES, valid, invalid)
    assert type_of_schema(valid.__msgtype__) == name and reader.counts["no_fix"] == 1
    assert (rows.first.tolist(), rows.second.tolist(), rows.z_m.tolist()) == ([50.5], [-1.25], [7.0])
    assert rows.is_geodetic.all() and rows.agent[0] == ("7" if name == "TransponderReport" else None)
    np.testing.assert_array_equal(rows.covariance_m2[0], [np.nan] * 3 if sigma_m is None else [sigma_m**2, 0, sigma_m**2])
    has_stamp = "px4" in valid.__msgtype__
    assert rows.time_ns[0] == (US * 1000 if has_stamp else START_NS + (10**9 if name == "NavPVT" else 250_000_000))


def test_gps_of_older_px4(tmp_path: Path) -> None:
    rows, _ = read_ros(tmp_path, NED_OLD, NED_OLD("px4_msgs/msg/SensorGps", timestamp=US, **E7, alt=7000, fix_type=3, eph=2.0))
    assert (rows.first[0], rows.second[0], rows.z_m[0], rows.covariance_m2[0, 0]) == (50.5, -1.25, 7.0, 4.0)


def test_geographic_poses(tmp_path: Path) -> None:
    """Their covariances have the latitude first: north before east."""
    plain = FIXES("geographic_msgs/msg/GeoPoseStamped", **HEAD, pose=geo_pose())
    inner = FIXES("geographic_msgs/msg/GeoPoseWithCovariance", pose=geo_pose(), covariance=NORTH_FIRST)
    known = FIXES("geographic_msgs/msg/GeoPoseWithCovarianceStamped", **HEAD, pose=inner)
    ship = FIXES("marine_ais_msgs/msg/AISContact", **HEAD, position_message_id=1, id=7, pose=geo_pose(), covariance=NORTH_FIRST)
    for number, message in enumerate((plain, known, ship)):
        (tmp_path / str(number)).mkdir()
        rows, _ = read_ros(tmp_path / str(number), FIXES, message)
        assert (rows.first[0], rows.second[0], rows.z_m[0]) == (50.5, -1.25, 7.0) and rows.is_geodetic.all()
        if message is not plain:
            assert rows.covariance_m2.tolist() == [[4, 1, 9]] and rows.height_covariance_m2.tolist() == [[0.5, 0.25, 16]]
    assert rows.agent.tolist() == ["7"]


def test_ais_stations_ashore_are_no_ships(tmp_path: Path) -> None:
    messages = [
        FIXES("marine_ais_msgs/msg/AISContact", **HEAD, position_message_id=kind, id=kind, pose=geo_pose())
        for kind in (1, 4, 21)
    ]
    rows, _ = read_ros(tmp_path, FIXES, *messages)
    assert rows.agent.tolist() == ["1"]


META = {"MMSI": 7, "latitude": 50.5, "longitude": -1.25, "time_utc": "2023-11-14 22:13:25 +0000 UTC"}
"""What aisstream says beside each message, as Go writes it."""


@pytest.mark.parametrize(
    ("message", "expected"),
    [
        ({"type": 1, "mmsi": 7, "lat": 50.5, "lon": -1.25, "time": "2023-11-14T22:13:25Z"}, [("7", 50.5)]),  # gpsd, AIS-catcher
        ({"msg_type": 18, "mmsi": "7", "lat": "50.5", "lon": "-1.25"}, [("7", 50.5)]),  # pyais
        ({"MetaData": META, "MessageType": "PositionReport"}, [("7", 50.5)]),
        ({"MetaData": META, "MessageType": "ShipStaticData"}, []),  # repeats the last position
        ({"MetaData": META, "MessageType": "BaseStationReport"}, []),
        ({"class": "AIS", "type": 17, "mmsi": 7, "lat": 50.5, "lon": -1.25}, []),
        ({"type": 5, "mmsi": 7, "shipname": "X"}, []),
        ({"type": 4, "mmsi": 7, "lat": 50.5, "lon": -1.25}, []),
    ],
)
def test_json_of_ais_decoders(tmp_path: Path, message: dict[str, Any], expected: list[tuple[str, float]]) -> None:
    other = {"mmsi": 1, "lat": 50.0, "lon": -1.25}
    rows, _ = read(tmp_path, [Row("/ais", "", 2.0, message), Row("/ais", "", 3.0, other)], message_type="AIS")
    assert list(zip(rows.agent, rows.first, strict=True)) == [*expected, ("1", 50.0)] and set(rows.second) == {-1.25}
    if expected and ("time" in message or "MetaData" in message):
        assert rows.time_ns[0] == START_NS + 5 * 10**9


def test_ships_that_only_their_topics_name(tmp_path: Path) -> None:
    """As Digitraffic has it: the MMSI is a part of the topic, and the message repeats it not."""
    topics = [f"/ais/vessels-v2/{mmsi}/location" for mmsi in ("230000001", "230000002", "002300001")]
    rows = [Row(topic, "", float(i), {"lat": 60.0 + 1e-4 * i, "lon": 20.0}) for i in range(5) for topic in topics]
    (source, other) = suggest_mapping(open_log(write_log(tmp_path / "a.mcap", rows)).channels).detections
    assert source.topic == "/ais/vessels-v2/{agent}/location" and other.agent is None and "{agent}" not in other.topic


@pytest.mark.parametrize(
    ("build", "message"),
    [
        (NED, NED("px4_msgs/msg/VehicleLocalPosition", timestamp=US, xy_valid=True, x=1.5, y=-2.5, z=3.5, eph=2.0)),
        (
            NED,
            NED(
                "px4_msgs/msg/VehicleOdometry", timestamp=US, pose_frame=1, position=np.array([1.5, -2.5, 3.5], np.float32),
                position_variance=np.array([4.0, 4.0, 16.0], np.float32),
            ),
        ),
        (
            NED_OLD,
            NED_OLD(
                "px4_msgs/msg/VehicleOdometry", timestamp=US, x=1.5, y=-2.5, z=3.5,
                pose_covariance=np.array([4.0, 0, 0, 0, 0, 0, 4.0, 0, 0, 0, 0, 16.0, *[0] * 9], np.float32),
            ),
        ),
    ],
)  # fmt: skip
def test_px4_is_north_east_down(tmp_path: Path, build: Builder, message: Any) -> None:
    rows, _ = read_ros(tmp_path, build, message)
    assert (rows.first[0], rows.second[0], rows.z_m[0], rows.time_ns[0]) == (1.5, -2.5, 3.5, US * 1000)
    assert rows.is_ned.all() and rows.covariance_m2.tolist() == [[4, 0, 4]]
    (tmp_path / "told").mkdir()
    assert not read_ros(tmp_path / "told", build, message, frame_convention="enu")[0].is_ned.any()


def test_px4_says_what_is_not_valid(tmp_path: Path) -> None:
    local = [NED("px4_msgs/msg/VehicleLocalPosition", timestamp=US, xy_valid=valid, x=float(valid)) for valid in (True, False)]
    rows, reader = read_ros(tmp_path, NED, *local)
    assert rows.first.tolist() == [1.0] and reader.counts["no_fix"] == 1
    unknown = np.full(3, np.nan, np.float32)
    (tmp_path / "odometry").mkdir()
    message = NED("px4_msgs/msg/VehicleOdometry", timestamp=US, position=unknown, position_variance=unknown)
    rows, _ = read_ros(tmp_path / "odometry", NED, message)
    assert np.isnan(rows.first[0]) and np.isnan(rows.covariance_m2).all()


def pose_with(kind: str, **values: Any) -> Any:
    return SEEN(kind, pose=SEEN.pose(), **values)


SPATIAL = SEEN(
    "depthai_ros_msgs/msg/SpatialDetection", results=[SEEN("vision_msgs/msg/ObjectHypothesis", class_id="boat", score=0.5)],
    position=SEEN.point(), is_tracking=True, tracking_id="7",
)  # fmt: skip
PLACE = np.array([1.5, -2.5, 3.5], np.float32)
ARRAYS: dict[str, tuple[str, Any, dict[str, Any]]] = {  # type: field of the array, an item, what else is expected
    "ObjectArray": ("objects", pose_with("derived_object_msgs/msg/Object", id=7), {}),
    "ObjectsStamped": (
        "objects",
        SEEN(
            "zed_msgs/msg/Object", label="Person", label_id=7, confidence=75.0, position=PLACE, position_covariance=UPPER,
            tracking_state=1,
        ),
        {"score": 0.75, "covariance": True},
    ),
    "SpatialDetectionArray": ("detections", SPATIAL, {"score": 0.5}),
    "BoundingBoxArray": (
        "boxes", pose_with("jsk_recognition_msgs/msg/BoundingBox", value=0.5, label=3), {"agent": None, "score": 0.5}
    ),
    "RadarObjects": (
        "objects",
        SEEN(
            "autoware_sensing_msgs/msg/RadarObject", object_id=7, position=SEEN.point(), position_cov=UPPER,
            existence_probability=0.5,
        ),
        {"score": 0.5, "covariance": True},
    ),
    "DetectedObjectArray": (
        "objects", pose_with("autoware_msgs/msg/DetectedObject", id=7, score=0.5, space_frame="odom"), {"score": 0.5}
    ),
    "RigidBodies": ("rigidbodies", pose_with("mocap4r2_msgs/msg/RigidBody", rigid_body_name="7"), {}),
    "NamedPoseArray": ("poses", pose_with("motion_capture_tracking_interfaces/msg/NamedPose", name="7"), {}),
}  # fmt: skip


@pytest.mark.parametrize("name", ARRAYS)
def test_objects(tmp_path: Path, name: str) -> None:
    field, item, more = ARRAYS[name]
    package = item.__msgtype__.rsplit("/", 1)[0]
    rows, _ = read_ros(tmp_path, SEEN, SEEN(f"{package}/{name}", header=SEEN.header(), **{field: [item, item]}))
    assert type_of_schema(f"{package}/{name}") == name
    assert (rows.first.tolist(), rows.second.tolist(), rows.z_m.tolist()) == ([1.5] * 2, [-2.5] * 2, [3.5] * 2)
    assert rows.agent.tolist() == [more.get("agent", "7")] * 2 and rows.frame_id.tolist() == ["odom"] * 2
    assert rows.time_ns.tolist() == [START_NS + 250_000_000] * 2 and not rows.is_geodetic.any()
    np.testing.assert_array_equal(rows.score, [more.get("score", np.nan)] * 2)
    np.testing.assert_array_equal(rows.covariance_m2[0], [4, 1, 9] if more.get("covariance") else [np.nan] * 3)


def test_objects_with_covariances(tmp_path: Path) -> None:
    item = SEEN("derived_object_msgs/msg/ObjectWithCovariance", id=7, pose=SEEN.uncertain_pose())
    message = SEEN("derived_object_msgs/msg/ObjectWithCovarianceArray", header=SEEN.header(), objects=[item])
    rows, _ = read_ros(tmp_path, SEEN, message)
    assert (rows.agent.tolist(), rows.first.tolist()) == (["7"], [1.5]) and rows.covariance_m2[0].tolist() == [4.0, 1.0, 9.0]


def test_objects_that_are_searched_for_or_invalid_are_not_seen(tmp_path: Path) -> None:
    searched = [SEEN("zed_msgs/msg/Object", label_id=state, position=PLACE, tracking_state=state) for state in range(4)]
    rows, _ = read_ros(tmp_path, SEEN, SEEN("zed_msgs/msg/ObjectsStamped", header=SEEN.header(), objects=searched))
    assert rows.agent.tolist() == ["0", "1"]  # without a tracker the state is 0
    (tmp_path / "radar").mkdir()
    unknown = np.full(6, 1e8, np.float32)
    objects = [
        SEEN("autoware_sensing_msgs/msg/RadarObject", measurement_status=state, position=SEEN.point(), position_cov=unknown)
        for state in (0, 255)
    ]
    rows, _ = read_ros(
        tmp_path / "radar", SEEN, SEEN("autoware_sensing_msgs/msg/RadarObjects", header=SEEN.header(), objects=objects)
    )
    assert len(rows) == 1 and np.isnan(rows.covariance_m2).all()


@pytest.mark.parametrize("texts", [VISION_HUMBLE, VISION_FOXY])
def test_a_single_detection(tmp_path: Path, texts: dict[str, str]) -> None:
    build = Builder(store_with(texts))
    boxed, bare = build.detection("7", 10.0), build.detection("", 0.0, has_box=False)
    boxed.header = bare.header = build.header()
    rows, _ = read_ros(tmp_path, build, boxed, bare)
    assert rows.first.tolist() == [10.0, 1.0] and rows.agent.tolist() == ["7", None] and rows.score.tolist() == [0.5, 0.5]
    assert rows.covariance_m2.tolist() == [[4, 1, 9]] * 2 and rows.frame_id.tolist() == ["odom"] * 2


def test_plain_points_and_poses_and_transforms(tmp_path: Path) -> None:
    shift = ROS("geometry_msgs/msg/Transform", translation=ROS("geometry_msgs/msg/Vector3", x=1.5, y=-2.5, z=3.5))
    transform = ROS("geometry_msgs/msg/TransformStamped", header=ROS.header(), child_frame_id="fox", transform=shift)
    for number, message in enumerate((ROS.point(), ROS.pose(), transform)):
        (tmp_path / str(number)).mkdir()
        rows, _ = read_ros(tmp_path / str(number), ROS, message)
        assert (rows.first[0], rows.second[0], rows.z_m[0]) == (1.5, -2.5, 3.5)
    assert rows.agent.tolist() == ["fox"]


def test_what_is_drawn_can_be_read_when_told(tmp_path: Path) -> None:
    def marker(number: int, action: int) -> Any:
        return ROS("visualization_msgs/msg/Marker", header=ROS.header(), id=number, action=action, pose=ROS.pose())

    rows, _ = read_ros(
        tmp_path, ROS, ROS("visualization_msgs/msg/MarkerArray", markers=[marker(7, 0), marker(8, 2), marker(9, 0)])
    )
    assert rows.agent.tolist() == ["7", "9"] and rows.first.tolist() == [1.5] * 2 and rows.frame_id.tolist() == ["odom"] * 2
    points = ROS("visualization_msgs/msg/Marker", header=ROS.header(), type=8, points=[ROS.point()])
    (tmp_path / "points").mkdir()
    assert len(read_ros(tmp_path / "points", ROS, points)[0]) == 0  # their pose is only where the points count from
    poses = [ROS("geometry_msgs/msg/PoseStamped", header=ROS.header("odom", START_NS + i), pose=ROS.pose()) for i in (5, 6)]
    (tmp_path / "path").mkdir()
    rows, _ = read_ros(tmp_path / "path", ROS, ROS("nav_msgs/msg/Path", header=ROS.header(), poses=poses))
    assert rows.time_ns.tolist() == [START_NS + 5, START_NS + 6]


def test_foxglove_odometry(tmp_path: Path) -> None:
    covariance = [0.0] * 36
    covariance[0] = covariance[7] = 4.0
    message = {
        "timestamp": {"sec": START_NS // 10**9, "nsec": 5}, "frame_id": "odom", "body_frame_id": "base",
        "pose": {"position": {"x": 1.5, "y": -2.5, "z": 3.5}}, "pose_covariance": covariance,
    }  # fmt: skip
    rows, _ = read(tmp_path, [Row("/odom", "foxglove.Odometry", 2.0, message)])
    assert (rows.first[0], rows.time_ns[0], rows.frame_id[0]) == (1.5, START_NS + 5, "odom")
    assert rows.covariance_m2.tolist() == [[4, 0, 4]]


POINT = {"type": "Point", "coordinates": [-1.25, 50.5, 7.0]}
AREA = {"type": "Polygon", "coordinates": [[[0, 0], [1, 0], [1, 1], [0, 0]]]}
UNNAMED = {"type": "Feature", "geometry": POINT, "properties": {}}
FEATURE = {**UNNAMED, "id": "7"}
BARE = {"type": "Feature", "geometry": AREA, "properties": {"icao": "8"}}


@pytest.mark.parametrize(
    ("shape", "agents"),
    [
        ({"type": "FeatureCollection", "features": [FEATURE, BARE]}, ["7"]),
        ({"type": "FeatureCollection", "features": [BARE, {**UNNAMED, "properties": {"icao": "9"}}]}, ["9"]),
        ({"type": "FeatureCollection", "features": []}, []),
        (FEATURE, ["7"]),
        (BARE, []),
        (UNNAMED, [None]),
        ("no JSON", []),
    ],
)
def test_points_of_geojson(tmp_path: Path, shape: Any, agents: list[str | None]) -> None:
    text = shape if isinstance(shape, str) else json.dumps(shape)
    rows, _ = read(tmp_path, [Row("/adsb", "foxglove.GeoJSON", 2.0, {"geojson": text})])
    assert rows.agent.tolist() == agents and set(rows.first) <= {50.5} and set(rows.second) <= {-1.25}
