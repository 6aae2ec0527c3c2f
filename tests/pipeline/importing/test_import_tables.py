"""Tables as their providers write them become logs that are read without settings, to the last digit."""

import json
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import shapely

import cli
from pipeline.extract.config import ExtractConfig
from pipeline.extract.writing import write_tables
from pipeline.frames import to_geodetic
from pipeline.importing.stage import import_settings, import_table
from pipeline.logs.reader import open_log
from pipeline.progress import Progress
from pipeline.tables import read_table

QUIET = Progress(quiet=True)
SECOND = 10**9
START = 1_590_969_600  # 2020-06-01T00:00:00Z


def settings(*columns: str, form="", zone="", zero=None, unit="", agent="", sensor="", sigma=None):
    return import_settings(columns, form, zone, zero, unit, agent, sensor, sigma)


def imported(path: Path, *columns: str, **others):
    """The summary of an import of `path`, and the rows that extract reads of the log without settings."""
    found = import_table(path, path.with_suffix(".mcap"), settings(*columns, **others), QUIET)
    return found, extracted(found.log)


def extracted(log: Path, name: str = "detections") -> dict:
    """The rows that extract makes of a log without settings; positions also in degrees."""
    out = log.with_suffix("")
    out.mkdir()
    write_tables(open_log(log), out, ExtractConfig(), QUIET)
    table, frame = read_table(out / f"{name}.parquet", name)
    rows = table.to_pydict()
    if frame.is_georeferenced:
        rows["latitude"], rows["longitude"] = to_geodetic(frame, np.array(rows["x_m"]), np.array(rows["y_m"]))
    return rows


def write(path: Path, text: str, encoding: str = "utf-8") -> Path:
    path.write_bytes(text.encode(encoding))
    return path


MARINE_CADASTRE = """MMSI,BaseDateTime,LAT,LON,SOG,COG,Heading,VesselName,IMO,CallSign,VesselType,Status,Length
367000001,2020-06-01T00:00:01,29.10101,-90.20010,5.1,100.1,511.0,ALPHA,IMO9,WDA,31,0,20
367000002,2020-06-01T00:00:03,29.20101,-90.10010,5.1,100.1,511.0,"BETA, OF THE SEA",,WDB,31,,
367000001,2020-06-01T00:01:11,29.10201,-90.19910,5.1,100.1,511.0,ALPHA,IMO9,WDA,31,0,20
367000001,2020-06-01T00:01:11,29.10201,-90.19910,5.1,100.1,511.0,ALPHA,IMO9,WDA,31,0,20
367000001,2020-06-01T00:02:11,91.0,181.0,5.1,100.1,511.0,ALPHA,IMO9,WDA,31,0,20
"""
NEW_MARINE_CADASTRE = """mmsi,base_date_time,longitude,latitude,sog,cog,heading,vessel_name,imo,call_sign,vessel_type
367000001,2020-06-01 00:00:01,-90.20010,29.10101,5.1,100.1,511,ALPHA,IMO9,WDA,31
367000002,2020-06-01 00:00:03,-90.10010,29.20101,5.1,100.1,511,BETA,,WDB,31
367000001,2020-06-01 00:01:11,-90.19910,29.10201,5.1,100.1,511,ALPHA,IMO9,WDA,31
"""
STATSAT = """mmsi;lon;lat;date_time_utc;sog;cog;true_heading;nav_status;rot;message_nr;source
367000001;-90.20010;29.10101;2020-06-01 00:00:01;5.1;100.1;511;0;0;1;g
367000002;-90.10010;29.20101;2020-06-01 00:00:03;5.1;100.1;511;0;0;1;s
367000001;-90.19910;29.10201;2020-06-01 00:01:11;5.1;100.1;511;0;0;1;g
"""
DANISH = """# Timestamp,Type of mobile,MMSI,Latitude,Longitude,Navigational status,ROT,SOG,COG,Heading,IMO,Callsign,Name,Type
01/06/2020 00:00:01,Class A,367000001,29.101010,-90.200100,Under way using engine,,5.1,,,Unknown,Unknown,,Undefined
01/06/2020 00:00:02,Base Station,2190068,56.447257,10.945872,Unknown value,,,,,Unknown,Unknown,,Undefined
01/06/2020 00:00:03,Class B,367000002,29.201010,-90.100100,Under way using engine,,5.1,,,Unknown,Unknown,,Undefined
01/06/2020 00:01:11,Class A,367000001,29.102010,-90.199100,Under way using engine,,5.1,,,Unknown,Unknown,,Undefined
01/06/2020 00:01:12,AtoN,992190001,56.4,10.9,Unknown value,,,,,Unknown,Unknown,,Undefined
"""
PLACES = {
    (START + 1, "367000001", 29.10101, -90.2001),
    (START + 3, "367000002", 29.20101, -90.1001),
    (START + 71, "367000001", 29.10201, -90.1991),
}


