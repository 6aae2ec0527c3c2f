"""From a log to what a person opens: everything is there, readable by others, repeatable, and the log itself is untouched."""

import hashlib
import json
import shutil
from collections import Counter
from pathlib import Path

import pytest
from fixtures.line_logs import straight_line, write_log
from mcap.reader import make_reader

import cli
from pipeline import files
from pipeline.evaluate.stage import EvaluateConfig, evaluate
from pipeline.files import hash_file
from pipeline.progress import Progress

ROOT = Path(__file__).resolve().parents[1]
SHIPPED = sorted((ROOT / "cadence" / "checkpoints").glob("*.safetensors"))
GRID = ["--set", "infer.grid.history_steps=16", "--set", "infer.grid.horizon_steps=8", "--set", "infer.grid.stride_steps=16"]
SMALL = ["--set", "infer.num_hypotheses=5", *GRID, "--json", "--quiet"]
BANK = ["--set", "infer.checkpoint=none"]
TABLES = ("detections.parquet", "hypotheses.parquet", "windows.parquet")
RESULTS = (*TABLES, "walk.cadence.mcap", "walk.layout.json", "report.html")


def run(capsys, log: Path, out: Path, *more: str) -> list[dict]:
    assert cli.main(["run", str(log), "--out", str(out), *SMALL, *more]) == 0
    captured = capsys.readouterr()
    assert captured.err == ""
    return json.loads(captured.out)


@pytest.fixture
def log(tmp_path):
    return write_log(tmp_path / "walk.mcap", straight_line(10))


def test_all_results_are_there_and_the_log_is_untouched(log, tmp_path, capsys):
    before = hash_file(log)
    (record,) = run(capsys, log, tmp_path / "out", *BANK)
    assert [stage["stage"] for stage in record["stages"]] == ["ingest", "extract", "infer", "retrospect", "export", "report"]
    assert record["error"] is None and {stage["status"] for stage in record["stages"]} == {"done"}
    mission = tmp_path / "out" / "walk"
    assert record["directory"] == str(mission) and all((mission / name).is_file() for name in RESULTS)
    assert not [path for path in mission.iterdir() if path.name.startswith(".")]
    assert hash_file(log) == before


def test_side_file_opens_with_checksums_and_agrees_with_its_statistics(log, tmp_path, capsys):
    run(capsys, log, tmp_path / "out", *BANK)
    with (tmp_path / "out" / "walk" / "walk.cadence.mcap").open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        summary = reader.get_summary()
        counts = Counter(channel.topic for _, channel, _ in reader.iter_messages())
        metadata = {record.name: record.metadata for record in reader.iter_metadata()}
    stated = {summary.channels[number].topic: count for number, count in summary.statistics.channel_message_counts.items()}
    assert dict(counts) == {topic: count for topic, count in stated.items() if count}
    assert counts["/cadence/hypotheses"] > 0 and counts["/cadence/scene"] > 0 and "cadence" in metadata


def test_second_run_does_nothing_and_a_changed_setting_redoes_what_depends_on_it(log, tmp_path, capsys):
    run(capsys, log, tmp_path / "out", *BANK)
    (again,) = run(capsys, log, tmp_path / "out", *BANK)
    assert {stage["status"] for stage in again["stages"]} == {"skipped"}
    (changed,) = run(capsys, log, tmp_path / "out", *BANK, "--set", "infer.num_hypotheses=6")
    assert [stage["status"] for stage in changed["stages"]] == ["skipped", "skipped", "done", "done", "done", "done"]


def test_same_seed_same_bytes_other_seed_other_hypotheses(log, tmp_path, capsys):
    for name, seed in (("a", 3), ("b", 3), ("c", 4)):
        run(capsys, log, tmp_path / name, *BANK, "--seed", str(seed))
    files = (*TABLES, "walk.cadence.mcap", "report.html")
    a, b, c = ({name: hash_file(tmp_path / out / "walk" / name) for name in files} for out in "abc")
    assert a == b
    assert a["hypotheses.parquet"] != c["hypotheses.parquet"] and a["detections.parquet"] == c["detections.parquet"]


def test_stages_one_by_one_give_what_run_gives(log, tmp_path, capsys):
    run(capsys, log, tmp_path / "run", *BANK)
    mission = str(tmp_path / "single" / "walk")
    settings = ["--quiet", *SMALL[:-2], *BANK]
    assert cli.main(["ingest", str(log), "--out", str(tmp_path / "single"), "-q"]) == 0
    for command in ("extract", "infer", "retrospect", "export", "report"):
        assert cli.main([command, mission, *settings]) == 0
    for name in RESULTS:
        assert hash_file(Path(mission) / name) == hash_file(tmp_path / "run" / "walk" / name), name


