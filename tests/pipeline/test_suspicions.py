"""Suspicions: one list, told by every command, with an exit code of their own; and no word where nothing is amiss."""

import json
from pathlib import Path

import pytest
from fixtures.small_logs import Row, stamp, write_log

from cadence.errors import ImplausibleInputError
from cli import main
from pipeline.extract.config import ExtractConfig
from pipeline.extract.stage import extract
from pipeline.ingest.stage import IngestConfig, ingest
from pipeline.inspect.doctor import diagnose, exit_code, render
from pipeline.progress import Progress
from pipeline.suspicions import Suspicion, Suspicions, few, suspicions_in

QUIET = Progress(quiet=True)
TINY = [
    "--set", "infer.checkpoint=none", "--set", "infer.num_hypotheses=2", "--set", "infer.association.num_particles=8",
    "--set", "infer.grid.stride_steps=16", "--set", "infer.association.num_agents=2", "--quiet",
    "--set", "infer.grid.history_steps=16", "--set", "infer.grid.horizon_steps=8",
]  # fmt: skip
SENTENCE = 'identity of /fixes: 12 of 12 messages have "T" at several places; 24 detections are of unknown origin'


def three(second: float, ids: list[str], shift_m: float = 300.0) -> Row:
    """One `vision_msgs/Detection3DArray` of targets beside each other."""
    items = [
        {"id": name, "bbox": {"center": {"position": {"x": 5.0 * second, "y": shift_m * place, "z": 0.0}}}, "results": []}
        for place, name in enumerate(ids)
    ]
    header = {"stamp": stamp(second), "frame_id": "map"}
    return Row("/fixes", "vision_msgs/Detection3DArray", second, {"header": header, "detections": items})


@pytest.fixture
def log(tmp_path: Path) -> Path:
    """Two targets to which the detector gives one name."""
    return write_log(tmp_path / "shared.mcap", [three(float(i), ["T", "T"]) for i in range(12)])


def test_a_suspicion_is_one_sentence_and_survives_a_manifest() -> None:
    found = Suspicions()
    for _ in range(2):
        found.add("time", "/a", seen="stamps stand still", done="log times are used", setting='time = "log_time"')
    sentence = 'time of /a: stamps stand still; log times are used; to decide otherwise: time = "log_time"'
    assert found.lines() == [sentence] and len(found) == 1
    assert suspicions_in(json.loads(json.dumps({"suspicions": found.records()}))) == [sentence] and suspicions_in({}) == []
    assert not Suspicions(["time"]).looks_for("time") and Suspicions(["time"]).looks_for("place")
    assert few([sentence] * 10) == [sentence] * 10
    assert few([sentence] * 15) == [*[sentence] * 10, "5 more are in extract.manifest.json"]
    assert Suspicion(**found.records()[0]).kind == "time"


def test_every_command_tells_it_and_leaves_with_8(log: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "out"
    assert main(["run", str(log), "--out", str(out), *TINY]) == 8
    told = capsys.readouterr().out
    assert "doubtful" in told and f"shared: suspected {SENTENCE}" in told
    record = json.loads((out / "batch.json").read_text())
    assert (record["exit_code"], record["num_doubtful"], record["logs"][0]["status"]) == (8, 1, "doubtful")
    (kept,) = json.loads((out / "shared" / "extract.manifest.json").read_text())["summary"]["suspicions"]
    assert (kept["kind"], kept["subject"], kept["done"]) == ("identity", "/fixes", "24 detections are of unknown origin")
    page = (out / "shared" / "report.html").read_text()
    assert page.index("What is suspected") < page.index("Chosen moments") and "24 detections are of unknown origin" in page
    assert main(["extract", str(out / "shared"), "--quiet"]) == 8 and SENTENCE in capsys.readouterr().out
    assert main(["doctor", str(log), "--quiet"]) == 8
    told = capsys.readouterr().out
    assert "SOUND; DOUBTFUL: 1 thing" in told and f"What is suspected:\n  {SENTENCE}" in told


def test_strict_refuses_and_leaves_nothing(log: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["run", str(log), "--out", str(tmp_path / "out"), "--strict", *TINY]) == 8
    (complaint,) = capsys.readouterr().err.splitlines()
    assert complaint.startswith(f"cadence: error: {log}: refused by --strict") and SENTENCE in complaint
    assert not (tmp_path / "out" / "shared" / "detections.parquet").exists()
    directory = tmp_path / "one"
    ingest(log, directory, IngestConfig(), QUIET)
    with pytest.raises(ImplausibleInputError, match="--strict"):
        extract(directory, ExtractConfig(is_strict=True), QUIET)
    assert main(["extract", str(directory), "--strict", "--quiet"]) == 8
    assert "refused" in capsys.readouterr().err


@pytest.mark.parametrize("setting", ['trusted=["identity"]', "detections=[{topic='/fixes', has_identity=false}]"])
def test_a_stated_setting_silences_it(setting: str, log: Path, tmp_path: Path) -> None:
    assert main(["run", str(log), "--out", str(tmp_path / "out"), "--strict", "--set", f"extract.{setting}", *TINY]) == 0


def test_suspicion_counts_more_than_damage_and_less_than_failure(log: Path, tmp_path: Path) -> None:
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(log.read_bytes()[:-300])
    doubtful = diagnose([log], QUIET)
    partial = diagnose([cut], QUIET)
    assert exit_code([doubtful]) == exit_code([partial, doubtful]) == 8
    assert exit_code([doubtful, diagnose([tmp_path / "none.mcap"], QUIET)]) == 3
    assert render(doubtful).startswith(f"{log}: SOUND; DOUBTFUL")
