"""Clouds, fixes and voxels: what viewers without scenes and grids draw, and that the side file hardly grows by it."""

import io
import re
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from fixtures.mission import FRAME, GEOREFERENCED, NUM_HYPOTHESES, build_mission
from foxglove_schemas_protobuf.Grid_pb2 import Grid
from foxglove_schemas_protobuf.LocationFixes_pb2 import LocationFixes
from foxglove_schemas_protobuf.PointCloud_pb2 import PointCloud
from foxglove_schemas_protobuf.VoxelGrid_pb2 import VoxelGrid
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer

from pipeline.catalogue import read_catalogue
from pipeline.export.clouds import plan_clouds
from pipeline.export.config import ExportConfig
from pipeline.export.mission import Exported, read_exported
from pipeline.export.sizes import reach_m
from pipeline.export.stage import export
from pipeline.frames import to_local
from pipeline.progress import Progress

RERUN = shutil.which("rerun") or shutil.which("rerun", path=str(Path(sys.executable).parent))
NEW = {"/cadence/cloud", "/cadence/fixes", "/cadence/occupancy_voxels"}


@pytest.fixture(scope="module")
def exported(tmp_path_factory) -> tuple[Exported, Path]:
    directory = build_mission(tmp_path_factory.mktemp("clouds"), frame=GEOREFERENCED)
    export(directory, ExportConfig(), Progress(quiet=True))
    return read_exported(directory, read_catalogue(directory), ExportConfig()), directory / "patrol.cadence.mcap"


def messages(path: Path, topic: str, kind) -> list[tuple[int, object]]:
    with path.open("rb") as file:
        return [(m.log_time, kind.FromString(m.data)) for _, _, m in make_reader(file).iter_messages(topics=[topic])]


def points_of(cloud: PointCloud) -> np.ndarray:
    """The points by the fields that the message itself states."""
    kinds = {1: "u1", 7: "<f4"}
    names, formats, offsets = zip(*((f.name, kinds[f.type], f.offset) for f in cloud.fields), strict=True)
    return np.frombuffer(
        cloud.data, np.dtype({"names": names, "formats": formats, "offsets": offsets, "itemsize": cloud.point_stride})
    )


def test_a_cloud_shows_every_hypothesis_now_by_colour_and_weight(exported):
    mission, side = exported
    ticks = {tick.time_ns: tick for tick in mission.ticks}
    clouds = messages(side, "/cadence/cloud", PointCloud)
    assert len(clouds) > 5 and clouds[0][0] == mission.ticks[0].time_ns and clouds[-1][0] == mission.ticks[-1].time_ns
    for time_ns, cloud in clouds:
        scene = ticks[time_ns].scene
        points = points_of(cloud)
        live = scene.live if scene else ()
        assert cloud.frame_id == GEOREFERENCED.frame_id and len(points) == NUM_HYPOTHESES * len(live)
        for index, agent in enumerate(live):
            own = points[index * NUM_HYPOTHESES : (index + 1) * NUM_HYPOTHESES]
            place = np.stack([own["x"] + cloud.pose.position.x, own["y"] + cloud.pose.position.y], -1)
            assert np.abs(place - agent.at(time_ns)).max() <= reach_m(agent) / 1024 + 1e-3
            assert (np.diff(own["alpha"][np.argsort(agent.weight)].astype(int)) >= 0).all() and own["alpha"].max() == 255
            color = np.round(255 * mission.style.color(agent.agent.agent_id)[:3])
            assert all((own[name] == color[axis]).all() for axis, name in enumerate(("red", "green", "blue")))


def test_fixes_are_the_heaviest_hypotheses_in_degrees(exported):
    mission, side = exported
    ticks = {tick.time_ns: tick for tick in mission.ticks}
    found = messages(side, "/cadence/fixes", LocationFixes)
    assert len(found) > 1
    for time_ns, message in found:
        assert len(message.fixes) == 10 * len(ticks[time_ns].scene.live), "one without fixes would be read as none at all"
        first = ticks[time_ns].scene.live[0]
        heaviest = np.sort(np.argsort(-first.weight, kind="stable")[:10])
        lat, lon = (np.array([getattr(fix, name) for fix in message.fixes[:10]]) for name in ("latitude", "longitude"))
        place = np.stack(to_local(GEOREFERENCED, lat, lon), -1)
        assert np.abs(place - first.at(time_ns)[heaviest]).max() < 0.1
        assert all(fix.timestamp.ToNanoseconds() == time_ns and 0 < fix.color.a <= 1 for fix in message.fixes)


