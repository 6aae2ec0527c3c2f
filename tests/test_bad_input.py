"""Bad input through the command line: one clear line, the right exit code, no traceback, no half-written file."""

import json
import math
import os
from pathlib import Path

import pytest
from fixtures.line_logs import Fix, straight_line, write_log

import cli

GRID = ["--set", "infer.grid.history_steps=16", "--set", "infer.grid.horizon_steps=8", "--set", "infer.grid.stride_steps=16"]
FAST = ["--set", "infer.checkpoint=none", "--set", "infer.num_hypotheses=4", *GRID, "--quiet"]
STAGE_FILES = {
    "ingest": {"catalogue.json"},
    "extract": {"detections.parquet", "truth.parquet", "poses.parquet", "obstacles.json"},
    "infer": {"hypotheses.parquet", "windows.parquet"},
}


def run(capsys, log: Path, out: Path, *more: str):
    """`cadence run`: exit code, the error lines (checked to be lines), the records of `--json`."""
    before = log.read_bytes() if log.is_file() else None
    code = cli.main(["run", str(log), "--out", str(out), "--json", *FAST, *more])
    captured = capsys.readouterr()
    if before is not None:
        assert log.read_bytes() == before, "the log itself was changed"
    return code, captured.err, json.loads(captured.out) if captured.out else None


def assert_refused(outcome, code: int, *says: str) -> None:
    got, err, _ = outcome
    assert got == code, err
    assert err.startswith("cadence: error: ") and err.count("\n") == 1 and "Traceback" not in err
    for words in says:
        assert words in err


def assert_no_partial_files(out: Path) -> None:
    """Nothing temporary is left, and a stage's files are there only together with its manifest."""
    files = {path.name for path in out.rglob("*")} if out.is_dir() else set()
    assert not [name for name in files if name.startswith(".")]
    for stage, names in STAGE_FILES.items():
        assert f"{stage}.manifest.json" in files or not files & names
    assert "infer.manifest.json" not in files and not [name for name in files if name.endswith((".cadence.mcap", ".html"))]


@pytest.fixture
def out(tmp_path):
    return tmp_path / "results"


@pytest.mark.parametrize(
    "content",
    [b"", b"\x89MCAP0", b"\x89MCAP0\r\n", b"not an MCAP at all " * 50, bytes(4096), b"\x89MCAP0\r\n" + bytes(4096)],
    ids=["empty", "half a magic", "magic only", "text", "zeros", "magic and zeros"],
)
def test_what_is_no_log_is_refused(content, tmp_path, out, capsys):
    log = tmp_path / "bad.mcap"
    log.write_bytes(content)
    assert_refused(run(capsys, log, out), 3, "bad.mcap")
    assert_no_partial_files(out)


def test_absent_log_and_folder_are_refused(tmp_path, out, capsys):
    assert_refused(run(capsys, tmp_path / "gone.mcap", out), 3, "gone.mcap")
    assert_refused(run(capsys, tmp_path, out), 3, str(tmp_path))
    assert_no_partial_files(out)


def test_log_without_messages_is_refused(tmp_path, out, capsys):
    assert_refused(run(capsys, write_log(tmp_path / "none.mcap", []), out), 3, "none.mcap")
    assert_no_partial_files(out)


def test_log_without_detections_is_refused_and_says_how_to_name_them(tmp_path, out, capsys):
    log = write_log(tmp_path / "notes.mcap", [], other_topics=["/notes"])
    assert_refused(run(capsys, log, out), 3)
    assert_no_partial_files(out)


@pytest.mark.parametrize("keep", [0.01, 0.5, 0.8])
def test_truncated_log_is_used_as_far_as_it_goes_and_the_loss_is_named(keep, tmp_path, out, capsys):
    whole = write_log(tmp_path / "whole.mcap", straight_line(200))
    cut = tmp_path / "cut.mcap"
    content = whole.read_bytes()
    cut.write_bytes(content[: int(len(content) * keep)])
    code, err, _ = run(capsys, cut, out)
    assert "Traceback" not in err
    if code != 7:  # nothing at all could be read
        assert_refused((code, err, None), 3, "cut.mcap")
        assert_no_partial_files(out)
    else:
        health = json.loads((out / "cut" / "catalogue.json").read_text())["health"]
        assert not health["is_complete"]
        assert 0 < health["num_messages"] < 200
        assert cli.main(["run", str(cut), "--out", str(out), *FAST]) == 7
        assert "damaged: Lost at byte" in capsys.readouterr().out


