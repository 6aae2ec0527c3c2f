"""The extract stage on small logs: what becomes a row, what is left out and counted, and one line for what cannot work."""

import dataclasses
import json
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pytest
from fixtures.small_logs import START_NS, Row, detection, fix, pose, write_log

from cadence.errors import CadenceError, ConfigError, InputError, NothingDetectedError
from pipeline.config import read_config
from pipeline.extract.config import ExtractConfig
from pipeline.extract.selection import ROLES, _no_detections, select_readers
from pipeline.extract.stage import extract
from pipeline.extract.thinning import ThinningConfig
from pipeline.extract.writing import write_tables
from pipeline.ingest.stage import IngestConfig, ingest
from pipeline.logs.reader import Channel, open_log
from pipeline.mapping.guess import suggest_mapping
from pipeline.progress import Progress
from pipeline.tables import Frame, read_table
from schemas.tables import DETECTIONS, POSES, TRUTH

DATA = Path(__file__).resolve().parents[3].parent / "shared" / "data"
QUIET = Progress(quiet=True)


@dataclasses.dataclass(frozen=True)
class Extracted:
    summary: dict[str, Any]
    detections: pa.Table
    frame: Frame
    folder: Path

    def table(self, name: str) -> pa.Table:
        return read_table(self.folder / f"{name}.parquet", name)[0]


def run(folder: Path, rows: list[Row] | Path, **tables: Any) -> Extracted:
    log = rows if isinstance(rows, Path) else write_log(folder / "log.mcap", rows)
    summary = write_tables(open_log(log), folder, read_config(ExtractConfig, tables, "extract"), QUIET)
    detections, frame = read_table(folder / "detections.parquet", "detections")
    return Extracted(summary, detections, frame, folder)


def fails(folder: Path, rows: list[Row], kind: type[CadenceError], match: str, **tables: Any) -> None:
    with pytest.raises(kind, match=match) as caught:
        run(folder, rows, **tables)
    assert "\n" not in str(caught.value)
    assert not list(folder.glob("*.parquet"))


def line(num: int = 5, **more: Any) -> list[Row]:
    return [detection(float(i), 3.0 * i, -i, **more) for i in range(num)]


def test_whole_stage(tmp_path: Path) -> None:
    log = write_log(tmp_path / "patrol.mcap", [*line(sensor="cam"), *(pose(i / 2, 1.5 * i, 0.0) for i in range(10))])
    before = log.read_bytes()
    directory = tmp_path / "out"
    ingest(log, directory, IngestConfig(), QUIET)
    result = extract(directory, ExtractConfig(), QUIET)
    assert {path.name for path in result.outputs} == {"detections.parquet", "truth.parquet", "obstacles.json"}
    assert json.loads((directory / "obstacles.json").read_text()) == {"version": 1, "obstacles": []}
    table, frame = read_table(directory / "detections.parquet", "detections")
    assert frame == Frame("map")
    assert table.schema.equals(DETECTIONS) and read_table(directory / "truth.parquet", "truth")[0].schema.equals(TRUTH)
    assert table.to_pylist()[1] == {
        "log_id": "patrol", "time_ns": START_NS + 10**9, "sensor_id": "cam", "agent_id": "T0",
        "x_m": 3.0, "y_m": -1.0, "z_m": 0.0,
        "cov_xx_m2": None, "cov_xy_m2": None, "cov_yy_m2": None, "score": None, "num_merged": 1, "topic": "/detections",
        "log_time_ns": START_NS + 10**9, "sequence": 1,
    }  # fmt: skip
    assert extract(directory, ExtractConfig(), QUIET).status == "skipped"
    assert extract(directory, ExtractConfig(default_sigma_m=1.0), QUIET).status == "done"
    assert log.read_bytes() == before


