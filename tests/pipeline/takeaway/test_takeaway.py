"""Files for other programs, each read back by a reader of its own: places to .1 m, times to 1 ms, weights and regions."""

import importlib.util
import json
import shutil
import subprocess
import sys
import xml.etree.ElementTree as ET
from datetime import UTC, datetime
from pathlib import Path

import geopandas
import gpxpy
import numpy as np
import pytest
import shapely
from czml3 import Document, Packet
from fixtures.mission import FRAME, GEOREFERENCED, build_mission
from pykml import parser as kml_parser
from takproto.functions import xml2message

import cli
from cadence.errors import InputError, UsageError
from cadence.stories import Stories
from pipeline.frames import to_local
from pipeline.progress import Progress
from pipeline.stories import Block, MissionStories, write_stories
from pipeline.tables import Frame
from pipeline.takeaway.answer import Answer, Stretch, Track, read_answer
from pipeline.takeaway.degrees import coordinates, iso, pieces, region_in_degrees
from pipeline.takeaway.stage import FORMATS, take_away
from pipeline.takeaway.thinned import thinned

QUIET = Progress(quiet=True)
START_NS = 1_700_000_000_000_000_000
PLACE_M, TIME_NS = 0.1, 1_000_000
RERUN = shutil.which("rerun", path=str(Path(sys.executable).parent)) or "rerun"


def write_mission_hypotheses(directory: Path, frame: Frame, has_height: bool = True) -> Stories:
    """Five stories of two agents over two blocks of different steps; the second agent comes late in every other story."""
    time_ns = np.concatenate([np.arange(30) * 1_000_000_000, 30_000_000_000 + np.arange(10) * 2_500_000_000])
    rng = np.random.default_rng(3)
    base = np.stack([4.0 * time_ns * 1e-9, 40 * np.sin(time_ns * 1e-10)], -1)
    position = base + 30 * rng.normal(size=(5, 2, 1, 2)) + np.cumsum(rng.normal(size=(5, 2, len(time_ns), 2)), axis=2)
    position[::2, 1, :12] = np.nan
    height = 100 + rng.normal(size=(5, 2, len(time_ns))) if has_height else None
    weight = np.array([0.4, 0.1, 0.2, 0.05, 0.25])
    stories = Stories(time_ns * 1e-9, position, weight, ("Å & <b>", "T1"), height)
    blocks = (Block(0, 30, START_NS, 10**9), Block(30, 40, START_NS + 30 * 10**9, 2_500_000_000))
    write_stories(MissionStories(frame, "patrol", START_NS, stories, blocks), directory)
    return stories


@pytest.fixture(scope="module")
def mission(tmp_path_factory) -> Path:
    directory = build_mission(tmp_path_factory.mktemp("take"), frame=GEOREFERENCED)
    write_mission_hypotheses(directory, GEOREFERENCED)
    return directory


@pytest.fixture(scope="module", params=["mission", "windows"])
def taken(mission, tmp_path_factory, request) -> tuple[Answer, Path]:
    """What is to be found in the files, and the folder with all of them."""
    out = tmp_path_factory.mktemp("out")
    found = take_away(mission, ["geoparquet,geojson", "kml,czml,gpx,cot"], out, None, request.param, QUIET)
    assert found.source == request.param and sorted(path.name for path in out.iterdir()) == sorted(
        path.name for path in found.files
    )
    return read_answer(mission, "patrol", request.param), out


Read = dict[str, list[tuple[list[int], list[tuple[float, float]]]]]
"""Times and places (longitude, latitude) of the pieces of each track, by its name."""


