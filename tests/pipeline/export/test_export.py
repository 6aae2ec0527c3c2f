import hashlib
import itertools
import json
import os
import shutil
import subprocess
import sys
from collections import Counter
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest
from fixtures.mission import (
    DURATION_NS,
    FIRST_ORIGIN_NS,
    FRAME,
    GEOREFERENCED,
    NUM_HYPOTHESES,
    NUM_WINDOWS,
    OBSTACLES,
    START_NS,
    STRIDE_NS,
    build_mission,
    make_uncertain,
)
from fixtures.side_files import assert_near, read_hypotheses
from foxglove_schemas_protobuf.GeoJSON_pb2 import GeoJSON
from foxglove_schemas_protobuf.Grid_pb2 import Grid
from foxglove_schemas_protobuf.LinePrimitive_pb2 import LinePrimitive
from foxglove_schemas_protobuf.LocationFix_pb2 import LocationFix
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory

from cadence.errors import InputError
from pipeline.export import numbers
from pipeline.export.config import ExportConfig
from pipeline.export.maps import plan_map
from pipeline.export.mission import num_vertices
from pipeline.export.playback import LiveAgent, Scene, Tick, build_scenes, plan_ticks
from pipeline.export.stage import export
from pipeline.frames import to_local
from pipeline.progress import Progress
from pipeline.results import read_hypothesis_tables
from pipeline.tables import read_table, write_table
from schemas.channels import message_class

QUIET = Progress(quiet=True)
CONFIG = ExportConfig()


@pytest.fixture(scope="module")
def mission(tmp_path_factory):
    directory = build_mission(tmp_path_factory.mktemp("plain"))
    export(directory, CONFIG, QUIET)
    return directory


@pytest.fixture(scope="module")
def georeferenced(tmp_path_factory):
    directory = build_mission(tmp_path_factory.mktemp("earth"), frame=GEOREFERENCED)
    export(directory, CONFIG, QUIET)
    return directory


def messages(directory, topic, kind=None):
    """(log time, decoded message) of a topic."""
    with (directory / "patrol.cadence.mcap").open("rb") as file:
        rows = [(m.log_time, m.data) for _, _, m in make_reader(file, validate_crcs=True).iter_messages(topics=[topic])]
    return [(time_ns, kind.FromString(data) if kind else data) for time_ns, data in rows]


def with_frame(directory, name, change):
    table, frame = read_table(directory / f"{name}.parquet", name)
    write_table(change(table), directory / f"{name}.parquet", name, frame)


def test_file_opens_with_checksums_and_counts_agree(mission, georeferenced):
    for directory in (mission, georeferenced):
        with (directory / "patrol.cadence.mcap").open("rb") as file:
            reader = make_reader(file, validate_crcs=True, decoder_factories=[DecoderFactory()])
            statistics = reader.get_summary().statistics
            counts, last = Counter(), 0
            for _, channel, message, decoded in reader.iter_decoded_messages(log_time_order=False):
                counts[channel.id] += 1
                assert message.log_time >= last, "messages must lie in the order of time, so that chunks do not overlap"
                last = message.log_time
                if hasattr(decoded, "timestamp"):
                    assert decoded.timestamp.ToNanoseconds() == message.log_time
            assert dict(statistics.channel_message_counts) == counts
            assert statistics.message_count == sum(counts.values())
            assert all(chunk.compression == "zstd" for chunk in reader.get_summary().chunk_indexes)


def test_hypotheses_round_trip_to_a_hundredth_of_their_spread(mission, georeferenced):
    for directory in (mission, georeferenced):
        written, back = read_hypothesis_tables(directory), read_hypotheses(directory / "patrol.cadence.mcap")
        assert (back.frame, back.agent_ids, len(back.windows)) == (written.frame, written.agent_ids, NUM_WINDOWS)
        for ours, theirs in zip(back.windows, written.windows, strict=True):
            for name in ("log_id", "window", "origin_ns", "step_ns", "origin_index", "num_steps"):
                assert getattr(ours, name) == getattr(theirs, name)
            assert ours.weight.tobytes() == theirs.weight.tobytes()
            assert ours.hypothesis.tobytes() == theirs.hypothesis.tobytes()
            for agent, expected in zip(ours.agents, theirs.agents, strict=True):
                for name in ("agent_id", "status", "advice", "num_detections", "age_s", "spread_m", "datum_m"):
                    assert getattr(agent, name) == getattr(expected, name)
                assert_near(agent.position_m, expected.position_m, theirs.weight)