def test_voxels_stand_where_the_grid_does(exported):
    _, side = exported
    pairs = list(
        zip(messages(side, "/cadence/occupancy", Grid), messages(side, "/cadence/occupancy_voxels", VoxelGrid), strict=True)
    )
    assert len(pairs) == 7
    for (grid_ns, grid), (voxel_ns, voxels) in pairs:
        assert grid_ns == voxel_ns and voxels.pose == grid.pose and voxels.cell_size.x == 2 * grid.cell_size.x
        cells = np.frombuffer(voxels.data, np.uint8).reshape(voxels.row_count, voxels.column_count)
        assert (voxels.row_stride, voxels.slice_stride) == (voxels.column_count, cells.size)
        values = np.frombuffer(grid.data, "<f4").reshape(-1, grid.column_count, 2)[..., 0]
        for row, column in ((0, 0), (cells.shape[0] // 2, cells.shape[1] // 2), (cells.shape[0] - 1, cells.shape[1] - 1)):
            most = values[2 * row : 2 * row + 2, 2 * column : 2 * column + 2].max()
            assert cells[row, column] == round(255 * float(np.sqrt(most)))
        assert cells.any() or grid.column_count == 1


def test_the_side_file_grows_by_less_than_a_fifth(exported):
    _, side = exported
    sizes = []
    for left_out in (set(), NEW):
        file = io.BytesIO()
        writer = Writer(file, compression=CompressionType.ZSTD)
        writer.start("", "test")
        numbers: dict[str, int] = {}
        with side.open("rb") as source:
            for schema, channel, message in make_reader(source).iter_messages():
                if channel.topic not in left_out:
                    if channel.topic not in numbers:
                        known = writer.register_schema(schema.name, schema.encoding, schema.data)
                        numbers[channel.topic] = writer.register_channel(channel.topic, "protobuf", known)
                    writer.add_message(numbers[channel.topic], message.log_time, message.data, message.publish_time)
        writer.finish()
        sizes.append(len(file.getvalue()))
    assert sizes[0] < 1.2 * sizes[1]


def test_clouds_come_as_often_as_there_is_room(exported):
    mission, _ = exported
    windows = mission.hypotheses.windows
    few = plan_clouds(mission.ticks, windows[:1], 30, True)
    all_of = plan_clouds(mission.ticks, windows, 30, True)
    assert 2 <= len(few.clouds) < len(all_of.clouds) <= len(mission.ticks) and 0 in few.clouds
    assert not plan_clouds(mission.ticks, windows, 30, False).fixes, "degrees only where there are any"
    assert plan_clouds([], (), 30, True).clouds == frozenset()
    gaps = np.diff(sorted(all_of.clouds))
    assert len(set(gaps[:-1].tolist())) == 1, "evenly"


def test_logs_in_metres_have_no_fixes(tmp_path):
    directory = build_mission(tmp_path, frame=FRAME)
    export(directory, ExportConfig(), Progress(quiet=True))
    assert not messages(directory / "patrol.cadence.mcap", "/cadence/fixes", LocationFixes)
    assert messages(directory / "patrol.cadence.mcap", "/cadence/cloud", PointCloud)


@pytest.mark.skipif(RERUN is None, reason="rerun-sdk is not installed (the extra `viewer`)")
def test_rerun_draws_them_without_a_script(exported, tmp_path):
    _, side = exported
    made = subprocess.run(
        [RERUN, "mcap", "convert", side, "-o", tmp_path / "a.rrd"], capture_output=True, text=True, check=True
    )
    assert "ERROR" not in made.stderr
    told = subprocess.run([RERUN, "rrd", "print", "-vv", tmp_path / "a.rrd"], capture_output=True, text=True, check=True).stdout
    drawn = {
        "/cadence/cloud": "Points3D:positions",
        "/cadence/fixes": "GeoPoints:positions",
        "/cadence/occupancy_voxels": "VoxelGridMap:colors",
    }
    chunks = re.split(r"(?=Chunk\()", told)
    for topic, component in drawn.items():
        assert any(topic in chunk and component in chunk for chunk in chunks), f"{topic} is not drawn"