def test_nan_and_infinite_positions_are_dropped_and_never_reach_the_results(tmp_path, out, capsys):
    fixes = straight_line()
    fixes[3] = Fix(fixes[3].time_s, math.nan, 1.0)
    fixes[5] = Fix(fixes[5].time_s, math.inf, 1.0)
    fixes[7] = Fix(fixes[7].time_s, 1.0, -math.inf)
    code, err, _ = run(capsys, write_log(tmp_path / "nan.mcap", fixes), out)
    assert code == 0, err
    import numpy as np
    import pyarrow.parquet as pq

    detections = pq.read_table(out / "nan" / "detections.parquet")
    assert len(detections) == len(fixes) - 3
    positions = pq.read_table(out / "nan" / "hypotheses.parquet")["position_m"].combine_chunks().flatten().flatten()
    assert np.isfinite(positions.to_numpy(zero_copy_only=False)).all()


def test_only_nan_positions_is_no_usable_input(tmp_path, out, capsys):
    fixes = [Fix(fix.time_s, math.nan, math.nan) for fix in straight_line()]
    assert_refused(run(capsys, write_log(tmp_path / "nan.mcap", fixes), out), 3)
    assert_no_partial_files(out)


def test_out_of_order_time_stamps_give_the_same_detections(tmp_path, out, capsys):
    import pyarrow.parquet as pq

    fixes = straight_line()
    shuffled = fixes[::-1][::2] + fixes[::2]
    for name, order in (("sorted", sorted(shuffled, key=lambda fix: fix.time_s)), ("shuffled", shuffled)):
        code, err, _ = run(capsys, write_log(tmp_path / f"{name}.mcap", order), out)
        assert code == 0, err
    columns = ["time_ns", "x_m", "y_m"]
    tables = [pq.read_table(out / name / "detections.parquet", columns=columns) for name in ("sorted", "shuffled")]
    assert tables[0].to_pylist() == tables[1].to_pylist()


@pytest.mark.parametrize(
    ("source", "says"),
    [
        ('topic = "/nope"', "/nope"),
        ('topic = "/detections/target"\nx = "pose.position.east"\ny = "pose.position.y"', "east"),
        ('topic = "/detections/target"\nx = "pose..x"\ny = "pose.position.y"', "pose..x"),
        ('topic = "/detections/target"\nmessage_type = "Nope"', "Nope"),
    ],
    ids=["topic", "field", "path", "message_type"],
)
def test_mapping_that_does_not_fit_is_refused(source, says, tmp_path, out, capsys):
    config = tmp_path / "c.toml"
    config.write_text(f"[[extract.detections]]\n{source}\n")
    code, err, _ = run(capsys, write_log(tmp_path / "ok.mcap", straight_line()), out, "--config", str(config))
    assert code in (3, 4)
    assert_refused((code, err, None), code, says)
    assert_no_partial_files(out)


def test_unknown_configuration_key_is_refused_before_anything_is_written(tmp_path, out, capsys):
    log = write_log(tmp_path / "ok.mcap", straight_line())
    config = tmp_path / "c.toml"
    config.write_text("[infer]\nnum_hypothesis = 3\n")
    assert_refused(run(capsys, log, out, "--config", str(config)), 4, "num_hypothesis", "num_hypotheses")
    assert_refused(run(capsys, log, out, "--set", "infre.seed=1"), 4, "infre", "infer")
    assert_refused(run(capsys, log, out, "--config", str(tmp_path / "gone.toml")), 4, "gone.toml")
    assert not out.exists()


