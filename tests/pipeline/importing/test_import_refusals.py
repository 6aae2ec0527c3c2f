"""What is in doubt about a table is refused with one line, and nothing is written; the same said by the user is taken."""

import json
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

import cli
from pipeline.importing.moments import order_of, read_moment
from pipeline.importing.times import zone_of

HEAD = "time,lat,lon"
TIMES = ["2026-05-01T10:00:00Z", "2026-05-01T10:00:10Z", "2026-05-01T10:00:20Z"]


def rows(*lines: str, head: str = HEAD) -> str:
    return "\n".join([head, *lines]) + "\n"


def times(*texts: str) -> str:
    return rows(*(f"{text},51.{i},-1.{i}" for i, text in enumerate(texts)))


def at(*places: str) -> str:
    return rows(*(f"{time},{place}" for time, place in zip(TIMES * 50, places, strict=False)))


def call(path: Path, *more: str, capsys) -> tuple[int, str, str]:
    code = cli.main(["import", str(path), "--out", str(path.parent / "log.mcap"), "-q", *more])
    captured = capsys.readouterr()
    return code, captured.out, captured.err


LOCAL = times("2026-05-01 10:00:00", "2026-05-01 10:00:10")
EITHER = times("01/05/2026 10:00:00 Z", "02/05/2026 10:00:00 Z")
SMALL = times("0.5", "1.5", "2.5")
METRES = rows("2026-05-01T10:00:00Z,1.5,2.5", "2026-05-01T10:00:01Z,1.6,2.7", head="time,x,y")
RADIANS = at("0.8988,-0.0218", "0.8989,-0.0219")
DOUBTS = {
    "local time": (LOCAL, "has no time zone", ["--zone", "Europe/Paris"]),
    "day or month": (EITHER, "may be either", ["--time", "day-first"]),
    "both orders": (times("13/05/2026 10:00:00Z", "05/13/2026 10:00:00Z"), "are no time", None),
    "own zero": (SMALL, "give the moment from which it counts", ["--zero", "2026-05-01T12:00:00Z", "--time", "s"]),
    "mixed units": (times("1777629600", "1777629600000", "1777629601"), "mixes s (line 2) and ms (line 3)", None),
    "GPS time": (rows("1461664800,51,-1", "1461664801,51,-1", head="gps_time,lat,lon"), "GPS time", ["--time", "s"]),
    "another unit than its name": (
        rows("1777629600,51,-1", head="time_ms,lat,lon"),
        "is no time of 1973 to 2103 in ms",
        ["--time", "s"],
    ),
    "dates alone": (times("2026-05-01", "2026-05-02"), "time of day", None),
    "exchanged": (
        at("151.2,-33.8", "151.3,-33.9"),
        "may be exchanged",
        ["--column", "latitude=lon", "--column", "longitude=lat"],
    ),
    "radians": (RADIANS, "may be radians", ["--unit", "rad"]),
    "integers": (at("515000000,-12500000", "515000001,-12500001"), "no position is on the earth", ["--unit", "1e-7 deg"]),
    "mixed places": (at("51.5,-1.2", "5130.0,-112.0", "51.5,-1.2"), "units are mixed", None),
    "metres or degrees": (METRES, "may be metres or degrees", ["--unit", "m"]),
    "two times": (
        rows("2026-05-01T10:00:00Z,x,51,2", head="time,timestamp,lat,lon"),
        "may be column",
        ["--column", "time=time"],
    ),
    "half a position": (
        rows("2026-05-01T10:00:00Z,x,1", head="time,name,lat"),
        "looks like latitude, but none like longitude",
        None,
    ),
    "no position": (rows("2026-05-01T10:00:00Z,x,1", head="time,name,speed"), "no columns look like a position", None),
    "no time": (rows("7,51,-1", head="speed,lat,lon"), "no column looks like a time", None),
    "no names": ("2026-05-01T10:00:00Z,51.5,-1.2\n", "should name the columns", None),
    "no table": ("only words\n" * 9, "no line of it names three columns", None),
    "no rows": ("time,lat,lon\n", "has names of columns and no rows", None),
    "words for numbers": (at("north,-1.2", "south,-1.3"), "are no latitude", None),
    "short rows": (rows("2026-05-01T10:00:00Z,51", "2026-05-01T10:00:00Z,52"), "have not the 3 cells", None),
    "nothing left": (at(",", ","), "no row can be used", None),
    "strange truth": (
        rows("2026-05-01T10:00:00Z,51,1,maybe", head="time,lat,lon,is_truth"),
        "should say whether a row is the truth",
        ["--column", "truth="],
    ),
}


@pytest.mark.parametrize("name", DOUBTS)
def test_what_is_in_doubt_is_refused_and_taken_as_the_user_says(name, tmp_path, capsys):
    text, says, way = DOUBTS[name]
    table = tmp_path / "table.csv"
    table.write_text(text)
    code, out, err = call(table, capsys=capsys)
    assert code == 3 and not out, err
    assert err.startswith("cadence: error: ") and err.count("\n") == 1 and says in err and "table.csv" in err
    assert sorted(path.name for path in tmp_path.iterdir()) == ["table.csv"]
    if way is not None:
        code, _, err = call(table, *way, capsys=capsys)
        assert code == 0, err