def test_positions_are_views_of_the_table(mission):
    window = read_hypothesis_tables(mission).windows[0]
    assert not window.agents[0].position_m.flags.owndata
    assert np.shares_memory(window.agents[0].position_m.base, window.agents[1].position_m.base)


def test_rows_in_any_order_give_the_same(mission, tmp_path):
    directory = build_mission(tmp_path)
    rng = np.random.default_rng(3)
    with_frame(directory, "hypotheses", lambda table: table.take(rng.permutation(table.num_rows)))
    shuffled, straight = read_hypothesis_tables(directory), read_hypothesis_tables(mission)
    for ours, theirs in zip(shuffled.windows, straight.windows, strict=True):
        for agent, expected in zip(ours.agents, theirs.agents, strict=True):
            assert np.array_equal(agent.position_m, expected.position_m)


FIRST, LAST = START_NS + FIRST_ORIGIN_NS, START_NS + FIRST_ORIGIN_NS + (NUM_WINDOWS - 1) * STRIDE_NS


def lines_of(directory, num=0):
    """Past and future lines of the first agent in a scene."""
    lines = messages(directory, "/cadence/scene", SceneUpdate)[num][1].entities[0].lines
    thick = {line.thickness for line in lines}
    assert len(thick) == 4, "past and future, hypotheses and the central one: each has its thickness"
    past = [line for line in lines if line.thickness in (1.5, 4.0)]
    return past, [line for line in lines if line not in past]


def test_lines_are_written_once_a_window_and_what_moves_each_tick(mission):
    scenes, present = (dict(messages(mission, f"/cadence/{topic}", SceneUpdate)) for topic in ("scene", "present"))
    assert len(scenes) == NUM_WINDOWS + 1
    assert len(present) > 10 * len(scenes)
    for shown in (scenes, present):
        assert all(len(update.deletions) == 1 for update in shown.values()), "one may go to any moment"
        assert {e.id for e in shown[FIRST].entities} >= {"agent/T0", "agent/T1"}
        assert {e.id for e in shown[LAST].entities if e.id.startswith("agent/")} == {"agent/T0"}
        assert not shown[max(shown)].entities, "after the end of the last window nothing is shown"
    assert all(not entity.lines for update in present.values() for entity in update.entities)


def test_past_and_future_are_whole_lines_that_differ(mission):
    past, future = lines_of(mission)
    assert len(past) == len(future) == NUM_HYPOTHESES + 1
    assert {line.type for line in (*past, *future)} == {LinePrimitive.LINE_STRIP}
    assert max(line.thickness for line in past) > max(line.thickness for line in future)
    assert past[0].color.r < future[0].color.r, "the future is lighter"
    assert past[0].color.a > future[0].color.a, "and fainter"
    ends = {(line.points[-1].x, line.points[-1].y) for line in past}
    assert {(line.points[0].x, line.points[0].y) for line in future} == ends, "each future begins where its past ends"