def places(rows: dict) -> set:
    columns = (rows["time_ns"], rows["agent_id"], np.round(rows["latitude"], 7), np.round(rows["longitude"], 7))
    return {(time_ns / SECOND, agent, float(lat), float(lon)) for time_ns, agent, lat, lon in zip(*columns, strict=True)}


@pytest.mark.parametrize(
    ("text", "others"),
    [(MARINE_CADASTRE, {}), (NEW_MARINE_CADASTRE, {}), (STATSAT, {}), (DANISH, {"zone": "UTC"})],
    ids=["MarineCadastre", "MarineCadastre 2025", "Statsat", "Danish"],
)
def test_ships_of_four_providers_are_the_same_ships(tmp_path, text, others):
    found, rows = imported(write(tmp_path / "ais.csv", text), **others)
    assert places(rows) == PLACES
    assert found.num_detections == 3 and found.num_agents == 2


def test_what_is_left_out_of_ais_is_counted(tmp_path):
    found = import_table(write(tmp_path / "ais.csv", MARINE_CADASTRE), None, settings(), QUIET)
    assert found.left_out == {"positions that say that there is none (91, 181)": 1, "rows that repeat another": 1}
    assert found.log is None and not list(tmp_path.glob("*.mcap")), "it was only looked at"
    found = import_table(write(tmp_path / "dma.csv", DANISH), None, settings(zone="UTC"), QUIET)
    assert found.left_out == {"rows whose Type of mobile says that they are no target": 2}


OPENSKY = """time,icao24,lat,lon,velocity,heading,vertrate,callsign,onground,baroaltitude,geoaltitude,lastposupdate
1590969600,3c6444,50.10000,8.50000,230.1,90.0,0.0,DLH400  ,False,10972.8,11100.5,1590969599.25
1590969610,3c6444,50.10000,8.50000,230.1,90.0,0.0,DLH400  ,False,10972.8,11100.5,1590969599.25
1590969620,3c6444,50.10100,8.56000,230.1,90.0,0.0,DLH400  ,False,10972.8,11101.5,1590969619.5
1590969620,4b1805,,,,,,,False,,,
"""


def test_state_vectors_of_opensky_are_taken_when_they_were_heard(tmp_path):
    found, rows = imported(write(tmp_path / "states.csv", OPENSKY))
    assert found.provider == "state vectors of OpenSky" and any("lastposupdate" in note for note in found.notes)
    assert rows["time_ns"] == [START * SECOND - 750_000_000, (START + 19) * SECOND + 500_000_000]
    assert set(rows["agent_id"]) == {"3c6444"} and rows["z_m"] == [11100.5, 11101.5]
    assert found.left_out == {"rows without a time": 1, "rows that repeat another": 1}


GPS_LOGGER = """time,lat,lon,elevation,accuracy,bearing,speed,satellites,provider,hdop,battery
2020-06-01T00:00:01.000Z,51.5010,-1.2010,81.5,3.0,,1.2,12,gps,,90
2020-06-01T00:00:11.250Z,51.5011,-1.2011,81.7,30.192,,1.2,,network,,90
"""


def test_a_phones_log_keeps_accuracy_altitude_and_what_measured(tmp_path):
    _, rows = imported(write(tmp_path / "walk.csv", GPS_LOGGER), agent="walker")
    assert rows["time_ns"] == [(START + 1) * SECOND, (START + 11) * SECOND + 250_000_000]
    assert rows["agent_id"] == ["walker"] * 2 and rows["sensor_id"] == ["gps", "network"] and rows["z_m"] == [81.5, 81.7]
    # 68 % of a round normal law lie within 1.5096 sigma
    assert np.allclose(np.sqrt(rows["cov_xx_m2"]), [3 / 1.5096, 20], rtol=1e-4)


MOVEBANK = """event-id,visible,timestamp,location-long,location-lat,height-above-ellipsoid,tag-local-identifier,individual-id
1,true,2020-06-01 00:00:01.000,-15.5,28.1,120.0,"91732A","Eva, 2"
2,false,2020-06-01 00:00:02.000,-75.5,88.1,120.0,"91732A","Eva, 2"
3,true,2020-06-01 00:20:01.500,-15.51,28.12,130.0,"91732A","Eva, 2"
4,true,2020-06-01 00:30:01.500,,,,"91732A","Eva, 2"
"""


def test_an_animal_of_movebank(tmp_path):
    found, rows = imported(write(tmp_path / "gulls.csv", MOVEBANK))
    assert found.provider == "Movebank" and set(rows["agent_id"]) == {"Eva, 2"} and rows["z_m"] == [120.0, 130.0]
    assert rows["time_ns"] == [(START + 1) * SECOND, (START + 1201) * SECOND + 500_000_000]
    assert np.allclose(rows["longitude"], [-15.5, -15.51], atol=1e-8)
    assert found.left_out == {"rows whose visible says that they are no target": 1, "rows without a position": 1}


