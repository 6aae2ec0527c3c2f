"""Tables come back as they were written, with their frame; anything else is refused with one line."""

import dataclasses

import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from cadence.errors import InputError
from pipeline.tables import Frame, read_table, write_table
from schemas.tables import DETECTIONS_WITH_HEIGHT, HEIGHT_VERSION, POSES, TRUTH, VERSION, hypotheses_schema

FRAME = Frame("map", latitude_deg=50.25, longitude_deg=-1.5)


def truth_table():
    columns = {"log_id": ["l", "l"], "time_ns": [1, 2**62], "agent_id": ["a", "b"], "x_m": [0.1, -5e6], "y_m": [2.0, 3.0]}
    return pa.table({**columns, "z_m": pa.array([None, 4.5], pa.float64())}, schema=TRUTH)


def test_round_trip_keeps_values_schema_and_frame(tmp_path):
    path = tmp_path / "truth.parquet"
    write_table(truth_table(), path, "truth", FRAME)
    table, frame = read_table(path, "truth")
    assert table.equals(truth_table()) and table.schema.equals(TRUTH)
    assert frame == FRAME and frame.is_georeferenced


def test_frame_without_datum_is_not_georeferenced(tmp_path):
    path = tmp_path / "truth.parquet"
    write_table(truth_table(), path, "truth", Frame("map"))
    assert not read_table(path, "truth")[1].is_georeferenced


def test_same_table_gives_the_same_bytes(tmp_path):
    write_table(truth_table(), tmp_path / "a", "truth", FRAME)
    write_table(truth_table(), tmp_path / "b", "truth", FRAME)
    assert (tmp_path / "a").read_bytes() == (tmp_path / "b").read_bytes()


def test_hypotheses_keep_their_fixed_size(tmp_path):
    schema = hypotheses_schema(3)
    row = {
        "log_id": "l", "window": 0, "origin_ns": 5, "step_ns": 10, "origin_index": 1, "agent_id": "a", "hypothesis": 0,
        "weight": 1.0, "datum_x_m": 0.0, "datum_y_m": 0.0, "position_m": [[0.0, 1.0], [2.0, 3.0], [4.0, 5.0]],
    }  # fmt: skip
    write_table(pa.Table.from_pylist([row], schema=schema), tmp_path / "h", "hypotheses", FRAME)
    table, _ = read_table(tmp_path / "h", "hypotheses")
    assert table.schema.equals(schema) and table.to_pylist() == [row]


def test_tables_with_heights_are_version_two_and_name_what_heights_count_from(tmp_path):
    frame = dataclasses.replace(FRAME, vertical_datum="sea level")
    for name, schema in (("hypotheses", hypotheses_schema(3, True)), ("detections", DETECTIONS_WITH_HEIGHT)):
        write_table(schema.empty_table(), tmp_path / name, name, frame)
        assert pq.read_schema(tmp_path / name).metadata[b"cadence.version"] == b"2"
        table, found = read_table(tmp_path / name, name)
        assert table.schema.equals(schema) and found == frame
    write_table(hypotheses_schema(3).empty_table(), tmp_path / "flat", "hypotheses", FRAME)
    assert pq.read_schema(tmp_path / "flat").metadata[b"cadence.version"] == b"1"
    assert b"vertical" not in pq.read_schema(tmp_path / "flat").metadata[b"cadence.frame"]


def test_absent_file_says_which_stage(tmp_path):
    with pytest.raises(InputError, match="not found; run the stage"):
        read_table(tmp_path / "x.parquet", "truth")


def test_other_kind_or_version_is_refused(tmp_path, monkeypatch):
    path = tmp_path / "t.parquet"
    write_table(truth_table(), path, "truth", FRAME)
    with pytest.raises(InputError, match=f"holds truth version {VERSION}, expected poses"):
        read_table(path, "poses")
    monkeypatch.setattr("pipeline.tables.VERSION", HEIGHT_VERSION + 1)
    with pytest.raises(InputError, match=f"expected truth version {HEIGHT_VERSION + 1}"):
        read_table(path, "truth")


@pytest.mark.parametrize("metadata", [None, {"cadence.table": "poses", "cadence.version": "1", "cadence.frame": "[1]"}])
def test_foreign_parquet_is_refused(tmp_path, metadata):
    path = tmp_path / "t.parquet"
    pq.write_table(
        pa.table({name: pa.array([], POSES.field(name).type) for name in POSES.names}).replace_schema_metadata(metadata), path
    )
    with pytest.raises(InputError):
        read_table(path, "poses")


@pytest.mark.parametrize("content", [b"", b"not parquet at all", b"PAR1" + bytes(40) + b"PAR1"])
def test_damaged_file_is_refused_with_one_line(tmp_path, content):
    path = tmp_path / "t.parquet"
    path.write_bytes(content)
    with pytest.raises(InputError) as caught:
        read_table(path, "truth")
    assert "\n" not in str(caught.value) and "Traceback" not in str(caught.value)
