"""What doctor, info and the report say of bearings: as much as was read, and nothing where there are none."""

import tomllib
from pathlib import Path

import pytest
from fixtures.small_logs import Row, detection, pose, stamp, write_log

from cadence.errors import ConfigError
from pipeline.config import read_config
from pipeline.extract.config import ExtractConfig
from pipeline.extract.writing import write_tables
from pipeline.inspect.doctor import diagnose, exit_code, render
from pipeline.inspect.info import describe_log
from pipeline.inspect.info import render as told
from pipeline.logs.reader import open_log
from pipeline.progress import Progress
from pipeline.report.health import _extraction


def log(folder: Path) -> Path:
    """A post at the origin that hears the fox five times, which is seen in between."""
    rows = [detection(float(i), 100.0, 100.0 + i, agent_id="fox") for i in range(8)]
    rows += [pose(float(i), 0.0, 0.0, "/sensors/post/pose") for i in range(8)]
    for i in range(5):
        message = {"timestamp": stamp(i + 0.5), "agent_id": "fox", "sensor_id": "post", "bearing": 44.0, "bearing_sigma": 2.0}
        rows.append(Row("/bearings", "mission.Bearing", i + 0.5, message))
    return write_log(folder / "log.mcap", rows)


def test_doctor_tells_bearings_and_finds_nothing_wrong(tmp_path: Path) -> None:
    found = diagnose([log(tmp_path)], Progress(quiet=True))
    assert exit_code([found]) == 0
    assert "  5 bearings of /bearings, which are no positions, may weigh windows; about fox (5)" in render(found)


def test_info_has_lines_for_them(tmp_path: Path) -> None:
    assert '[[extract.detections]]\ntopic = "/bearings"\nmessage_type = "Bearing"' in told(describe_log(log(tmp_path)))


def test_the_report_counts_them_once(tmp_path: Path) -> None:
    summary = dict(diagnose([log(tmp_path)], Progress(quiet=True)).use)
    rows = _extraction(summary)
    (row,) = [words for title, words in rows if title == "bearings and ranges"]
    assert row == "5 bearings of /bearings, which are no positions, may weigh windows; about fox (5)"
    assert not [title for title, _ in rows if title.startswith("measurements")]
    assert not [title for title, _ in _extraction({}) if title == "bearings and ranges"]


def test_what_info_suggests_is_what_extract_takes(tmp_path: Path) -> None:
    """A type that may have ranges asks for none where there are only bearings; for neither it does."""
    path, config = log(tmp_path), describe_log(log(tmp_path)).suggested_mapping
    tables = tomllib.loads(config)["extract"]
    summary = write_tables(open_log(path), tmp_path, read_config(ExtractConfig, tables, "extract"), Progress(quiet=True))
    assert summary["measurements"]["bearing_rad"] == 5
    (tmp_path / "other").mkdir()
    rows = [detection(float(i), 100.0, 100.0 + i, agent_id="fox") for i in range(8)]
    rows += [Row("/bearings", "mission.Bearing", i + 0.5, {"timestamp": stamp(i + 0.5), "agent_id": "fox"}) for i in range(5)]
    bare, tables = write_log(tmp_path / "other" / "bare.mcap", rows), {"detections": tables["detections"]}
    with pytest.raises(ConfigError, match=r"topic /bearings: no message has path 'range': .* and path 'bearing'"):
        write_tables(open_log(bare), tmp_path, read_config(ExtractConfig, tables, "extract"), Progress(quiet=True))