def test_detections_are_seen_from_their_time_on(mission):
    used, since = (messages(mission, f"/cadence/{topic}", SceneUpdate) for topic in ("scene", "present"))
    table, _ = read_table(mission / "detections.parquet", "detections")
    time_ns = np.sort(table["time_ns"].to_numpy()[np.array(table["agent_id"]) == "T0"])

    def num_seen(update):
        return sum(len(entity.spheres) for entity in update.entities if entity.id == "detections/T0")

    for now_ns, update in since[:: len(since) // 9]:
        origin_ns, scene = max((item for item in used if item[0] <= now_ns), key=lambda item: item[0])
        if scene.entities:
            assert num_seen(update) == np.count_nonzero((time_ns > origin_ns) & (time_ns <= now_ns))
            start_ns = origin_ns - 63 * 1_000_000_000
            assert num_seen(scene) == np.count_nonzero((time_ns >= start_ns) & (time_ns <= origin_ns))


def test_line_opacity_follows_the_weights(mission):
    window = read_hypothesis_tables(mission).windows[0]
    past, _ = lines_of(mission)
    track_m = window.agents[0].position_m[:, window.origin_index] + np.array(window.agents[0].datum_m)
    alpha = {}
    for line in past[:-1]:
        end_m = np.array([line.points[-1].x, line.points[-1].y])
        alpha[int(np.linalg.norm(track_m - end_m, axis=-1).argmin())] = line.color.a
    assert len(alpha) == NUM_HYPOTHESES
    assert min(alpha.values()) > 0.05
    assert np.corrcoef([alpha[k] for k in range(NUM_HYPOTHESES)], window.weight)[0, 1] > 0.99


def test_lines_follow_the_hypotheses_with_few_points(mission):
    window = read_hypothesis_tables(mission).windows[0]
    agent = window.agents[0]
    tracks = agent.position_m.astype(np.float64) + agent.datum_m
    reach_m = np.ptp(tracks, axis=(0, 1)).max()
    for line in lines_of(mission)[0]:
        drawn = np.array([[point.x, point.y] for point in line.points])
        track = min(tracks, key=lambda track: np.linalg.norm(track[[0, window.origin_index]] - drawn[[0, -1]], axis=-1).sum())
        dense = np.concatenate([a + np.linspace(0, 1, 200)[:, None] * (b - a) for a, b in itertools.pairwise(drawn)])
        away = np.linalg.norm(track[: window.origin_index + 1, None] - dense, axis=-1).min(axis=1)
        assert away.max() <= reach_m / 300
        assert len(drawn) < window.origin_index


def test_the_thick_line_is_one_of_the_hypotheses():
    rng = np.random.default_rng(2)
    side = np.where(np.arange(21) % 3, 1.0, -1.0)[:, None]
    x_m = np.broadcast_to(np.linspace(0.0, 100.0, 9), (21, 9))
    y_m = side * 30.0 * np.sin(np.linspace(0.0, np.pi, 9)) + rng.normal(0, 1.0, (21, 1))
    live = LiveAgent(None, None, np.arange(21), np.full(21, 1 / 21), np.stack([x_m, y_m], axis=-1))
    assert side[live.central, 0] == 1.0, "of the larger group, not between the two"
    assert abs(live.mean_m[4, 1]) < 15.0


def test_only_the_heaviest_hypotheses_are_drawn(tmp_path):
    directory = build_mission(tmp_path)
    export(directory, ExportConfig(num_scene_hypotheses=3), QUIET)
    entity = messages(directory, "/cadence/scene", SceneUpdate)[0][1].entities[0]
    assert len(entity.lines) == 2 * (3 + 1)
    assert max(line.color.a for line in entity.lines if line.thickness < 2.0) == pytest.approx(0.65, abs=0.02)


def test_agents_at_an_origin_are_the_numbers_of_infer(mission):
    found = dict(messages(mission, "/cadence/agents", message_class("cadence.Agents")))
    table = read_hypothesis_tables(mission)
    for window in table.windows:
        states = {state.id: state for state in found[window.origin_ns].agents}
        assert set(states) == {agent.agent_id for agent in window.agents if agent.is_live}
        for agent in window.agents:
            if agent.is_live:
                state = states[agent.agent_id]
                assert state.age_s == pytest.approx(agent.age_s, abs=1e-3)
                assert state.num_detections == agent.num_detections
                now = agent.position_m[:, window.origin_index].astype(np.float64)
                mean = np.average(now, axis=0, weights=window.weight)
                spread = np.sqrt(np.average(np.sum((now - mean) ** 2, axis=-1), weights=window.weight))
                assert state.spread_m == pytest.approx(spread, abs=1e-3)
                assert [state.x_m, state.y_m] == pytest.approx(mean + agent.datum_m, abs=1e-3)
                assert 0.0 < state.entropy <= 1.0
                assert state.num_modes >= 1
                assert state.speed_mps == pytest.approx(3.0, rel=0.6)


def test_occupancy_is_a_probability_and_clears_at_the_end(mission):
    found = messages(mission, "/cadence/occupancy", Grid)
    assert len(found) == NUM_WINDOWS + 1
    grid = found[0][1]
    cells = np.frombuffer(grid.data, dtype=[("probability", "<f4"), ("rgba", "u1", (4,))])
    assert grid.column_count <= CONFIG.occupancy_cells
    assert len(cells) % grid.column_count == 0
    assert len(cells) // grid.column_count <= CONFIG.occupancy_cells
    assert 0.0 <= cells["probability"].min()
    assert 0.05 < cells["probability"].max() <= 1.0
    assert np.array_equal(cells["rgba"][:, 3] > 0, cells["probability"] > 0)
    assert not np.frombuffer(found[-1][1].data, np.uint8)[4 + 3 :: 8].any()


def test_detections_as_used(mission):
    found = messages(mission, "/cadence/detections", message_class("cadence.Detection"))
    table, _ = read_table(mission / "detections.parquet", "detections")
    assert [time_ns for time_ns, _ in found] == table["time_ns"].to_pylist()
    assert np.abs(np.array([d.x_m for _, d in found]) - table["x_m"].to_numpy()).max() <= 0.01 * 4.0, "of its sigma"
    assert [d.agent_id for _, d in found] == table["agent_id"].to_pylist()
    assert not found[0][1].HasField("z_m")
    assert found[0][1].cov_xx_m2 == 16.0


def test_obstacles_once(mission):
    ((_, update),) = messages(mission, "/cadence/obstacles", SceneUpdate)
    assert [entity.id for entity in update.entities] == ["obstacle/0/mast", "obstacle/1/polygon"]
    circle = update.entities[0].lines[0]
    radius = [np.hypot(p.x - 1700.0, p.y + 100.0) for p in circle.points]
    assert radius == pytest.approx([40.0] * len(radius), abs=0.1)
    assert len(update.entities[1].lines) == 3 * len(OBSTACLES["obstacles"][1]["rings_m"])


def test_frame_of_the_log_is_left_alone_and_ours_is_introduced(mission, georeferenced):
    assert not messages(mission, "/cadence/tf")
    assert len(messages(georeferenced, "/cadence/tf")) == 1


def test_georeferenced_fixes_and_regions(mission, georeferenced):
    assert not messages(mission, "/cadence/map")
    states = dict(messages(georeferenced, "/cadence/agents", message_class("cadence.Agents")))
    fixes = messages(georeferenced, "/cadence/fix/T0", LocationFix)
    assert NUM_WINDOWS <= len(fixes) < len(states), "where the mean moves, and with each new window"
    for time_ns, fix in fixes[::20]:
        state = next(state for state in states[time_ns].agents if state.id == "T0")
        x_m, y_m = to_local(GEOREFERENCED, np.array([fix.latitude]), np.array([fix.longitude]))
        assert [x_m[0], y_m[0]] == pytest.approx([state.x_m, state.y_m], abs=0.01)
        assert fix.position_covariance[0] + fix.position_covariance[4] == pytest.approx(state.spread_m**2, rel=1e-3)
    regions = messages(georeferenced, "/cadence/map", GeoJSON)
    assert 1 <= len(regions) <= 4
    features = json.loads(regions[0][1].geojson)["features"]
    assert [f["properties"]["name"] for f in features] == [
        f"{a} {kind}" for a in ("T0", "T1") for kind in ("90%", "50%", "mean")
    ]
    assert {f["geometry"]["type"] for f in features} <= {"Polygon", "MultiPolygon", "LineString"}
    longitude, latitude = features[2]["geometry"]["coordinates"][0]
    assert (latitude, longitude) == pytest.approx((50.8, -1.2), abs=0.1)
    assert len(messages(georeferenced, "/cadence/detection_fix/T1", LocationFix)) == 24


def test_metadata_tells_what_made_the_file(mission):
    with (mission / "patrol.cadence.mcap").open("rb") as file:
        (record,) = make_reader(file).iter_metadata()
    assert record.name == "cadence"
    assert record.metadata["seed"] == "11"
    assert record.metadata["checkpoint_sha256"] == "ab" * 32
    source = (mission.parent / "patrol.mcap").read_bytes()
    assert record.metadata["source_sha256"] == hashlib.sha256(source).hexdigest()
    assert json.loads(record.metadata["config.infer"])["checkpoint"] == "general"
    assert "numpy" in json.loads(record.metadata["versions"])


def test_same_input_same_bytes_and_second_run_is_skipped(mission, tmp_path):
    other = build_mission(tmp_path)
    (other / "catalogue.json").write_bytes((mission / "catalogue.json").read_bytes())
    for stage in ("ingest", "infer"):
        (other / f"{stage}.manifest.json").write_bytes((mission / f"{stage}.manifest.json").read_bytes())
    assert export(other, CONFIG, QUIET).status == "done"
    for name in ("patrol.cadence.mcap", "patrol.layout.json", "patrol.layout.legacy.json"):
        assert (other / name).read_bytes() == (mission / name).read_bytes()
    assert export(other, CONFIG, QUIET).status == "skipped"
    assert export(other, ExportConfig(tick_s=5.0), QUIET).status == "done"


def test_source_is_untouched_and_combined_holds_all_of_it(tmp_path):
    directory = build_mission(tmp_path)
    source = tmp_path / "patrol.mcap"
    before = source.read_bytes()
    export(directory, ExportConfig(combined=True, tick_s=10.0), QUIET)
    assert source.read_bytes() == before

    def content(path):
        with path.open("rb") as file:
            reader = make_reader(file, validate_crcs=True)
            rows = [
                (c.topic, s.name if s else "", m.log_time, m.publish_time, m.sequence, m.data)
                for s, c, m in reader.iter_messages()
            ]
            attachments = [(a.name, a.data) for a in reader.iter_attachments()]
            return rows, attachments, [(m.name, m.metadata) for m in reader.iter_metadata()]

    combined, parts = content(directory / "patrol.combined.mcap"), [content(source), content(directory / "patrol.cadence.mcap")]
    for index in range(3):
        assert sorted(combined[index], key=repr) == sorted(parts[0][index] + parts[1][index], key=repr)
    assert [row[2] for row in combined[0]] == sorted(row[2] for row in combined[0])
    assert read_hypotheses(directory / "patrol.combined.mcap").agent_ids == ("T0", "T1")


def test_damaged_source_gives_one_line_and_no_file(tmp_path):
    directory = build_mission(tmp_path)
    source = tmp_path / "patrol.mcap"
    source.write_bytes(source.read_bytes()[:-3000])
    with pytest.raises(InputError, match=r"patrol\.mcap.*combined"):
        export(directory, ExportConfig(combined=True), QUIET)
    assert not list(directory.glob("*.mcap"))
    assert not [path for path in directory.iterdir() if path.name.startswith(".")]


def test_log_that_was_damaged_when_it_was_ingested_is_not_combined(tmp_path):
    (tmp_path / "sound").mkdir()
    build_mission(tmp_path / "sound")
    log = tmp_path / "patrol.mcap"
    log.write_bytes((tmp_path / "sound" / "patrol.mcap").read_bytes()[:-3000])
    directory = build_mission(tmp_path, log=log)
    with pytest.raises(InputError, match=r"patrol\.mcap: is damaged .* export without combined") as caught:
        export(directory, ExportConfig(combined=True), QUIET)
    assert "\n" not in str(caught.value)
    assert export(directory, CONFIG, QUIET).status == "done"
    assert not (directory / "patrol.combined.mcap").exists()


def test_recording_in_parts_is_not_combined(tmp_path):
    directory = build_mission(tmp_path)
    catalogue = json.loads((directory / "catalogue.json").read_text())
    part = {"path": catalogue["path"], "sha256": catalogue["sha256"], "size_bytes": catalogue["size_bytes"]}
    catalogue["parts"] = [part, part]
    (directory / "catalogue.json").write_text(json.dumps(catalogue))
    with pytest.raises(InputError, match="is one part of 2, which cannot be combined") as caught:
        export(directory, ExportConfig(combined=True), QUIET)
    assert "\n" not in str(caught.value)
    assert not list(directory.glob("*.mcap"))


def test_lines_have_fewer_points_where_there_are_many(mission):
    scenes = build_scenes(read_hypothesis_tables(mission))
    assert num_vertices(scenes, ExportConfig()) == 48
    assert num_vertices(scenes * 100, ExportConfig(max_scene_mb=6.0)) == 15
    assert num_vertices(scenes * 100, ExportConfig(max_scene_mb=0.1)) == 4
    assert num_vertices(scenes, ExportConfig(max_vertices=40)) == 40


@pytest.mark.parametrize(
    "name", ["hypotheses.parquet", "windows.parquet", "detections.parquet", "catalogue.json", "obstacles.json"]
)
def test_missing_input_gives_one_line(tmp_path, name):
    directory = build_mission(tmp_path)
    (directory / name).unlink()
    with pytest.raises(InputError) as caught:
        export(directory, CONFIG, QUIET)
    assert name in str(caught.value)
    assert "\n" not in str(caught.value)


def test_incomplete_hypotheses_are_refused(tmp_path):
    directory = build_mission(tmp_path)
    with_frame(directory, "hypotheses", lambda table: table.slice(1))
    with pytest.raises(InputError, match="window 0 does not hold the same hypotheses"):
        export(directory, CONFIG, QUIET)


def test_mission_without_any_hypothesis_still_exports_detections(tmp_path):
    directory = build_mission(tmp_path)
    with_frame(directory, "hypotheses", lambda table: table.slice(0, 0))
    summary = export(directory, CONFIG, QUIET).summary
    assert summary["num_messages"]["/cadence/detections"] == 48
    back = read_hypotheses(directory / "patrol.cadence.mcap")
    assert [agent.status for agent in back.windows[-1].agents] == ["ok", "no_detections"]


def test_not_finite_hypotheses_are_not_drawn(tmp_path):
    directory = build_mission(tmp_path)

    def spoil(table):
        values = np.array(table["position_m"].combine_chunks().flatten().flatten().to_numpy(zero_copy_only=False))
        values[:2] = np.nan
        column = pa.FixedSizeListArray.from_arrays(pa.FixedSizeListArray.from_arrays(pa.array(values), 2), 96)
        index = table.schema.get_field_index("position_m")
        return table.set_column(index, table.schema.field(index), column.cast(table.schema.field(index).type))

    with_frame(directory, "hypotheses", spoil)
    export(directory, CONFIG, QUIET)
    lines = messages(directory, "/cadence/scene", SceneUpdate)[0][1].entities[0].lines
    assert len(lines) == 2 * NUM_HYPOTHESES
    assert np.isfinite([[p.x, p.y] for line in lines for p in line.points]).all()
    assert np.isnan(read_hypotheses(directory / "patrol.cadence.mcap").windows[0].agents[0].position_m[0, 0]).all()


def test_stamps_of_another_clock_are_brought_to_the_logs(tmp_path):
    directory = build_mission(tmp_path)
    shift = 1_699_999_000_000_000_000

    def earlier(column):
        return lambda table: table.set_column(
            table.schema.get_field_index(column),
            table.schema.field(column),
            pa.array(table[column].to_numpy() - shift),
        )

    with_frame(directory, "detections", earlier("time_ns"))
    with_frame(directory, "hypotheses", earlier("origin_ns"))
    with_frame(directory, "windows", earlier("origin_ns"))
    assert export(directory, CONFIG, QUIET).summary["clock_offset_s"] == pytest.approx(shift * 1e-9)
    times = [time_ns for time_ns, _ in messages(directory, "/cadence/scene")]
    assert START_NS <= min(times)
    assert max(times) <= START_NS + DURATION_NS
    assert read_hypotheses(directory / "patrol.cadence.mcap").windows[0].origin_ns == START_NS + FIRST_ORIGIN_NS - shift


def test_ticks():
    scenes = [Scene(origin, origin - 5, end, (), ()) for origin, end in ((0, 10), (4, 14), (5, 15), (40, 50))]

    def planned(tick_ns, end_ns):
        return [(t.time_ns, scenes.index(t.scene) if t.scene else None) for t in plan_ticks(scenes, tick_ns, end_ns)]

    assert planned(2, 44) == [
        *((0, 0), (2, 0), (4, 1), (6, 2), (8, 2), (10, 2), (12, 2), (14, 2), (16, None)),
        *((40, 3), (42, 3), (44, 3)),
    ], "the origin at 5 comes too soon after 4; nothing is live from 16 to 40; the log ends at 44"
    assert planned(3, 44)[:4] == [(0, 0), (4, 1), (7, 2), (10, 2)], "a tick is moved to an origin that is near"
    assert planned(100, 44) == [(0, 0)]
    assert plan_ticks([], 2, 44) == []


def test_scene_size_stays_under_the_cap(tmp_path):
    directory = build_mission(tmp_path)
    small = export(directory, ExportConfig(max_scene_mb=0.05), QUIET).summary
    assert small["tick_s"] > 1.0
    for topic in ("scene", "present"):
        assert sum(len(data) for _, data in messages(directory, f"/cadence/{topic}")) < 0.1e6


def test_regions_of_the_map_lie_one_behind_the_other_and_never_ahead():
    scenes = [Scene(origin, origin - 10, origin + 5, (), (None,)) for origin in (0, 4, 8, 12, 40, 43)]
    ticks = [Tick(scene.origin_ns, scene) for scene in scenes]
    assert plan_map(ticks, None) == {0: -10, 3: 2, 4: 30, 5: 40}
    assert plan_map(ticks, 4e-9) == {0: -10, 1: 0, 2: 4, 3: 8, 4: 30, 5: 40}


def test_modes_are_counted():
    rng = np.random.default_rng(0)
    cloud = rng.normal(0, 1, (60, 2))
    weight = np.full(60, 1 / 60)
    assert numbers.count_modes(cloud, weight) == 1
    assert numbers.count_modes(np.where(np.arange(60)[:, None] % 2, cloud, cloud + np.array([30.0, 0.0])), weight) == 2
    assert numbers.count_modes(cloud[:1], weight[:1]) == 1


def test_weighted_quantile_by_hand():
    value = np.array([[3.0], [1.0], [2.0]])
    assert numbers.weighted_quantile(value, np.array([0.1, 0.5, 0.4]), 0.5) == pytest.approx([1.0])
    assert numbers.weighted_quantile(value, np.array([0.1, 0.5, 0.4]), 0.9) == pytest.approx([2.0])
    assert numbers.weighted_quantile(value, np.array([0.1, 0.5, 0.4]), 0.95) == pytest.approx([3.0])


def test_translating_the_frame_translates_the_scene(mission, tmp_path):
    directory = build_mission(tmp_path)
    for name, column in (("hypotheses", "datum_x_m"), ("detections", "x_m")):
        with_frame(
            directory,
            name,
            lambda table, column=column: table.set_column(
                table.schema.get_field_index(column), table.schema.field(column), pa.array(table[column].to_numpy() + 4096.0)
            ),
        )
    export(directory, CONFIG, QUIET)
    for (_, ours), (_, theirs) in zip(
        messages(directory, "/cadence/scene", SceneUpdate), messages(mission, "/cadence/scene", SceneUpdate), strict=True
    ):
        for entity, expected in zip(ours.entities, theirs.entities, strict=True):
            for line, other in zip(entity.lines, expected.lines, strict=True):
                assert [p.x - 4096.0 for p in line.points] == [p.x for p in other.points]
                assert [p.y for p in line.points] == [p.y for p in other.points]


@pytest.mark.parametrize("bad", [{"tick_s": 0.0}, {"max_vertices": 1}, {"num_scene_hypotheses": 0}, {"max_scene_mb": -1.0}])
def test_config_is_checked(bad):
    with pytest.raises(ValueError, match=next(iter(bad))):
        ExportConfig(**bad)


def test_rerun_accepts_the_files(tmp_path):
    rerun = shutil.which("rerun", path=os.pathsep.join([str(Path(sys.executable).parent), os.environ.get("PATH", "")]))
    if rerun is None:
        pytest.skip("rerun-sdk is not installed (development only)")
    for frame in (FRAME, GEOREFERENCED):
        (tmp_path / frame.frame_id).mkdir()
        directory = build_mission(tmp_path / frame.frame_id, frame=frame)
        export(directory, ExportConfig(combined=True), QUIET)
        for kind in ("cadence", "combined"):
            command = [rerun, "mcap", "check", "--full", directory / f"patrol.{kind}.mcap"]
            subprocess.run(command, check=True, capture_output=True, timeout=60)


def test_how_likely_an_agent_is_there_stands_beside_its_name(tmp_path):
    directory = build_mission(tmp_path, frame=GEOREFERENCED)
    make_uncertain(directory, {"T0": 0.996, "T1": 0.62})
    export(directory, CONFIG, QUIET)
    scenes = [scene for _, scene in messages(directory, "/cadence/present", SceneUpdate)]
    texts = {label.text for scene in scenes for entity in scene.entities for label in entity.texts}
    assert texts == {"T0 (there: > 99 %)", "T1 (there: 62 %)"}
    maps = [json.loads(message.geojson) for _, message in messages(directory, "/cadence/map", GeoJSON)]
    names = {feature["properties"]["name"] for each in maps for feature in each["features"]}
    assert {name.partition(")")[0] + ")" for name in names} == texts