def test_degrees_and_minutes_with_their_hemispheres_dates_apart_and_a_comma(tmp_path):
    text = (
        "Index;UTC Date;UTC Time;Latitude;N/S;Longitude;E/W;Height(m)\n"
        "1;2020/06/01;00:00:01;33,5;S;70,25;W;-12,5\n2;2020/06/01;00:00:02.5;33,6;S;70,35;W;-12,5\n"
    )
    _, rows = imported(write(tmp_path / "log.csv", text))
    assert np.allclose(rows["latitude"], [-33.5, -33.6], atol=1e-8) and np.allclose(
        rows["longitude"], [-70.25, -70.35], atol=1e-8
    )
    assert rows["time_ns"] == [(START + 1) * SECOND, (START + 2) * SECOND + 500_000_000] and rows["z_m"] == [-12.5, -12.5]


@pytest.mark.parametrize(
    ("latitude", "longitude", "unit"),
    [
        ("51.5", "-1.25", ""),
        ("51.5N", "1.25W", ""),
        ("51°30'00\"N", "1°15'0.0\"W", ""),
        ("51 30.0 N", "1 15.0 W", ""),
        ("515000000", "-12500000", "1e-7 deg"),
        ("5130.0", "-0115.0", "ddmm.mm"),
        ("0.8988445647770796", "-0.02181661564992912", "rad"),
        ("51.5", "358.75", ""),
    ],
)
def test_a_place_is_the_same_in_every_unit(tmp_path, latitude, longitude, unit):
    text = "time,lat,lon\n" + f"2020-06-01T00:00:01Z,{latitude},{longitude}\n" * 2
    log = import_table(write(tmp_path / "a.csv", text), tmp_path / "a.mcap", settings(unit=unit), QUIET).log
    fix = json.loads(next(open_log(log).messages()).data)
    assert fix["latitude"] == pytest.approx(51.5, abs=1e-9) and fix["longitude"] == pytest.approx(-1.25, abs=1e-9)


def test_metres_covariance_sensor_and_truth(tmp_path):
    text = "t_ms,x_km,y_km,z,track_id,sensor,cov_xx_m2,cov_xy_m2,cov_yy_m2,is_truth\n"
    text += "".join(
        f"{(START + i) * 1000 + 250},{i / 1000},{-i / 500},{i},{7},radar,4,1,9,{'false' if i % 2 else 'true'}\n"
        for i in range(8)
    )
    found, rows = imported(write(tmp_path / "plots.csv", text))
    assert (found.num_detections, found.num_truth, found.is_geodetic) == (4, 4, False)
    assert rows["x_m"] == [1.0, 3.0, 5.0, 7.0] and rows["y_m"] == [-2.0, -6.0, -10.0, -14.0] and rows["z_m"] == rows["x_m"]
    assert rows["time_ns"][0] == (START + 1) * SECOND + 250_000_000
    assert [rows[name][0] for name in ("cov_xx_m2", "cov_xy_m2", "cov_yy_m2", "sensor_id")] == [4, 1, 9, "radar"]
    truth, _ = read_table(tmp_path / "plots" / "truth.parquet", "truth")
    assert truth["x_m"].to_pylist() == [0.0, 2.0, 4.0, 6.0] and set(truth["agent_id"].to_pylist()) == {"7"}


def test_our_own_detections_come_back_to_the_bit(tmp_path):
    text = "t_ns,x_m,y_m,id,sigma_m\n" + "".join(
        f"{START * SECOND + 333 * i},{i / 3},{i / 7},a{i % 2},{1 + i}\n" for i in range(9)
    )
    _, first = imported(write(tmp_path / "first.csv", text))
    again = tmp_path / "again.parquet"
    again.write_bytes((tmp_path / "first" / "detections.parquet").read_bytes())
    _, second = imported(again)
    names = ("time_ns", "x_m", "y_m", "agent_id", "cov_xx_m2", "cov_yy_m2")
    assert {name: first[name] for name in names} == {name: second[name] for name in names}