def assert_same(found: Read, tracks: list[Track], frame: Frame) -> None:
    """Every step of every track lies where the line that was read has it at that time."""
    expected: dict[str, list[Track]] = {}
    for track in tracks:
        expected.setdefault(track.name, []).append(track)
    assert found.keys() == expected.keys()
    for name, parts in expected.items():
        assert len(found[name]) == len(parts)
        for (time_ns, places), part in zip(found[name], parts, strict=True):
            lon, lat = np.array(places, dtype=np.float64).T[:2]
            read_m = np.stack(to_local(frame, lat, lon), axis=-1)
            read_ns = np.array(time_ns, dtype=np.int64)
            assert abs(read_ns[0] - part.time_ns[0]) <= TIME_NS and abs(read_ns[-1] - part.time_ns[-1]) <= TIME_NS
            since = (part.time_ns - read_ns[0]).astype(np.float64)
            at = np.stack(
                [np.interp(since, (read_ns - read_ns[0]).astype(np.float64), read_m[:, axis]) for axis in (0, 1)], axis=-1
            )
            assert np.linalg.norm(at - part.position_m, axis=1).max() < PLACE_M, name


def moment_ns(text: str) -> int:
    moment = datetime.fromisoformat(text)
    return round((moment - datetime(1970, 1, 1, tzinfo=UTC)).total_seconds() * 1e6) * 1000


def all_tracks(answer: Answer) -> list[Track]:
    return [*answer.tracks(), *answer.means()]


def test_geoparquet_holds_every_step(taken):
    answer, out = taken
    frame = geopandas.read_parquet(out / "patrol.tracks.parquet")
    assert frame.crs == "OGC:CRS84" and set(frame.geom_type) == {"Point"}
    found: Read = {}
    for track in all_tracks(answer):
        rows = frame[
            (frame.agent_id == track.agent_id) & (frame.kind == ("mean" if track.hypothesis is None else "hypothesis"))
        ]
        for column, value in (("window", track.window), ("hypothesis", track.hypothesis)):
            rows = rows[rows[column].isna()] if value is None else rows[rows[column] == value]
        times = rows.time.astype("int64").to_numpy()
        rows = rows[(times >= track.time_ns[0]) & (times <= track.time_ns[-1])]
        assert np.array_equal(rows.time.astype("int64").to_numpy(), track.time_ns) and np.allclose(rows.weight, track.weight)
        if track.height_m is not None:
            assert np.allclose(rows.geometry.get_coordinates(include_z=True).z, track.height_m) and np.allclose(
                rows.height_m, track.height_m
            )
        found.setdefault(track.name, []).append(
            (times.tolist() and track.time_ns.tolist(), list(zip(rows.geometry.x, rows.geometry.y, strict=True)))
        )
    assert_same(found, all_tracks(answer), answer.frame)
    assert len(frame) == sum(map(len, all_tracks(answer)))


def test_regions_hold_what_they_say(taken):
    answer, out = taken
    frame = geopandas.read_parquet(out / "patrol.regions.parquet")
    expected = list(answer.regions)
    assert len(frame) == len(expected) > 20 and set(frame.level) == {0.5, 0.9}
    for row, region in zip(frame.itertuples(), expected, strict=True):
        assert row.time.value == region.time_ns and row.geometry.is_valid
        lon, lat = shapely.get_coordinates(row.geometry).T
        back = shapely.get_coordinates(region.shape)
        assert abs(row.area_m2 - region.shape.area) < 1e-6
        middle = np.stack(to_local(answer.frame, lat, lon), axis=-1).mean(axis=0)
        assert np.linalg.norm(middle - back.mean(axis=0)) < 5.0 + 0.2 * np.sqrt(row.area_m2)
        place = shapely.transform(
            shapely.set_precision(row.geometry, 0), lambda point: np.stack(to_local(answer.frame, point[:, 1], point[:, 0]), -1)
        )
        assert shapely.hausdorff_distance(place, region.shape) < PLACE_M