@pytest.mark.parametrize(
    ("weights", "description"),
    [
        (None, None),
        (b"not safetensors", b"{}"),
        (b"", b"not json"),
        (b"\x02\0\0\0\0\0\0\0{}", b'{"preset": "general", "network": {}, "format": 1}'),
    ],
    ids=["absent", "damaged", "not json", "other network"],
)
def test_checkpoint_that_does_not_fit_is_refused(weights, description, tmp_path, out, capsys):
    checkpoint = tmp_path / "net.safetensors"
    if weights is not None:
        checkpoint.write_bytes(weights)
        checkpoint.with_suffix(".json").write_bytes(description)
    log = write_log(tmp_path / "ok.mcap", straight_line())
    assert_refused(run(capsys, log, out, "--set", f"infer.checkpoint={checkpoint}"), 4, "net")
    assert_no_partial_files(out)


def test_folder_that_is_a_file_is_refused(tmp_path, capsys):
    log = write_log(tmp_path / "ok.mcap", straight_line())
    (tmp_path / "file").write_text("not a folder")
    assert_refused(run(capsys, log, tmp_path / "file"), 5, str(tmp_path / "file"))
    assert (tmp_path / "file").read_text() == "not a folder"


@pytest.mark.skipif(os.geteuid() == 0, reason="the superuser may write everywhere")
def test_read_only_folder_is_refused(tmp_path, capsys):
    log = write_log(tmp_path / "ok.mcap", straight_line())
    (tmp_path / "locked").mkdir(mode=0o555)
    assert_refused(run(capsys, log, tmp_path / "locked" / "out"), 5, "locked")


def test_a_bad_log_among_good_ones_costs_only_itself(tmp_path, out, capsys):
    good = [write_log(tmp_path / f"good{i}.mcap", straight_line(6)) for i in range(2)]
    bad = tmp_path / "bad.mcap"
    bad.write_bytes(b"not an MCAP")
    code = cli.main(["run", str(good[0]), str(bad), str(good[1]), "--out", str(out), "--json", *FAST])
    captured = capsys.readouterr()
    records = json.loads(captured.out)
    assert code == 3 and [record["error"] is None for record in records] == [True, False, True]
    assert captured.err.count("\n") == 1 and "bad.mcap" in captured.err
    assert {path.name for path in out.rglob("report.html")} and (out / "good1" / "good1.cadence.mcap").is_file()


@pytest.mark.parametrize("command", ["extract", "infer", "retrospect", "export", "report", "evaluate"])
def test_stage_without_what_it_needs_says_which_stage_to_run(command, tmp_path, capsys):
    (tmp_path / "mission").mkdir()
    settings = ["--set", "infer.checkpoint=none"] if command == "infer" else []
    code = cli.main([command, str(tmp_path / "mission"), "--quiet", *settings])
    captured = capsys.readouterr()
    assert_refused((code, captured.err, None), 3)
    assert captured.out == "" and list((tmp_path / "mission").iterdir()) == []


@pytest.mark.parametrize("content", [b"", b"not an MCAP"])
def test_info_refuses_what_is_no_log(content, tmp_path, capsys):
    (tmp_path / "bad.mcap").write_bytes(content)
    code = cli.main(["info", str(tmp_path / "bad.mcap")])
    captured = capsys.readouterr()
    assert_refused((code, captured.err, None), 3, "bad.mcap")


def test_info_shows_what_is_left_of_a_damaged_log(tmp_path, capsys):
    (tmp_path / "bad.mcap").write_bytes(b"\x89MCAP0\r\n" + bytes(100))
    assert cli.main(["info", str(tmp_path / "bad.mcap")]) == 7
    assert "DAMAGED" in capsys.readouterr().out


def test_a_log_with_the_longest_name_has_results(tmp_path, out, capsys):
    log = write_log(tmp_path / f"{'n' * 250}.mcap", straight_line())
    code, err, _ = run(capsys, log, out)
    assert code == 0, err
    (directory,) = (path for path in out.iterdir() if path.is_dir())
    assert {path.suffix for path in directory.iterdir()} >= {".mcap", ".html"}