@pytest.mark.parametrize(
    ("more", "says"),
    [
        (["--column", "tiem=time"], "did you mean 'time'"),
        (["--column", "time"], "give FIELD=COLUMN"),
        (["--column", "time=tme"], "has no column 'tme' (did you mean 'time'?)"),
        (["--column", "altitude=speed:miles"], "'miles' is no unit of altitude"),
        (["--column", "x=lat", "--column", "latitude=lon"], "not both"),
        (["--zone", "Mars"], "--zone Mars: not known"),
        (["--time", "fortnights"], "--time fortnights: not known"),
        (["--zero", "yesterday"], "give a moment with its zone"),
        (["--zero", "2026-05-01T10:00:00"], "give a moment with its zone"),
        (["--unit", "miles"], "--unit miles: not known"),
        (["--unit", "km"], "is no unit of latitude"),
        (["--sigma", "-3"], "must be a positive number"),
        (["--out", "a.csv"], "name ends with .mcap"),
    ],
)
def test_wrong_calls(more, says, tmp_path, capsys):
    table = tmp_path / "table.csv"
    table.write_text(rows(*(f"{time},51.5,-1.2,3" for time in TIMES), head="time,lat,lon,speed"))
    code, _, err = call(table, *more, capsys=capsys)
    assert code == 2 and says in err and err.count("\n") == 1
    assert sorted(path.name for path in tmp_path.iterdir()) == ["table.csv"]


def test_a_log_that_is_there_stays(tmp_path, capsys):
    table, log = tmp_path / "table.csv", tmp_path / "log.mcap"
    table.write_text(at("51.5,-1.2", "51.6,-1.2"))
    log.write_bytes(b"mine")
    code, _, err = call(table, capsys=capsys)
    assert code == 2 and "is there already" in err and log.read_bytes() == b"mine"
    assert call(table, "--force", capsys=capsys)[0] == 0 and log.read_bytes() != b"mine"


@pytest.mark.parametrize(
    ("content", "says"),
    [
        (b"", "is empty"),
        (b"\x89MCAP0\r\n" + bytes(40), "is a log already"),
        (b"PAR1" + bytes(60), "cannot be read as Parquet"),
        (b"#ROSBAG V2.0\n" + bytes(60), "a ROS 1 bag; convert it with `rosbags-convert"),
        (b"SQLite format 3\x00" + bytes(60), "a rosbag2 in SQLite; convert its folder with `rosbags-convert"),
        (b"PK\x03\x04" + bytes(60), "a ZIP archive"),
        (bytes(200), "something else"),
        (b'{"type": "FeatureCollection", "features": []}', "holds no points (it has no features)"),
        (b'{"type": "FeatureCollection", "features": [', "cannot be read as GeoJSON"),
        (b'{"rows": [1, 2]}', "is JSON, but no GeoJSON"),
        (b"[1, 2, 3]", "is JSON, but no GeoJSON"),
        (
            b'{"type": "FeatureCollection", "crs": {"properties": {"name": "urn:ogc:def:crs:EPSG::25832"}}, "features": []}',
            "EPSG::25832",
        ),
        (b'{"type": "Feature", "geometry": {"type": "Polygon"}, "properties": {}}', "its features are Polygon"),
        (
            b'{"type": "Feature", "geometry": {"type": "Point", "coordinates": [1, 2]}, "properties": {}}',
            "no column looks like a time",
        ),
        (
            b'{"type": "Feature", "geometry": {"type": "Point", "coordinates": [-3, 151]}, "properties": {"time": 1777629600}}',
            "may be exchanged",
        ),
    ],
)
def test_other_files_are_named(content, says, tmp_path, capsys):
    table = tmp_path / "file.csv"
    table.write_bytes(content)
    code, _, err = call(table, capsys=capsys)
    assert code == 3 and says in err and err.count("\n") == 1, err
    assert sorted(path.name for path in tmp_path.iterdir()) == ["file.csv"]


def test_absent_tables_and_geometry_that_is_none(tmp_path, capsys):
    assert call(tmp_path / "gone.csv", capsys=capsys)[0] == 3
    column = pa.array([b"no shape"], pa.binary())
    for number, (geo, says) in enumerate(
        [
            ("{", "metadata cannot be understood"),
            (json.dumps({"primary_column": "g", "columns": {"g": {"encoding": "point"}}}), "is no WKB"),
            (json.dumps({"primary_column": "g", "columns": {"g": {"encoding": "WKB", "crs": "EPSG:25832"}}}), "UTM zone 32N"),
            (
                json.dumps({"primary_column": "g", "columns": {"g": {"encoding": "WKB", "crs": "none at all"}}}),
                "coordinate system",
            ),
            (json.dumps({"primary_column": "g", "columns": {"g": {"encoding": "WKB"}}}), "geometry cannot be read"),
        ]
    ):
        table = tmp_path / f"{number}.parquet"
        stamps = pa.array([1_777_629_600], pa.timestamp("s", "UTC"))
        pq.write_table(pa.table({"time": stamps, "g": column}).replace_schema_metadata({"geo": geo}), table)
        code, _, err = call(table, capsys=capsys)
        assert code == 3 and says in err, err


