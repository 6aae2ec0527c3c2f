#!/usr/bin/env bash
# Rerun 0.41.0: of the fixes of one foxglove.LocationFixes only the last is there at any moment.
#
# Behaviour. The importer of MCAP makes a row with one position of every fix of a message. All these rows have the time of the message, and
# Rerun answers what is at a time with the last row up to then: of three vehicles whose fixes come in one message two are never seen,
# unless a view is told to show a range of time, and nothing is said. A PointCloud becomes one row with all of its points.
#
# Input. A log, written by Foxglove's SDK: two messages, a second apart, each of three fixes; beside them clouds of three points.
#
# Output seen:
#   rerun-sdk 0.41.0, foxglove-sdk 0.30.3
#   half a second after the first message: 1 of 3 fixes, the last one; 3 of 3 points of the cloud
#   at the times of both messages: 1 and 1 fixes, 3 and 3 points
#   as stated
#
# Exit: 0 the behaviour is as stated, 1 it is another one, 2 the packages could not be installed.
set -euo pipefail

folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv" || exit 2
"$folder/venv/bin/python" -m pip install --quiet "rerun-sdk[catalog]==0.41.0" foxglove-sdk==0.30.3 >"$folder/pip.log" 2>&1 || {
  tail -n 3 "$folder/pip.log" >&2
  exit 2
}

cat > "$folder/probe.py" <<'PROBE'
import importlib.metadata
import pathlib
import struct
import subprocess
import sys

import foxglove
import numpy as np
import rerun.server
from foxglove.channels import LocationFixesChannel, PointCloudChannel
from foxglove.messages import (
    Color, LocationFix, LocationFixes, PackedElementField, PackedElementFieldNumericType, PointCloud, Pose, Quaternion, Timestamp, Vector3,
)

START_S, NUM_MESSAGES, NUM_FIXES = 1_700_000_000, 2, 3
FOLDER = pathlib.Path(sys.argv[1])
AXES = [
    PackedElementField(name=name, offset=4 * number, type=PackedElementFieldNumericType.Float32) for number, name in enumerate("xyz")
]


def north_deg(second, number):
    return 50.0 + 0.01 * second + 0.001 * number


path = FOLDER / "swarm.mcap"
fixes, cloud = LocationFixesChannel("/fixes"), PointCloudChannel("/cloud")
with foxglove.open_mcap(str(path)):
    for second in range(NUM_MESSAGES):
        stamp, red = Timestamp(sec=START_S + second, nsec=0), Color(r=1.0, g=0.0, b=0.0, a=1.0)
        time_ns = (START_S + second) * 1_000_000_000
        found = [
            LocationFix(timestamp=stamp, frame_id="map", latitude=north_deg(second, number), longitude=-1.0, color=red)
            for number in range(NUM_FIXES)
        ]
        fixes.log(LocationFixes(fixes=found), log_time=time_ns)
        pose = Pose(position=Vector3(x=0.0, y=0.0, z=0.0), orientation=Quaternion(x=0.0, y=0.0, z=0.0, w=1.0))
        points = struct.pack("<9f", *range(9))
        cloud.log(
            PointCloud(timestamp=stamp, frame_id="map", pose=pose, point_stride=12, fields=AXES, data=points), log_time=time_ns
        )
converted = FOLDER / "swarm.rrd"
subprocess.run([FOLDER / "venv/bin/rerun", "mcap", "convert", path, "-o", converted], check=True, capture_output=True)


def at(view_options):
    """Positions of fixes and points of the cloud, a list a time each."""
    table = data.reader(index="message_log_time", **view_options).to_arrow_table()
    return table["/fixes:GeoPoints:positions"].to_pylist(), table["/cloud:Points3D:positions"].to_pylist()


with rerun.server.Server(datasets={"swarm": [str(converted)]}) as server:
    data = server.client().get_dataset("swarm")
    between = np.array([START_S * 1_000_000_000 + 500_000_000], dtype="datetime64[ns]")
    (seen,), (points,) = at({"fill_latest_at": True, "using_index_values": between})
    all_seen, all_points = at({})
is_last = len(seen) == 1 and abs(seen[0][0] - north_deg(0, NUM_FIXES - 1)) < 1e-9
print(", ".join(f"{name} {importlib.metadata.version(name)}" for name in ("rerun-sdk", "foxglove-sdk")))
print(
    f"half a second after the first message: {len(seen)} of {NUM_FIXES} fixes, {'the last one' if is_last else 'not the last one'}; "
    f"{len(points)} of 3 points of the cloud"
)
numbers = [[len(one) for one in each] for each in (all_seen, all_points)]
print("at the times of both messages: {} and {} fixes, {} and {} points".format(*numbers[0], *numbers[1]))
is_as_stated = is_last and len(points) == 3 and numbers == [[1, 1], [3, 3]]
print("as stated" if is_as_stated else "the behaviour is another one")
sys.exit(0 if is_as_stated else 1)
PROBE
"$folder/venv/bin/python" "$folder/probe.py" "$folder"