def test_a_run_hashes_the_log_once(log, tmp_path, capsys, monkeypatch):
    hashed = []

    def digest(file, *name):
        hashed.append(file.name)
        return real(file, *name)

    real = hashlib.file_digest
    monkeypatch.setattr(hashlib, "file_digest", digest)
    monkeypatch.setattr(files, "_SETTLED_NS", 0)
    run(capsys, log, tmp_path / "out", *BANK)
    assert hashed.count(str(log)) == 1


def test_every_stage_makes_the_same_of_its_declared_inputs_alone(tmp_path, capsys):
    simulate = ["simulate", "--out", str(tmp_path / "logs"), "--set", "simulate.patrol.duration_s=600", "--json", "-q"]
    assert cli.main(simulate) == 0
    (log,) = json.loads(capsys.readouterr().out)["outputs"]
    grid = ["--set", "infer.grid.step_s=5", "--set", "infer.grid.context_steps=160"]  # of which evaluate hears from infer
    settings = [*BANK, *SMALL[:-2], *grid, "--quiet"]
    assert cli.main(["run", log, "--out", str(tmp_path / "out"), *settings]) == 0
    mission = tmp_path / "out" / Path(log).stem
    scoring = EvaluateConfig(rivals=("linear", "hold"), num_resamples=20)  # rivals that cost nothing to fit
    evaluate(mission, scoring, Progress(quiet=True))
    for stage in ("extract", "infer", "export", "report", "evaluate"):
        manifest = json.loads((mission / f"{stage}.manifest.json").read_text())
        alone = tmp_path / stage / mission.name
        alone.mkdir(parents=True)
        for name in manifest["inputs"]:
            if (mission / name).is_file():  # others belong to the program
                shutil.copy(mission / name, alone / name)
        if stage == "evaluate":
            evaluate(alone, scoring, Progress(quiet=True))
        else:
            assert cli.main([stage, str(alone), *settings]) == 0
        made = json.loads((alone / f"{stage}.manifest.json").read_text())
        assert made["outputs"] == manifest["outputs"], stage


def test_hypotheses_depend_on_the_beginning_of_the_log(log, tmp_path, capsys):
    run(capsys, log, tmp_path / "out", *BANK)
    mission = tmp_path / "out" / "walk"
    catalogue = json.loads((mission / "catalogue.json").read_text())
    for changed, status in (({"path": str(tmp_path / "elsewhere.mcap")}, "skipped"), ({"start_ns": 0}, "done")):
        (mission / "ingest.manifest.json").unlink(missing_ok=True)  # it would vouch for the catalogue as it was
        (mission / "catalogue.json").write_text(json.dumps({**catalogue, **changed}))
        assert cli.main(["infer", str(mission), *SMALL, *BANK]) == 0
        assert json.loads(capsys.readouterr().out)["status"] == status


@pytest.mark.skipif(not SHIPPED, reason="this checkout holds no trained checkpoint")
def test_shipped_checkpoint_is_the_default(log, tmp_path, capsys):
    (record,) = run(capsys, log, tmp_path / "out")
    summary = next(stage["summary"] for stage in record["stages"] if stage["stage"] == "infer")
    assert summary["checkpoint_sha256"] and summary["checkpoint"] in {path.stem for path in SHIPPED}


def test_simulated_mission_can_be_scored(tmp_path, capsys):
    simulate = ["simulate", "--out", str(tmp_path / "logs"), "--seed", "5", "--set", "simulate.patrol.duration_s=600"]
    assert cli.main([*simulate, "--set", "simulate.patrol.detection_rate=0.3", "--json", "-q"]) == 0
    (log,) = json.loads(capsys.readouterr().out)["outputs"]
    run(capsys, Path(log), tmp_path / "out", *BANK, "--set", "infer.guidance.mode=none", "--set", "infer.grid.step_s=10")
    scoring = ["--set", "evaluate.num_resamples=20", "--set", 'evaluate.rivals=["cv", "hold"]']
    assert cli.main(["evaluate", str(tmp_path / "out" / Path(log).stem), "-q", *scoring]) == 0
    assert "cadence" in capsys.readouterr().out
    assert (tmp_path / "out" / Path(log).stem / "scores.md").read_text().startswith("# Scores")