def test_poses_of_sensors(tmp_path: Path) -> None:
    poses = {
        "frame_id": "map",
        "poses": [{"position": {"x": 1.0, "y": 2.0, "z": 0.0}}, {"position": {"x": 3.0, "y": 4.0, "z": 0.0}}],
    }
    found = run(tmp_path, [*line(), Row("/trackers", "foxglove.PosesInFrame", 6.0, poses)])
    table = found.table("poses")
    assert table.schema.equals(POSES)
    assert table["sensor_id"].to_pylist() == ["trackers/0", "trackers/1"] and table["x_m"].to_pylist() == [1.0, 3.0]


def test_custom_paths(tmp_path: Path) -> None:
    def message(i: int) -> dict[str, Any]:
        objects = [
            {"kind": "ship", "id": "A", "where": {"e": float(i), "n": 1.0}, "cov": [4.0, 0.0, 0.0, 4.0], "p": 0.9},
            {"kind": "buoy", "id": "Z", "where": {"e": 7.0, "n": 7.0}, "cov": [1.0, 0.0, 0.0, 1.0], "p": 0.9},
            {"kind": "ship", "id": "B", "where": {"e": -float(i), "n": 2.0}, "cov": [9.0, 0.0, 0.0, 9.0], "p": 0.4},
        ]
        return {"t_ms": (START_NS // 10**6) + 1000 * i + 500, "objects": objects}

    ships = 'objects[:]{kind=="ship"}'
    entry = {
        "topic": "/cam/{sensor}/objects", "x": f"{ships}.where.e", "y": f"{ships}.where.n", "agent_path": f"{ships}.id",
        "covariance": f"{ships}.cov", "score": f"{ships}.p", "time": "t_ms",
    }  # fmt: skip
    found = run(tmp_path, [Row("/cam/left/objects", "", float(i), message(i)) for i in range(3)], detections=[entry])
    table = found.detections
    assert table["agent_id"].to_pylist() == ["A", "B"] * 3 and set(table["sensor_id"].to_pylist()) == {"left"}
    assert table["x_m"].to_pylist() == [0.0, -0.0, 1.0, -1.0, 2.0, -2.0]
    assert table["cov_yy_m2"].to_pylist() == [4.0, 9.0] * 3
    assert table["time_ns"][0].as_py() == START_NS + 500_000_000
    assert found.summary["num_agents"] == 2


def test_unknown_origin_is_null(tmp_path: Path) -> None:
    found = run(tmp_path, [*line(), *(pose(0, 0, 0, f"/truth/{name}") for name in "AB")])
    assert found.summary["num_unknown_origin"] == 5 and found.summary["num_agents"] == 0
    assert found.detections["agent_id"].null_count == 5


def test_georeferenced(tmp_path: Path) -> None:
    covariance = {"position_covariance": [225.0, 0, 0, 0, 100.0, 0, 0, 0, 1.0], "position_covariance_type": 2}
    rows = [fix(float(i), 50.0 + 0.001 * i, -1.0, **covariance) for i in range(3)]
    found = run(tmp_path, rows)
    assert found.frame == Frame("mission", 50.001, -1.0, "ellipsoid")
    np.testing.assert_allclose(found.detections["y_m"].to_numpy(), [-111.24, 0.0, 111.24], atol=0.02)
    np.testing.assert_allclose(found.detections["x_m"].to_numpy(), 0.0, atol=1e-6)
    assert found.detections["cov_xx_m2"].to_pylist() == [225.0] * 3 and found.detections["cov_yy_m2"].to_pylist() == [100.0] * 3
    assert run(tmp_path, rows, datum=[50.0, -1.0]).frame == Frame("mission", 50.0, -1.0, "ellipsoid")


def test_no_fix_is_skipped(tmp_path: Path) -> None:
    found = run(tmp_path, [fix(0, 50.0, -1.0), fix(1, 0.0, 0.0, status=-1), fix(2, 50.0, -1.0)])
    assert (found.summary["num_detections"], found.summary["no_fix"]) == (2, 1)


def test_metres_about_a_stated_datum(tmp_path: Path) -> None:
    assert run(tmp_path, line(), datum=[50.0, -1.0]).frame == Frame("map", 50.0, -1.0)


def test_translating_the_frame_translates_the_rows(tmp_path: Path) -> None:
    moved = [detection(float(i), 3.0 * i + 1e6, -i - 2e6) for i in range(5)]
    here = run(tmp_path, line()).detections
    there = run(tmp_path, moved).detections
    assert (there["x_m"].to_numpy() - here["x_m"].to_numpy()).tolist() == [1e6] * 5
    assert (there["y_m"].to_numpy() - here["y_m"].to_numpy()).tolist() == [-2e6] * 5


def test_bad_positions_are_skipped_and_counted(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    bad = [
        detection(5.0, float("nan"), 0),
        detection(6.0, 0, float("inf")),
        detection(7.0, 1, 1),
        fix(8, 123.0, 0, "/contacts/A"),
    ]
    log = write_log(tmp_path / "log.mcap", [*line(), *bad[:3]])
    summary = write_tables(open_log(log), tmp_path, ExtractConfig(), Progress())
    assert (summary["num_detections"], summary["dropped_nonfinite"]) == (6, 2)
    assert capsys.readouterr().err.count("NaN") == 1
    fails(tmp_path / "none", mkdir(tmp_path / "none", bad[:2]), InputError, "every position is NaN, infinite or off the earth")
    fails(tmp_path / "earth", mkdir(tmp_path / "earth", bad[3:]), InputError, "off the earth")


def test_numbers_that_nothing_can_mean_are_refused_in_one_line(tmp_path: Path) -> None:
    far = [detection(5.0 + i, 1e300, 5.0) for i in range(5)]
    assert run(mk(tmp_path / "some"), [*line(), *far]).summary["dropped_nonfinite"] == 5
    fails(mk(tmp_path / "all"), far, InputError, "off the earth")
    ages = [detection(1e8 * i, 3.0 * i, 0.0) for i in range(61)]
    fails(mk(tmp_path / "ages"), ages, InputError, "the detections span 190 years, by 2023.* choose a part with extract.start")


def mkdir(folder: Path, rows: list[Row]) -> list[Row]:
    folder.mkdir()
    return rows


def test_incomplete_and_undecodable_messages_are_counted(tmp_path: Path) -> None:
    rows = [
        *line(),
        Row("/detections", "mission.Detection", 6.0, {"note": 1}),
        Row("/detections", "mission.Detection", 7.0, b"\xff{"),
    ]
    found = run(tmp_path, rows)
    assert [found.summary[name] for name in ("num_detections", "incomplete", "undecodable")] == [5, 1, 1]


def test_out_of_order_stamps_are_sorted_and_counted(tmp_path: Path) -> None:
    rows = line()
    rows[3], rows[1] = (dataclasses.replace(rows[i], time_s=rows[j].time_s) for i, j in ((1, 3), (3, 1)))
    found = run(tmp_path, rows)
    assert found.detections["x_m"].to_pylist() == [0.0, 3.0, 6.0, 9.0, 12.0]
    assert found.summary["out_of_order"] == 2
    assert not (np.diff(found.detections["time_ns"].to_numpy()) < 0).any()


def test_log_time_instead_of_stamps(tmp_path: Path) -> None:
    row = dataclasses.replace(line()[0], time_s=9.0)
    assert run(tmp_path, [row]).detections["time_ns"].to_pylist() == [START_NS]
    entry = {"topic": "/detections", "time": "log_time"}
    assert run(tmp_path, [row], detections=[entry]).detections["time_ns"].to_pylist() == [START_NS + 9 * 10**9]


def test_simultaneous_detections_of_one_agent_collapse(tmp_path: Path) -> None:
    rows = [*line(sensor="a"), *line(sensor="b"), pose(0, 0, 0)]
    found = run(tmp_path, sorted(rows, key=lambda row: row.time_s))
    assert (found.summary["num_detections"], found.summary["collapsed"]) == (5, 5)
    assert found.detections["num_merged"].to_pylist() == [2] * 5
    assert set(found.detections["sensor_id"].to_pylist()) == {"a+b"}


def test_default_covariance_and_that_of_the_source(tmp_path: Path) -> None:
    assert run(tmp_path, line(), default_sigma_m=3.0).detections["cov_xx_m2"].to_pylist() == [9.0] * 5
    entry = {"topic": "/detections", "sigma_m": 2.0}
    assert run(tmp_path, line(), detections=[entry], default_sigma_m=3.0).detections["cov_yy_m2"].to_pylist() == [4.0] * 5


def test_covariances_that_are_none(tmp_path: Path) -> None:
    bad = [[1.0, 5.0, 5.0, 1.0], [0.0] * 4, [-1.0, 0.0, 0.0, 1.0], [float("nan")] * 4, [1.0, 2.0]]
    found = run(tmp_path, [detection(float(i), i, i, covariance=c) for i, c in enumerate([*bad, [2.0, 1.0, 1.0, 2.0]])])
    assert found.detections["cov_xx_m2"].to_pylist() == [None] * 5 + [2.0]
    assert found.summary["bad_covariance"] == 1  # zeros, -1, NaN and a wrong length say "unknown"


@pytest.mark.parametrize(
    ("start", "end"),
    [(1.0, 3.0), (1, "3"), ("2023-11-14T22:13:21Z", 3.0), ("2023-11-14 22:13:21", "2023-11-14T23:13:23.000+01:00")],
)
def test_time_cut(tmp_path: Path, start: float | str, end: float | str) -> None:
    found = run(tmp_path, line(), start=start, end=end)
    assert (found.detections["x_m"].to_pylist(), found.summary["outside_time_cut"]) == ([3.0, 6.0, 9.0], 2)


def test_time_cuts_that_leave_nothing_or_make_no_sense(tmp_path: Path) -> None:
    fails(mk(tmp_path / "a"), line(), NothingDetectedError, r"inside extract\.start and extract\.end", start=100.0)
    fails(mk(tmp_path / "b"), line(), ConfigError, r"extract\.start 3.0 lies after extract\.end 1.0", start=3.0, end=1.0)
    fails(mk(tmp_path / "c"), line(), ConfigError, "extract: start = 'noon': expected seconds after", start="noon")


def test_only_selected_topics(tmp_path: Path) -> None:
    rows = [*line(), *line(topic="/radar/contacts"), pose(0, 0, 0)]
    found = run(tmp_path, rows, topics=["/rad*", "/truth/*"])
    assert set(found.detections["topic"].to_pylist()) == {"/radar/contacts"}
    assert (found.summary["num_truth"], found.summary["unselected_topics"]) == (1, 1)
    fails(mk(tmp_path / "a"), line(), ConfigError, r"extract\.topics: no topic of the log fits '/rader'", topics=["/rader"])


def test_spikes_are_left_out(tmp_path: Path) -> None:
    rows = [pose(float(i), 5.0 * i, 0.0 if i != 4 else 3e6) for i in range(9)]
    found = run(tmp_path, [*line(), *rows])
    assert (found.summary["num_truth"], found.summary["spikes"]) == (8, 1)
    kept = run(tmp_path, [*line(), *rows], max_speed_mps=1e9)
    assert (kept.summary["num_truth"], kept.summary["spikes"]) == (9, 0)


DENSE = [pose(i / 10, float(i), 0.0, f"/{name}/pose") for i in range(600) for name in ("cub1", "cub2")]


def test_thinning_the_only_dense_channel(tmp_path: Path) -> None:
    thinning = {"enabled": True, "mean_gap_s": 3.0, "mean_burst_s": 1.0, "noise_m": 2.0, "position_floor_m": 1.0}
    found = run(tmp_path, DENSE, thinning=thinning)
    assert found.summary["num_truth"] == 1200 and 100 < found.summary["num_detections"] < 600
    assert set(found.detections["agent_id"].to_pylist()) == {"cub1", "cub2"}
    assert set(found.detections["cov_xx_m2"].to_pylist()) == {5.0}
    error = found.detections["y_m"].to_numpy()
    assert error.std() == pytest.approx(2.0, rel=0.2)
    again = run(tmp_path, DENSE, thinning=thinning)
    assert again.detections.equals(found.detections)
    assert not run(tmp_path, DENSE, thinning={**thinning, "seed": 1}).detections.equals(found.detections)
    pasted = {"poses": [{"topic": "/{sensor}/pose", "message_type": "PoseInFrame"}]}  # as cadence info suggests
    assert run(tmp_path, DENSE, thinning=thinning, **pasted).detections.equals(found.detections)
    alone = run(tmp_path, [row for row in DENSE if row.topic == "/cub1/pose"], thinning=thinning)
    of_cub1 = found.detections.filter(pc.equal(found.detections["agent_id"], "cub1"))
    assert alone.detections["x_m"].equals(of_cub1["x_m"])


def test_thinning_takes_the_truth_or_the_detections(tmp_path: Path) -> None:
    rows = [*line(), *(pose(i / 10, i / 1.0, 50.0) for i in range(600))]
    of_truth = run(tmp_path, rows, thinning={"enabled": True})
    assert set(of_truth.detections["y_m"].to_pylist()) == {50.0} and of_truth.summary["num_truth"] == 600
    contacts = [detection(i / 10, i, 7.0) for i in range(600)]
    thinning = {"enabled": True, "thin_from": "detections"}
    of_contacts = run(tmp_path, [*contacts, pose(0, 0, 0)], thinning=thinning)
    assert 10 < of_contacts.summary["num_detections"] < 300
    fails(mk(tmp_path / "x"), line(), InputError, "no truth to thin", thinning={"enabled": True})
    fails(mk(tmp_path / "y"), contacts, InputError, "no agent", thinning=thinning)
    odd = [Row("/odom", "nav_msgs/Odometry", 1.0, {"pose": {"position": {"x": 1, "y": 1}}}), *DENSE]
    fails(mk(tmp_path / "z"), odd, InputError, r"several dense .*/odom, /\{agent\}/pose", thinning={"enabled": True})
    fails(
        mk(tmp_path / "q"), DENSE[:2], InputError, "thinning left no detection", thinning={"enabled": True, "mean_gap_s": 1e9}
    )


EMPTY = Channel(1, "/contacts/A", "json", "foxglove.LocationFix", "jsonschema", b"{}", 0, {})


def mk(folder: Path) -> Path:
    folder.mkdir()
    return folder


@pytest.mark.parametrize(
    ("channels", "is_known"),
    [
        ([("/contacts/A", "foxglove.LocationFix")], True),  # opened, but nothing was recorded on it
        ([("/truth/A", "foxglove.PoseInFrame"), ("/boat/pose", "foxglove.PoseInFrame")], True),  # it was not even opened
        ([("/truth/A", "foxglove.PoseInFrame"), ("/camera", "my.Image")], False),
        ([("/a", "sensor_msgs/msg/NavSatFix")], False),
        ([("/detections", "my.Own")], False),
    ],
)
def test_whether_nothing_was_detected_or_nothing_is_understood(channels: list[tuple[str, str]], is_known: bool) -> None:
    found = [dataclasses.replace(EMPTY, topic=topic, schema_name=name) for topic, name in channels]
    with pytest.raises(InputError) as caught:
        select_readers(dict.fromkeys(ROLES, ()), True, ThinningConfig(), found)
    assert isinstance(caught.value, NothingDetectedError) == is_known


def test_arrays_without_detections_are_no_fault(tmp_path: Path) -> None:
    silent = [Row("/detections", "vision_msgs/Detection3DArray", float(i), {"detections": []}) for i in range(3)]
    fails(tmp_path, silent, NothingDetectedError, "the topics mapped as detections hold no position")


def test_nothing_to_detect(tmp_path: Path) -> None:
    match = r'nothing looks like detections among /cub1/pose .*topic = "/\{agent\}/pose", or make sparse .*cadence info'
    fails(mk(tmp_path / "a"), DENSE, InputError, match)
    match = r"/imu \(sensor_msgs/Imu\); if one holds them, add \[\[extract\.detections"
    fails(mk(tmp_path / "b"), [Row("/imu", "sensor_msgs/Imu", 1.0, {})], InputError, match)
    assert "no message was recorded" in _no_detections(suggest_mapping([EMPTY]), [EMPTY])
    fails(mk(tmp_path / "c"), [Row("/detections", "my.Own", 1.0, {})], InputError, "the types of /detections are not known")


def test_truth_is_never_advised_as_detections(tmp_path: Path) -> None:
    rows = [dataclasses.replace(row, topic="/truth/boat") for row in DENSE]
    with pytest.raises(NothingDetectedError, match="nothing looks like detections among /truth/boat") as caught:
        run(mk(tmp_path / "a"), rows)
    advice = str(caught.value).partition("; ")[2]
    assert "truth" not in advice and "thinning" not in advice and "[[extract.detections]]" in advice


def test_the_topic_that_was_meant_comes_first(tmp_path: Path) -> None:
    others = [Row(f"/a/{number}", "sensor_msgs/Imu", 1.0, {}) for number in range(12)]
    match = r"no topic of the log is '/detection' \(did you mean '/detections'\?\); topics: /detections \("
    fails(mk(tmp_path / "a"), others + line(), ConfigError, match, detections=[{"topic": "/detection"}])
    match = r"no topic of the log fits '/detektions\*' \(did you mean '/detections'\?\); topics: /detections \("
    fails(mk(tmp_path / "b"), others + line(), ConfigError, match, topics=["/detektions*"])


def test_wrong_configuration(tmp_path: Path) -> None:
    fails(mk(tmp_path / "a"), line(), ConfigError, "no topic of the log is '/conatcts'", detections=[{"topic": "/conatcts"}])
    entry = {"topic": "/detections", "x": "position.x", "y": "position.why"}
    fails(mk(tmp_path / "b"), line(), ConfigError, "no field 'why'; fields there: x, y, z", detections=[entry])
    entry = {"topic": "/detections", "agent_path": "name"}
    fails(mk(tmp_path / "c"), line(), ConfigError, "no field 'name'", detections=[entry])
    entry = {"topic": "/detections", "message_type": "LocationFix"}
    fails(mk(tmp_path / "d"), line(), ConfigError, "no field 'latitude'", detections=[entry])
    fails(mk(tmp_path / "e"), line(), ConfigError, "datum", datum=[91.0, 0.0])
    fails(mk(tmp_path / "f"), line(), ConfigError, r"extract\.thinning: unknown key 'gap'", thinning={"gap": 1})


def test_mixed_frames(tmp_path: Path) -> None:
    other = [detection(9.0, 1, 1, topic="/radar/contacts", frame="radar")]
    fails(
        mk(tmp_path / "a"), [*line(), *other], InputError, r"different frames: /detections \(map\), /radar/contacts \(radar\)"
    )
    fails(mk(tmp_path / "b"), [*line(), fix(9, 50, 1)], InputError, r"latitude and longitude")
    truth = [pose(0, 1, 1, frame="odom")]
    found = run(mk(tmp_path / "c"), [*line(), *truth])
    assert (found.summary["num_truth"], found.summary["other_frame"]) == (0, 1)
    fails(
        mk(tmp_path / "d"), [*line(), *truth], InputError, "not in the mission frame 'map'", truth=[{"topic": "/truth/{agent}"}]
    )
    assert run(mk(tmp_path / "e"), [*line(frame=""), *truth]).frame == Frame("odom")
    assert run(mk(tmp_path / "f"), [*line(frame="/map"), *line(frame="map")]).frame == Frame("map")


def test_damaged_log_is_used_as_far_as_it_goes(tmp_path: Path) -> None:
    log = write_log(tmp_path / "whole.mcap", [*line(2000)])
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(log.read_bytes()[: log.stat().st_size // 2])
    found = run(tmp_path, cut)
    assert not found.summary["is_complete"] and 0 < found.summary["num_detections"] < 2000


def test_suggestions_can_be_switched_off(tmp_path: Path) -> None:
    found = run(tmp_path, [*line(), pose(0, 0, 0)], detections=[{"topic": "/detections"}], suggest=False)
    assert found.summary["num_truth"] == 0 and found.summary["num_unknown_origin"] == 5


def test_real_flight(tmp_path: Path) -> None:
    log = DATA / "flights" / "cubs2_cub_stabilize.mcap"
    if not log.exists():
        pytest.skip("needs ../shared/data/flights")
    found = run(tmp_path, log, thinning={"enabled": True, "mean_gap_s": 8.0, "mean_burst_s": 1.0})
    truth = found.table("truth")
    xyz = np.stack([truth[name].to_numpy() for name in ("x_m", "y_m", "z_m")])
    assert np.linalg.norm(np.diff(xyz), axis=0).sum() == pytest.approx(886, abs=1)
    assert 0.04 < found.summary["num_detections"] / found.summary["num_truth"] < 0.25


def test_real_ships(tmp_path: Path) -> None:
    log = DATA / "maritime" / "solent_ais_known.mcap"
    if not log.exists():
        pytest.skip("needs ../shared/data/maritime")
    found = run(tmp_path, log)
    summary = found.summary
    assert [summary[name] for name in ("num_detections", "num_agents", "spikes")] == [2104, 37, 1]
    assert set(found.detections["cov_xx_m2"].to_pylist()) == {225.0}
    errors = _errors(found.detections, found.table("truth"))
    np.testing.assert_allclose(errors.std(axis=0), 15.0, rtol=0.05)


def _errors(detections: pa.Table, truth: pa.Table) -> np.ndarray:
    """Detection minus truth at its time [N, 2]."""
    found = []
    for agent in set(detections["agent_id"].to_pylist()):
        seen, real = (table.filter(pc.equal(table["agent_id"], agent)) for table in (detections, truth))
        times = (
            (seen["time_ns"].to_numpy() - 17 * 10**17).astype(float),
            (real["time_ns"].to_numpy() - 17 * 10**17).astype(float),
        )
        found.append(np.stack([seen[k].to_numpy() - np.interp(*times, real[k].to_numpy()) for k in ("x_m", "y_m")], axis=1))
    return np.concatenate(found)


def test_real_prison_log(tmp_path: Path) -> None:
    log = DATA / "prison_reference" / "low" / "p_low_0000.mcap"
    if not log.exists():
        pytest.skip("needs ../shared/data/prison_reference")
    summary = run(tmp_path, log).summary
    assert [summary[name] for name in ("num_detections", "collapsed", "num_truth", "num_agents", "num_poses")] == [
        48,
        36,
        361,
        1,
        2166,
    ]


def test_detections_that_do_not_say_whose_they_are_name_their_topics_and_where_identity_usually_stands(tmp_path: Path) -> None:
    entry = {"topic": "/detections", "x": "position.x", "y": "position.y"}
    assert run(mk(tmp_path / "a"), line(), detections=[entry]).summary["unnamed"] == {"/detections": "agent_id"}
    assert run(mk(tmp_path / "b"), line(), detections=[entry | {"agent": "boat"}]).summary["unnamed"] == {}
    assert run(mk(tmp_path / "c"), line(agent_id="T1")).summary["unnamed"] == {}
    assert run(mk(tmp_path / "e"), line()).summary["unnamed"] == {"/detections": None}  # looked for there, and not found
    rows = [dataclasses.replace(row, topic="/contacts") for row in DENSE]
    assert run(mk(tmp_path / "d"), rows).summary["unnamed"] == {"/contacts": None}
