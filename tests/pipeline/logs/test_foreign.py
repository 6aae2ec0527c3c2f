"""What is no log: what it is instead, and the way on, which is walked."""

import json
import re
import shlex
import subprocess
import sys
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from fixtures.line_logs import straight_line, write_log
from rosbags.rosbag1 import Writer as BagWriter
from rosbags.rosbag2 import Writer as Bag2Writer
from rosbags.typesys import Stores, get_typestore

import cli
from cadence.errors import InputError
from pipeline.logs.reader import open_log
from pipeline.missions import find_missions


def write_bag(path: Path) -> Path:
    """Thirty poses as a ROS 1 bag, or as the folder of a rosbag2 in SQLite where the name has no suffix."""
    is_ros1 = path.suffix == ".bag"
    store = get_typestore(Stores.ROS1_NOETIC if is_ros1 else Stores.ROS2_HUMBLE)
    kind, name = store.types["geometry_msgs/msg/PointStamped"], "geometry_msgs/msg/PointStamped"
    header, stamp, point = (
        store.types[each] for each in ("std_msgs/msg/Header", "builtin_interfaces/msg/Time", "geometry_msgs/msg/Point")
    )
    with BagWriter(path) if is_ros1 else Bag2Writer(path, version=9) as writer:
        connection = writer.add_connection("/target/detections", name, typestore=store)
        for second in range(1_700_000_000, 1_700_000_030):
            number = {"seq": second} if is_ros1 else {}
            message = kind(header(**number, stamp=stamp(second, 0), frame_id="map"), point(float(second % 100), 2.0, 0.0))
            data = store.serialize_ros1(message, name) if is_ros1 else store.serialize_cdr(message, name)
            writer.write(connection, second * 10**9, data)
    return path


def refusal(*logs: Path) -> str:
    with pytest.raises(InputError) as caught:
        find_missions([str(log) for log in logs], "out")
    assert "\n" not in str(caught.value)
    return str(caught.value)


def follow(advice: str, folder: Path) -> Path:
    """Runs the command that stands in backquotes; the folder that it is said to make."""
    command = re.search(r"`rosbags-convert (.*?)`, and give the folder (\S+)", advice)
    tool = Path(sys.executable).with_name("rosbags-convert")
    subprocess.run([tool, *command[1].split()], cwd=folder, check=True, capture_output=True)
    return folder / command[2]


@pytest.mark.parametrize("name", ["flight.bag", "flight"])
def test_bags_are_told_how_to_become_logs(name, tmp_path):
    bag = write_bag(tmp_path / name)
    file = bag if bag.is_file() else bag / "flight.db3"
    with pytest.raises(InputError, match=r"is not an MCAP file but a (ROS 1 bag|rosbag2 in SQLite); convert") as caught:
        open_log(file)
    assert refusal(bag.parent if bag.is_file() else bag).partition(" is a ")[2] in str(caught.value).partition(" but a ")[2]
    (mission,) = find_missions([str(follow(str(caught.value), tmp_path))], "out")
    (part,) = mission.parts
    assert open_log(part).health.num_messages == 30


@pytest.mark.parametrize("name", ["plots.csv", "plots.parquet", "plots.geojson"])
def test_a_table_is_told_the_command_that_makes_a_log_of_it_and_that_works(name, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    columns = {
        "time_s": [1_700_000_000 + i for i in range(20)],
        "x_m": [3.0 * i for i in range(20)],
        "y_m": [2.0 * i for i in range(20)],
    }
    columns["agent"] = ["ferry-7"] * 20
    if name.endswith(".csv"):
        lines = zip(*columns.values(), strict=True)
        Path(name).write_text("\n".join([",".join(columns), *(",".join(map(str, line)) for line in lines)]) + "\n")
    elif name.endswith(".parquet"):
        pq.write_table(pa.table(columns), name)
    else:
        place = {"type": "Point", "coordinates": [8.5, 50.0]}
        feature = {"type": "Feature", "properties": {"time": 1_700_000_000, "agent": "ferry-7"}, "geometry": place}
        Path(name).write_text(json.dumps({"type": "FeatureCollection", "features": [feature]}))
    assert cli.main(["run", name, "--out", "out", "-q"]) == 3
    told = capsys.readouterr().err
    command = re.search(r"`cadence (.*?)` makes a log of its positions", told)
    assert command and told.count("\n") == 1 and f"{name} is " in refusal(tmp_path)
    assert cli.main(shlex.split(command[1])) == 0
    assert open_log("plots.mcap").health.num_messages == (1 if name.endswith("json") else 20)


def test_folders_without_logs_say_what_they_are(tmp_path, capsys):
    log = write_log(tmp_path / "a.mcap", straight_line())
    assert cli.main(["ingest", str(log), "--out", str(tmp_path / "out"), "-q"]) == 0
    assert f"a: is a mission directory, not a folder of logs; its log is {log}" in refusal(tmp_path / "out" / "a")
    side = tmp_path / "out" / "a" / "a.cadence.mcap"
    side.write_bytes(log.read_bytes())
    assert refusal(side).endswith("a.cadence.mcap: was written by cadence export; name the log that it belongs to")
    (tmp_path / "none").mkdir()
    assert refusal(tmp_path / "none").endswith("none: holds no MCAP log; name a log or another folder")
