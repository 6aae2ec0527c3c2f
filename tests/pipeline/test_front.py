"""The front door for Python: what it refuses, and how failures are told."""

from pathlib import Path

import pytest
from fixtures.mission import build_mission

from cadence.errors import ConfigError, InputError
from pipeline.front import evaluate_mission, open_mission, run_logs


def test_a_mission_is_opened_and_what_is_none_is_refused(tmp_path: Path) -> None:
    directory = build_mission(tmp_path)
    mission = open_mission(str(directory))
    assert mission.table("detections").num_rows > 0 and mission.hypotheses is mission.hypotheses
    with pytest.raises(InputError, match=r"nothing\.parquet: not found"):
        mission.table("nothing")
    with pytest.raises(InputError, match="no mission directory"):
        open_mission(tmp_path)


def test_settings_are_read_as_strictly_as_files(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="infer: unknown key 'num_hypothesis'"):
        run_logs("a.mcap", tmp_path, {"infer": {"num_hypothesis": 5}})
    with pytest.raises(ConfigError, match="rival 'best' is not known"):
        evaluate_mission(tmp_path, {"rivals": ["best"]})


def test_a_log_that_fails_is_told_in_its_outcome(tmp_path: Path) -> None:
    log = tmp_path / "broken.mcap"
    log.write_bytes(b"no log at all")
    (outcome,) = run_logs(log, tmp_path / "out")
    assert outcome.status == "failed" and outcome.exit_code == 3 and "broken.mcap" in outcome.message