def test_parquet_stamps_without_a_zone_are_refused(tmp_path, capsys):
    stamps = pa.array([1_777_629_600_000], pa.timestamp("ms"))
    pq.write_table(pa.table({"time": stamps, "lat": [51.5], "lon": [-1.2]}), tmp_path / "a.parquet")
    assert "has no time zone" in call(tmp_path / "a.parquet", capsys=capsys)[2]
    code, out, _ = call(tmp_path / "a.parquet", "--zone", "+02:00", capsys=capsys)
    assert code == 0 and "2026-05-01T08:00:00" in out
    pq.write_table(pa.table({"time": stamps.cast(pa.date64()), "lat": [51.5], "lon": [-1.2]}), tmp_path / "b.parquet")
    assert "date and time of day" in call(tmp_path / "b.parquet", "--force", capsys=capsys)[2]


def test_an_hour_that_the_clock_shows_twice_is_left_out(tmp_path, capsys):
    table = tmp_path / "night.csv"
    table.write_text(times("2026-10-25 01:30:00", "2026-10-25 02:30:00", "2026-10-25 03:30:00"))
    code, out, _ = call(table, "--zone", "Europe/Paris", capsys=capsys)
    assert code == 3  # one of three
    lines = [f"2026-10-25 0{1 + i // 30}:{2 * (i % 30):02d}:00,51.5,-1.{i}" for i in range(33)]
    table.write_text(rows(*(line for line in lines if "02:0" not in line or ":00:00" in line)))
    code, out, err = call(table, "--zone", "Europe/Paris", capsys=capsys)
    assert code == 0, err
    assert "1 times that the clock shows twice" in out and "2026-10-24T23:00:00" in out


def test_a_row_off_the_earth_is_left_out_where_the_user_named_the_columns(tmp_path, capsys):
    table = tmp_path / "a.csv"
    table.write_text(at(*["51.5,-1.2"] * 149, "95.0,-1.2"))
    assert "may be exchanged" in call(table, capsys=capsys)[2]
    code, out, _ = call(table, "--column", "latitude=lat", "--column", "longitude=lon", capsys=capsys)
    assert code == 0 and "1 positions off the earth" in out


def test_an_altitude_of_aircraft_without_a_unit_is_left_out(tmp_path, capsys):
    table = tmp_path / "a.csv"
    table.write_text(rows("2026-05-01T10:00:00Z,51,-1,3000,abc123", head="time,lat,lon,altitude,hex"))
    assert "altitude is left out" in call(table, capsys=capsys)[1]
    code, out, _ = call(table, "--column", "altitude=altitude:ft", "--force", capsys=capsys)
    assert code == 0 and "left out" not in out


@pytest.mark.parametrize(
    ("text", "order", "expected"),
    [
        ("2026-05-01T10:00:00.123456789Z", "", "2026-05-01T10:00:00.123456789"),
        ("2026-05-01 10:00:00+02:00", "", "2026-05-01T08:00:00"),
        ("2026-05-01 10:00 UTC", "", "2026-05-01T10:00:00"),
        ("20260501T100000Z", "", "2026-05-01T10:00:00"),
        ("20260501100000 -0330", "", "2026-05-01T13:30:00"),
        ("20260501100000-0330", "", "2026-05-01T13:30:00"),
        ("1 May 2026 10:00:00 Z", "", "2026-05-01T10:00:00"),
        ("01-May-2026 10:00:00 PM Z", "", "2026-05-01T22:00:00"),
        ("05/05/2026 12:30 AM Z", "", "2026-05-05T00:30:00"),
        ("25/12/2026, 10:00:00 Z", "day-first", "2026-12-25T10:00:00"),
        ("12/25/2026 10:00:00 Z", "month-first", "2026-12-25T10:00:00"),
        ("2016-12-31T23:59:60Z", "", "2017-01-01T00:00:00"),
        ("2026-02-30T10:00:00Z", "", None),
        ("2026-05-01T25:00:00Z", "", None),
        ("2026-05-01T10:00:00 EST", "", None),
        ("01/05/26 10:00:00 Z", "day-first", None),
        ("13:00 PM", "", None),
    ],
)
def test_moments_as_text(text, order, expected):
    moment = read_moment(text, order)
    found = None if moment is None else moment.time_ns(None)
    assert found == (None if expected is None else np.datetime64(expected, "ns").astype(np.int64))


def test_orders_and_zones():
    assert order_of(["01/05/2026", "13/05/2026"]) == "day-first" and order_of(["01/05/2026", "05/13/2026"]) == "month-first"
    assert order_of(["01/05/2026"]) == "" and order_of(["13/05/2026", "05/13/2026"]) == ""
    assert zone_of("") is None and zone_of("-0330").total_seconds() == -12600
