"""That nothing is to be done is said before anything is imported that would do it."""

import subprocess
import sys
from pathlib import Path

import pytest
from fixtures.batch import FLAGS, start, write_tiny_logs

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


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """A log, and where its run is finished."""
    logs = write_tiny_logs(tmp_path_factory.mktemp("finished") / "logs", 1)
    process = start(logs, "--out", logs.parent / "out")
    process.join()
    assert process.exitcode == 0
    return logs, logs.parent / "out"


def test_a_finished_mission_is_skipped_without_what_computes(finished: tuple[Path, Path]) -> None:
    logs, out = finished
    said = run(logs, "--out", out)
    assert "skipped" in said
    assert said.splitlines()[-1] == "loaded:"


def test_a_changed_setting_of_one_stage_is_done_again(finished: tuple[Path, Path]) -> None:
    logs, out = finished
    said = run(logs, "--out", out, "--set", "report.num_moments=2")
    assert "done" in said and "torch" in said.splitlines()[-1]
    assert "skipped" in run(logs, "--out", out, "--set", "report.num_moments=2")