def test_geojson(taken):
    answer, out = taken
    frame = geopandas.read_file(out / "patrol.geojson", engine="pyogrio")
    assert frame.crs.is_geographic and (frame.kind == "region").sum() == len(list(answer.regions))
    found: Read = {}
    for feature in json.loads((out / "patrol.geojson").read_text(encoding="utf-8"))["features"]:
        words = feature["properties"]
        shape = shapely.from_geojson(json.dumps(feature["geometry"]))
        assert shape.is_valid
        if words["kind"] == "region":
            continue
        window = f" window {words['window']}" if "window" in words else ""
        kind = "mean" if words["kind"] == "mean" else f"hypothesis {words['hypothesis']}"
        places = [tuple(place) for place in shapely.get_coordinates(shape).tolist()]
        found.setdefault(f"{words['agent']}{window} {kind}", []).append(([moment_ns(text) for text in words["times"]], places))
    assert_same(found, all_tracks(answer), answer.frame)
    weights = {
        row.hypothesis: row.weight
        for row in frame[(frame.kind == "hypothesis") & (frame.agent == answer.agent_ids[0])].itertuples()
    }
    if answer.source == "mission":
        assert np.allclose([weights[k] for k in range(5)], answer.stretches[0].weight)


def test_kml(taken):
    answer, out = taken
    document = kml_parser.parse(str(out / "patrol.kml"), schema=kml_parser.Schema("kml22gx.xsd")).getroot().Document
    found: Read = {}
    regions = 0
    for folder in document.Folder:
        for placemark in folder.Placemark:
            if not hasattr(placemark, "TimeSpan"):
                track = placemark["{http://www.google.com/kml/ext/2.2}Track"]
                times = [moment_ns(str(when)) for when in track["{http://www.opengis.net/kml/2.2}when"]]
                places = [tuple(map(float, str(coord).split())) for coord in track["{http://www.google.com/kml/ext/2.2}coord"]]
                found.setdefault(str(placemark.name), []).append((times, places))
            else:
                regions += 1
                assert moment_ns(str(placemark.TimeSpan.begin)) <= moment_ns(str(placemark.TimeSpan.end))
    assert_same(found, all_tracks(answer), answer.frame)
    assert regions == len(list(answer.regions))


def test_czml(taken):
    answer, out = taken
    document = Document(
        packets=[
            Packet(**{k: v for k, v in each.items()}) for each in json.loads((out / "patrol.czml").read_text(encoding="utf-8"))
        ]
    )
    assert document.packets[0].id == "document" and document.packets[0].version == "1.0"
    found: Read = {}
    polygons = 0
    for packet in document.packets[1:]:
        if packet.position is not None:
            values = np.array(packet.position.cartographicDegrees.values).reshape(-1, 4)
            epoch_ns = moment_ns(str(packet.position.epoch))
            times = [epoch_ns + round(second * 1e9) for second in values[:, 0].tolist()]
            found.setdefault(packet.name, []).append((times, [tuple(place) for place in values[:, 1:].tolist()]))
        else:
            polygons += 1
            assert packet.polygon.positions.cartographicDegrees is not None and packet.availability is not None
    assert_same(found, all_tracks(answer), answer.frame)
    assert polygons >= len(list(answer.regions))


def test_gpx(taken):
    answer, out = taken
    document = gpxpy.parse((out / "patrol.gpx").read_text(encoding="utf-8"))
    found: Read = {}
    for track in document.tracks:
        for segment in track.segments:
            times = [moment_ns(point.time.isoformat()) for point in segment.points]
            found.setdefault(track.name, []).append((times, [(point.longitude, point.latitude) for point in segment.points]))
    assert_same(found, all_tracks(answer), answer.frame)
    if answer.source == "mission":
        heights = [point.elevation for point in document.tracks[0].segments[0].points]
        assert all(90 < height < 110 for height in heights)


