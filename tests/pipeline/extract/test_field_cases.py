"""Situations from public reports, as their generators in ../shared/cases/field make them: each with the value that is right."""

import os
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from test_extract import run

from cadence.errors import InputError
from pipeline.config import load_tables
from pipeline.frames import to_geodetic

CASES = Path(__file__).resolve().parents[3].parent / "shared" / "cases" / "field"
MAKE_ALL = """
import pathlib, runpy, sys
for path in sorted(pathlib.Path().glob("f*.py")):
    sys.modules.pop("lib", None)
    runpy.run_path(str(path))
"""


@dataclass(frozen=True)
class Right:
    """What is right of one log: detections, named agents, extent in metres, kinds of suspicion, and where on the earth."""

    num: int
    num_agents: int
    extent_m: tuple[float, float]
    suspected: tuple[str, ...] = ()
    place: tuple[float, float] | None = None


RIGHT = {
    "f01_ids_all_zero": Right(180, 0, (59, 200), ("identity",)),
    "f03_px4_boot_time": Right(120, 1, (0, 2380), ("time",), (47.41, 8.55)),
    "f04_clock_jump": Right(110, 0, (545, 218), ("time",)),
    "f05_stale_stamp": Right(60, 0, (295, 118), ("time",)),
    "f06_zero_fix": Right(90, 0, (1070, 445), ("place",), (48.1, 11.6)),
    "f07_odometry_without_tf": Right(60, 0, (0, 0)),
    "f08_autoware_stages": Right(120, 2, (526, 7), ("stage",)),
    "f09_array_on_named_topic": Right(180, 0, (177, 600)),
    "f10_message_mode/f10_message_mode_0": Right(60, 0, (295, 0)),
    "f11_ecef": Right(60, 0, (0, 590), (), (60.0, 20.0)),
    "f12_recycled_ids": Right(60, 2, (400, 350), ("identity",)),
    "f14_split/f14_split_0": Right(60, 0, (0, 0)),
    "f17_radians": Right(60, 0, (1180, 0), ("place",), (48.1, 11.6)),
    "f19_no_definition": Right(60, 0, (590, 0), (), (48.1, 11.6)),
    "f21_covariance_huge": Right(240, 4, (177, 300)),
    "f24_cov_1e308": Right(60, 1, (177, 0)),
    "f24_cov_1e9": Right(60, 1, (177, 0)),
    "f27_whole_second_stamps": Right(600, 1, (1198, 0), ("time",)),
    "f29_setpoint_named_target": Right(15, 1, (168, 0)),
    "f30_json_ais": Right(120, 2, (2950, 2360), (), (55.0, 4.0)),
    "f31_geojson_aircraft": Right(60, 1, (5900, 0), (), (47.0, 8.04)),
    "f34_loop_playback": Right(30, 1, (145, 0), ("time",)),
    "f38_flattened_array": Right(180, 3, (590, 1000), (), (55.0, 4.0)),
    "f41_vicon_transform_stamped": Right(15, 1, (28, 0)),
}
REFUSED = {
    "f14_split/f14_split_1": "in the frame radar, which no transform of the log joins",
    "f18_same_topic_two_schemas": "detections come in different frames: /target/position",
    "f22_types": "detections come in different frames",
    "f36_tf_zero_quaternion": "60 transforms have a rotation of zeros",
}


@pytest.fixture(scope="module")
def logs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder that the generators wrote into."""
    if not CASES.is_dir():
        pytest.skip("needs the generators in ../shared/cases")
    folder = tmp_path_factory.mktemp("cases")
    variables = os.environ | {"OUT": str(folder), "PYTHONPATH": str(CASES), "PYTHONDONTWRITEBYTECODE": "1"}
    subprocess.run([sys.executable, "-c", MAKE_ALL], cwd=CASES, env=variables, check=True, capture_output=True)
    return folder


@pytest.mark.parametrize("name", RIGHT)
def test_what_is_right(name: str, logs: Path, tmp_path: Path) -> None:
    settings, right = logs / f"{name.split('_')[0]}.toml", RIGHT[name]
    tables = load_tables(settings)["extract"] if settings.is_file() else {}
    found = run(tmp_path, logs / f"{name}.mcap", **tables)
    x, y = (np.asarray(found.detections[axis]) for axis in ("x_m", "y_m"))
    assert (found.summary["num_detections"], found.summary["num_agents"]) == (right.num, right.num_agents)
    assert (np.ptp(x), np.ptp(y)) == pytest.approx(right.extent_m, rel=0.01, abs=1.5)
    assert tuple(record["kind"] for record in found.summary["suspicions"]) == right.suspected
    if right.place is not None:
        latitude, longitude = to_geodetic(found.frame, x, y)
        assert (np.median(latitude), np.median(longitude)) == pytest.approx(right.place, abs=0.02)


@pytest.mark.parametrize("name", REFUSED)
def test_what_is_refused(name: str, logs: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=REFUSED[name]):
        run(tmp_path, logs / f"{name}.mcap")
