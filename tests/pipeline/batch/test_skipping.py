"""That nothing is to be done is said before anything is imported that would do it."""

import subprocess
import sys
from pathlib import Path

from fixtures.batch import FLAGS, write_tiny_logs

HEAVY = ("torch", "scipy", "shapely", "pyproj", "matplotlib")

RUN = f"""
import sys
import cli
code = cli.main(sys.argv[1:])
print("loaded:", *sorted(set({HEAVY!r}) & set(sys.modules)))
raise SystemExit(code)
"""


def run(*arguments: object) -> str:
    command = [sys.executable, "-c", RUN, "run", *map(str, arguments), *FLAGS, "--workers", "0"]
    return subprocess.run(command, check=True, capture_output=True, text=True).stdout


def test_a_finished_mission_is_skipped_without_what_computes(tmp_path: Path) -> None:
    logs = write_tiny_logs(tmp_path / "logs", 1)
    first, second = (run(logs, "--out", tmp_path / "out") for _ in range(2))
    assert "loaded: " in first and "torch" in first.splitlines()[-1]
    assert "skipped" in second
    assert second.splitlines()[-1] == "loaded:"


def test_a_changed_setting_of_one_stage_is_done_again(tmp_path: Path) -> None:
    logs = write_tiny_logs(tmp_path / "logs", 1)
    run(logs, "--out", tmp_path / "out")
    assert "done" in run(logs, "--out", tmp_path / "out", "--set", "report.num_moments=2")
    assert "skipped" in run(logs, "--out", tmp_path / "out", "--set", "report.num_moments=2")