def test_cursor_on_target(taken):
    answer, out = taken
    found: dict[str, list[tuple[int, float, float, float]]] = {}
    for line in (out / "patrol.cot").read_text(encoding="utf-8").splitlines():
        event = xml2message(line.encode()).cotEvent
        assert event.type == "a-u-G" and event.how == "m-f" and event.startTime == event.sendTime <= event.staleTime
        agent = ET.fromstring(line).find("detail/contact").get("callsign")
        assert event.uid == f"cadence.patrol.{agent}"
        found.setdefault(agent, []).append((event.sendTime * 1_000_000, event.lon, event.lat, event.ce))
    assert set(found) == set(answer.agent_ids)
    for agent, rows in found.items():
        assert [row[0] for row in rows] == sorted(row[0] for row in rows)
        expected = [thinned(track) for track in answer.means() if track.agent_id == agent]
        assert len(rows) == sum(map(len, expected))
        at = {
            int(time_ns) // 1_000_000: place
            for track in expected
            for time_ns, place in zip(track.time_ns, track.position_m, strict=True)
        }
        for time_ns, lon, lat, ce in rows[1:-1]:
            x, y = to_local(answer.frame, np.array([lat]), np.array([lon]))
            assert ce > 0
            if answer.source == "mission":
                assert np.hypot(*(np.array([x[0], y[0]]) - at[time_ns // 1_000_000])) < PLACE_M


def test_the_mean_and_its_circle_by_hand():
    position = np.array([[[[0.0, 0.0]]], [[[10.0, 0.0]]], [[[np.nan, np.nan]]]])
    stretch = Stretch(None, np.array([START_NS]), np.arange(3), np.array([0.3, 0.6, 0.1]), ("a",), position)
    (mean,) = Answer("n", "l", FRAME, "mission", (stretch,)).means()
    assert np.allclose(mean.position_m, [[10 * 0.6 / 0.9, 0]])
    assert np.isclose(mean.spread_m[0], np.sqrt((0.3 * (20 / 3) ** 2 + 0.6 * (10 / 3) ** 2) / 0.9))
    assert np.isclose(mean.radius_m[0], 20 / 3)  # two thirds are not 68 %


def test_the_heaviest_hypotheses_are_drawn_and_their_weights_sum_to_one(mission):
    answer = read_answer(mission, "patrol", None)
    assert answer.source == "mission", "mission hypotheses come first"
    drawn = {track.hypothesis: track.weight for track in answer.tracks(2)}
    assert drawn == pytest.approx({0: 0.4 / 0.65, 4: 0.25 / 0.65})


def test_windows_tell_each_moment_once(mission):
    answer = read_answer(mission, "patrol", "windows")
    for before, after in zip(answer.stretches, answer.stretches[1:], strict=False):
        assert before.time_ns[-1] <= after.time_ns[0] and np.isclose(after.weight.sum(), 1)
    assert answer.stretches[-1].agent_ids == ("T0",), "T1 has no hypotheses in the last window"


def test_thinning_keeps_what_a_line_at_even_speed_does_not_give():
    time_ns = np.arange(1000) * 10_000_000
    straight = np.stack([3.0 * time_ns * 1e-9, np.zeros(1000)], -1)
    still = np.concatenate([straight[:500], np.repeat(straight[499:500], 500, axis=0)])
    assert len(thinned(Track("a", None, 0, 1.0, time_ns, straight))) == 2
    found = thinned(Track("a", None, 0, 1.0, time_ns, still))
    assert len(found) == 3 and found.time_ns[1] == time_ns[499]
    curve = np.stack([50 * np.cos(time_ns * 1e-9), 50 * np.sin(time_ns * 1e-9)], -1)
    thin = thinned(Track("a", None, 0, 1.0, time_ns, curve))
    at = np.stack([np.interp(time_ns, thin.time_ns, thin.position_m[:, axis]) for axis in (0, 1)], -1)
    assert len(thin) < 200 and np.linalg.norm(at - curve, axis=1).max() <= 0.05


def test_the_antimeridian_cuts_lines_and_regions():
    frame = Frame("mission", -17.0, 179.99)
    track = Track("a", None, 0, 1.0, START_NS + np.arange(5) * 10**9, np.stack([np.linspace(-3000, 3000, 5), np.zeros(5)], -1))
    parts = [place for _, place in pieces(frame, track)]
    assert len(parts) == 2 and sum(map(len, parts)) == 5 and (parts[0][:, 0] > 0).all() and (parts[1][:, 0] < 0).all()
    disc = shapely.Point(0, 0).buffer(3000)
    region = region_in_degrees(frame, disc)
    west, _, east, _ = region.bounds
    assert west == -180 and east == 180 and len(shapely.get_parts(region)) == 2
    whole = region_in_degrees(Frame("mission", -17.0, 170.0), disc)
    assert np.isclose(region.area, whole.area, rtol=1e-4)


def test_times_as_text():
    assert iso(START_NS) == "2023-11-14T22:13:20.000Z" and iso(START_NS + 1_500_000) == "2023-11-14T22:13:20.001500Z"
    assert iso(-1_000_000) == "1969-12-31T23:59:59.999Z"


def test_a_log_in_metres_is_told_what_works(tmp_path, capsys):
    directory = build_mission(tmp_path, frame=FRAME)
    before = sorted(path.name for path in directory.iterdir())
    assert cli.main(["export", str(directory), "--to", "geoparquet,kml,gpx", "-q"]) == 3
    told = capsys.readouterr().err
    assert "kml, gpx needs latitude and longitude" in told and "geoparquet works" in told and told.count("\n") == 1
    assert sorted(path.name for path in directory.iterdir()) == before, "nothing is half-written"
    assert cli.main(["export", str(directory), "--to", "geoparquet", "-q"]) == 0
    frame = geopandas.read_parquet(directory / "patrol.tracks.parquet")
    assert frame.crs is None and abs(frame.geometry.x.mean() - 1600) < 400
    assert "retrospect" in capsys.readouterr().out


def test_wrong_calls(mission, tmp_path, capsys):
    with pytest.raises(UsageError, match=r"--to geojsn: not known \(did you mean 'geojson'\?\)"):
        take_away(mission, ["geojsn"], None, None, None, QUIET)
    with pytest.raises(UsageError, match="names no format"):
        take_away(mission, [","], None, None, None, QUIET)
    with pytest.raises(UsageError, match="--hypotheses 0"):
        take_away(mission, ["kml"], None, 0, None, QUIET)
    with pytest.raises(InputError, match="not found"):
        take_away(tmp_path / "gone", ["kml"], None, None, None, QUIET)
    bare = build_mission(tmp_path)
    with pytest.raises(InputError, match="cadence retrospect"):
        take_away(bare, ["geoparquet"], None, None, "mission", QUIET)
    assert set(FORMATS) == {"geoparquet", "geojson", "kml", "czml", "gpx", "cot", "rerun"}
    assert (
        cli.main(["export", str(mission), "--to", "gpx", "--out", str(tmp_path / "new"), "--json", "-q", "--hypotheses", "1"])
        == 0
    )
    assert json.loads(capsys.readouterr().out)["files"] == [str(tmp_path / "new" / "patrol.gpx")]
    assert len(coordinates(GEOREFERENCED, np.zeros((1, 2)))) == 1


def test_a_blueprint_for_rerun_or_the_line_that_says_what_it_needs(mission, tmp_path):
    if importlib.util.find_spec("rerun") is None:
        with pytest.raises(UsageError, match="needs rerun-sdk"):
            take_away(mission, ["rerun"], tmp_path, None, None, QUIET)
        assert not list(tmp_path.iterdir())
        return
    (path,) = take_away(mission, ["rerun"], tmp_path, None, None, QUIET).files
    told = subprocess.run([RERUN, "rrd", "print", "-vv", path], capture_output=True, text=True, check=True).stdout
    assert all(
        words in told for words in ("ViewContents:query", "SpatialInformation:target_frame", "TimePanelBlueprint:timeline")
    )
