#!/usr/bin/env bash
# Rerun 0.41.0: a foxglove.LocationFixes that holds no fix ends the importer with a panic, and with it whatever was being opened.
#
# Behaviour. The importer of MCAP makes a row of every fix of a message. Where one message of a chunk holds none, an index goes past the
# end (re_chunk/src/chunk.rs:1044; where the fixes have no colours an assertion of arrow-buffer fails before) and the process ends with
# exit code 102: at `rerun mcap convert`, and likewise when the viewer opens the file. What was recorded on all other topics from
# that chunk on is lost with it. `rerun mcap check --full` finds nothing wrong. An empty list is a valid message, and the only way to say
# on this topic that nobody is seen any more.
#
# Input. Two logs, written by Foxglove's SDK: three messages of fixes and three of another topic. In one of them the second message of
# fixes is empty; the other is the counter-check.
#
# Output seen:
#   rerun-sdk 0.41.0, foxglove-sdk 0.30.3
#   every message has fixes: exit code 0, rows of /fixes 9, of /other 3
#   one message has none: exit code 102, rows of /fixes 0, of /other 0
#   panicked at 'index out of bounds: the len is 6 but the index is 6'
#   opened instead of converted: exit code 102, the same panic
#   checked: exit code 0, and nothing found
#   as stated
#
# Exit: 0 the behaviour is as stated, 1 it is another one, 2 the packages could not be installed.
set -euo pipefail

folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv" || exit 2
"$folder/venv/bin/python" -m pip install --quiet rerun-sdk==0.41.0 foxglove-sdk==0.30.3 >"$folder/pip.log" 2>&1 || {
  tail -n 3 "$folder/pip.log" >&2
  exit 2
}

cat > "$folder/probe.py" <<'PROBE'
import importlib.metadata
import pathlib
import re
import subprocess
import sys

import foxglove
from foxglove.channels import LocationFixChannel, LocationFixesChannel
from foxglove.messages import Color, LocationFix, LocationFixes, Timestamp

START_S = 1_700_000_000
FOLDER = pathlib.Path(sys.argv[1])
RERUN = FOLDER / "venv/bin/rerun"


def fix(second, north_deg):
    red, stamp = Color(r=1.0, g=0.0, b=0.0, a=1.0), Timestamp(sec=START_S + second, nsec=0)
    return LocationFix(timestamp=stamp, frame_id="map", latitude=50.0 + north_deg, longitude=-1.0, color=red)


def recording(name, num_fixes):
    path = FOLDER / f"{name}.mcap"
    fixes, other = LocationFixesChannel("/fixes"), LocationFixChannel("/other")
    with foxglove.open_mcap(str(path)):
        for second, number in enumerate(num_fixes):
            time_ns = (START_S + second) * 1_000_000_000
            fixes.log(LocationFixes(fixes=[fix(second, 0.001 * each) for each in range(number)]), log_time=time_ns)
            other.log(fix(second, 0.0), log_time=time_ns)
    fixes.close()
    other.close()
    return path


def called(*words):
    done = subprocess.run([RERUN, *words], stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, cwd=FOLDER, timeout=120)
    return done.returncode, done.stdout


def converted(path):
    """Exit code, what was said, and the rows of positions on both topics."""
    code, said = called("mcap", "convert", path, "-o", path.with_suffix(".rrd"))
    _, printed = called("rrd", "print", path.with_suffix(".rrd"))
    found = re.findall(r"with (\d+) rows \(.*\) - (/\w+) - data columns: .*GeoPoints:positions", printed)
    rows = {topic: int(number) for number, topic in found}
    return code, said, (rows.get("/fixes", 0), rows.get("/other", 0))


print(", ".join(f"{name} {importlib.metadata.version(name)}" for name in ("rerun-sdk", "foxglove-sdk")))
full, empty = recording("full", (3, 3, 3)), recording("empty", (3, 0, 3))
results = []
for words, path in (("every message has fixes", full), ("one message has none", empty)):
    code, said, rows = converted(path)
    results.append((code, rows))
    print(f"{words}: exit code {code}, rows of /fixes {rows[0]}, of /other {rows[1]}")
panic = re.search(r"panicked at '.*'", said)
print(panic[0] if panic else "no panic")
opened, told = called(empty, "--save", FOLDER / "opened.rrd", "--port", "auto") if panic else (0, "")
is_ended = bool(panic) and panic[0] in told
print(f"opened instead of converted: exit code {opened}, {'the same' if is_ended else 'no such'} panic")
checked, report = called("mcap", "check", "--full", empty)
is_found = len(re.findall(r"^ok ", report, re.MULTILINE)) != 2
print(f"checked: exit code {checked}, and {'something' if is_found else 'nothing'} found")
is_as_stated = results == [(0, (9, 3)), (102, (0, 0))] and panic and opened == 102 and is_ended and checked == 0 and not is_found
print("as stated" if is_as_stated else "the behaviour is another one")
sys.exit(0 if is_as_stated else 1)
PROBE
"$folder/venv/bin/python" "$folder/probe.py" "$folder"