def test_parquet_with_stamps_categories_and_points(tmp_path):
    time = pa.array([(START + i) * 1000 for i in range(4)], pa.timestamp("ms", "Europe/Paris"))
    points = shapely.to_wkb(shapely.points([(8.5 + i / 100, 50.0) for i in range(4)]))
    geo = {
        "version": "1.1.0",
        "primary_column": "geometry",
        "columns": {"geometry": {"encoding": "WKB", "geometry_types": ["Point"]}},
    }
    table = pa.table(
        {
            "time": time,
            "vessel": pa.array(["a", "b", "a", "b"]).dictionary_encode(),
            "geometry": pa.array(points.tolist(), pa.binary()),
        }
    ).replace_schema_metadata({"geo": json.dumps(geo)})
    pq.write_table(table, tmp_path / "points.parquet")
    _, rows = imported(tmp_path / "points.parquet")
    assert rows["time_ns"] == [(START + i) * SECOND for i in range(4)] and rows["agent_id"] == ["a", "b", "a", "b"]
    assert np.allclose(rows["longitude"], [8.5, 8.51, 8.52, 8.53], atol=1e-8) and np.allclose(rows["latitude"], 50, atol=1e-8)


def feature(i: int, **properties) -> dict:
    place = {"type": "Point", "coordinates": [8.5 + i / 100, 50.0, 100.0 + i]}
    return {"type": "Feature", "geometry": place, "properties": {"time": f"2020-06-01T00:00:0{i}+02:00"} | properties}


def test_geojson_of_points(tmp_path):
    line = {"type": "Feature", "geometry": {"type": "LineString", "coordinates": [[8, 50], [9, 51]]}, "properties": None}
    collection = {"type": "FeatureCollection", "features": [feature(0, mmsi=211), feature(1, mmsi=212), line]}
    found, rows = imported(write(tmp_path / "a.geojson", json.dumps(collection, indent=1)))
    assert "1 features are no points" in found.notes
    assert rows["agent_id"] == ["211", "212"] and rows["z_m"] == [100.0, 101.0]
    assert rows["time_ns"] == [(START - 7200) * SECOND, (START - 7199) * SECOND]
    sequence = "\n".join("\x1e" + json.dumps(feature(i, mmsi=1)) for i in range(3))
    assert imported(write(tmp_path / "b.geojsons", sequence))[0].num_detections == 3


def test_encodings_marks_and_compression(tmp_path):
    import gzip

    text = "time,lat,lon,ship\n2020-06-01T00:00:01Z,51.5,-1.2,Søværnet\n2020-06-01T00:00:02Z,51.5,-1.2,Søværnet\n"
    for encoding in ("utf-8-sig", "cp1252", "utf-16"):
        assert imported(write(tmp_path / f"{encoding}.csv", text, encoding))[1]["agent_id"] == ["Søværnet"] * 2
    (tmp_path / "packed.csv.gz").write_bytes(gzip.compress(text.encode()))
    assert import_table(tmp_path / "packed.csv.gz", tmp_path, settings(), QUIET).log == tmp_path / "packed.mcap"


def test_a_number_of_rows_is_nobodys_name_and_short_rows_are_named(tmp_path):
    lines = [f"{i},2020-06-01T00:{i // 60:02d}:{i % 60:02d}Z,51.5{i:03d},-1.2" for i in range(100)]
    lines[40] = "40,2020-06-01"
    found, rows = imported(write(tmp_path / "a.csv", "\n".join(["id,time,lat,lon", *lines])))
    assert set(rows["agent_id"]) == {None} and found.num_agents == 0
    assert any("numbers rows" in note for note in found.notes) and any("line 42" in note for note in found.notes)


def test_the_same_table_gives_the_same_bytes_and_runs(tmp_path, capsys):
    rows = [f"{START + 20 * i},{50 + i / 2000:.5f},{8 + i / 1500:.5f},ferry" for i in range(30)]
    table = write(tmp_path / "ferry.csv", "\n".join(["unix_time,latitude,longitude,ship", *rows]) + "\n")
    for name in ("a", "b"):
        assert cli.main(["import", str(table), "--out", str(tmp_path / f"{name}.mcap"), "-q"]) == 0
    assert (tmp_path / "a.mcap").read_bytes() == (tmp_path / "b.mcap").read_bytes()
    told = capsys.readouterr().out
    assert "s since 1970" in told and "30 detections of 1 agent, " in told and "cadence run" in told
    fast = ["--set", "infer.checkpoint=none", "--set", "infer.num_hypotheses=4", "--set", "infer.grid.stride_steps=64", "-q"]
    assert cli.main(["run", str(tmp_path / "a.mcap"), "--out", str(tmp_path / "out"), *fast]) == 0
    assert (tmp_path / "out" / "a" / "report.html").is_file()


def test_as_json_and_a_folder_as_place(tmp_path, capsys):
    table = write(tmp_path / "ais.csv", MARINE_CADASTRE)
    (tmp_path / "logs").mkdir()
    assert cli.main(["import", str(table), "--out", str(tmp_path / "logs"), "--json", "-q"]) == 0
    record = json.loads(capsys.readouterr().out)
    assert record["log"] == str(tmp_path / "logs" / "ais.mcap") and record["provider"] == "AIS of MarineCadastre (NOAA)"
    assert [each["field"] for each in record["columns"]] == ["time", "latitude", "longitude", "agent"]
