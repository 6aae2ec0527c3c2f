"""Missions from a bucket to a bucket: the same bytes as here, nothing twice, nothing half, nothing of one log harms another."""

import json
from pathlib import Path

import pytest
from fixtures.batch import SETTINGS
from fixtures.line_logs import straight_line, write_log

import pipeline.batch.remote as module
from cadence.errors import DeviceError
from pipeline.batch.config import RunConfig
from pipeline.batch.outcome import exit_code
from pipeline.batch.remote import RECEIPT_NAME, SOURCE_NAME, run_anywhere
from pipeline.batch.run import run
from pipeline.config import stage_config
from pipeline.missions import find_missions
from pipeline.progress import Progress
from pipeline.stores.objects import list_folder, read_bytes, remove, write_file

pytest_plugins = ("fixtures.s3",)
QUIET = Progress(quiet=True)
STAGES = ("ingest", "extract", "infer", "retrospect", "export", "report")


def config(*more):
    tiny = [f"{name}={value}" for name, value in SETTINGS.items()]
    return stage_config(RunConfig, None, None, [*tiny, "export.tick_s=10", *more])


@pytest.fixture
def logs(tmp_path, s3, monkeypatch):
    """Two logs, here and in the bucket; temporary files of the runs go where the test can see them."""
    (tmp_path / "tmp").mkdir()
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path / "tmp"))
    (tmp_path / "logs").mkdir()
    found = [write_log(tmp_path / "logs" / f"{name}.mcap", straight_line(n)) for name, n in (("near", 8), ("far", 10))]
    for log in found:
        write_file(log, f"s3://sea/logs/{log.name}")
    s3.requests.clear()
    return found


def remote_run(*logs, out="s3://sea/out", settings=(), force=False):
    return run(logs or ("s3://sea/logs",), out, config(*settings), QUIET, force, num_workers=0)


def contents(folder: str) -> dict[str, bytes]:
    if "://" in folder:
        return {name: read_bytes(found.url) for name, found in list_folder(folder).items()}
    return {path.name: path.read_bytes() for path in Path(folder).iterdir() if path.is_file()}


def test_from_bucket_to_bucket_as_from_disk_to_disk(s3, logs, tmp_path):
    outcomes = remote_run()
    assert [(outcome.task.name, outcome.status, outcome.message) for outcome in outcomes] == [
        ("far", "done", ""), ("near", "done", ""),
    ]  # fmt: skip
    assert outcomes[0].stages[-1].outputs == ("s3://sea/out/far/report.html",)
    # Every byte equals that of a run on a log that lies where a fetched one lies.
    for log in logs[:1]:
        source = tmp_path / "here" / log.stem / SOURCE_NAME
        source.mkdir(parents=True)
        (source / log.name).write_bytes(log.read_bytes())
        run([str(source / log.name)], str(tmp_path / "here"), config(), QUIET, num_workers=0)
        published = contents(f"s3://sea/out/{log.stem}")
        receipt = json.loads(published.pop(RECEIPT_NAME))
        assert published == contents(str(tmp_path / "here" / log.stem))
        assert set(receipt["files"]) == set(published) and len(published) > 12
    # A log elsewhere differs in nothing but the statement where it lay.
    run([str(logs[0])], str(tmp_path / "there"), config(), QUIET, num_workers=0)
    there, published = contents(str(tmp_path / "there" / "near")), contents("s3://sea/out/near")
    equal = [name for name in there if published[name] == there[name]]
    assert {"detections.parquet", "hypotheses.parquet", "windows.parquet", "near.layout.json"} <= set(equal)
    batch = json.loads(read_bytes("s3://sea/out/batch.json"))
    assert [entry["status"] for entry in batch["logs"]] == ["done", "done"]
    assert list((tmp_path / "tmp").rglob("*.mcap")) == [] and list((tmp_path / "tmp").rglob("*.parquet")) == []
    told = b"".join(content for folder in ("near", "far") for content in contents(f"s3://sea/out/{folder}").values())
    assert b"open-sesame" not in told and str(tmp_path / "tmp").encode() not in told


def test_what_is_done_is_neither_fetched_nor_computed_again(s3, logs, monkeypatch):
    first = remote_run("s3://sea/logs/near.mcap")
    before = contents("s3://sea/out/near")
    s3.requests.clear()
    with monkeypatch.context() as patch:
        patch.setattr(module, "run_task", lambda task, progress: pytest.fail("computed again"))
        (again,) = remote_run("s3://sea/logs/near.mcap")
    assert again.status == "skipped" and [stage.stage for stage in again.stages] == list(STAGES)
    assert [stage.outputs for stage in again.stages] == [stage.outputs for stage in first[0].stages]
    assert s3.count("GET", "near.mcap") == 0 and s3.count("PUT", "/near/") == 0
    # A setting of the last stages: what it does not concern is taken over from the bucket.
    (changed,) = remote_run("s3://sea/logs/near.mcap", settings=["export.max_vertices=8"])
    assert [stage.status for stage in changed.stages] == ["skipped"] * 4 + ["done"] * 2
    after = contents("s3://sea/out/near")
    assert {name for name in after if after[name] != before[name]} >= {"near.cadence.mcap", "export.manifest.json"}
    assert s3.count("PUT", "hypotheses.parquet") == 0 and set(after) == set(before)


def test_what_was_damaged_in_the_bucket_is_mended(s3, logs, tmp_path):
    remote_run("s3://sea/logs/near.mcap")
    before = contents("s3://sea/out/near")
    size = len(before["hypotheses.parquet"])
    (tmp_path / "damaged").write_bytes(b"\0" * size)
    write_file(tmp_path / "damaged", "s3://sea/out/near/hypotheses.parquet")
    (mended,) = remote_run("s3://sea/logs/near.mcap")
    assert mended.status == "done" and {stage.stage for stage in mended.stages if stage.status == "done"} == {"infer"}
    after = contents("s3://sea/out/near")
    receipt = json.loads(before[RECEIPT_NAME])["files"]["hypotheses.parquet"]
    assert after["hypotheses.parquet"] == before["hypotheses.parquet"] and receipt["size_bytes"] == size


@pytest.fixture
def bag(s3, tmp_path):
    """A split recording on disk and in the bucket."""
    folder = tmp_path / "bag"
    folder.mkdir()
    track = straight_line(12)
    for number, fixes in ((0, track[:4]), (1, track[4:8]), (10, track[8:])):
        write_log(folder / f"bag_{number}.mcap", fixes)
    names = "".join(f"    - bag_{number}.mcap\n" for number in (0, 1, 10))
    (folder / "metadata.yaml").write_text(f"rosbag2_bagfile_information:\n  relative_file_paths:\n{names}")
    for path in folder.iterdir():
        write_file(path, f"s3://sea/bags/bag/{path.name}")
    return folder


def test_parts_in_a_bucket_are_one_mission(s3, logs, bag, tmp_path):
    (outcome,) = remote_run("s3://sea/bags")
    (here,) = run([str(bag)], str(tmp_path / "here"), config(), QUIET, num_workers=0)
    assert (outcome.task.name, outcome.status, here.status) == ("bag", "done", "done")
    assert [part.rpartition("/")[2] for part in outcome.task.parts] == ["bag_0.mcap", "bag_1.mcap", "bag_10.mcap"]
    assert outcome.task.size_bytes == here.task.size_bytes
    published, local = contents("s3://sea/out/bag"), contents(str(tmp_path / "here" / "bag"))
    assert all(published[name] == local[name] for name in ("detections.parquet", "hypotheses.parquet", "windows.parquet"))


def test_parts_in_a_bucket_are_joined_however_they_are_named(s3, bag):
    def names(*urls):
        return [[part.rpartition("/")[2] for part in mission.parts] for mission in find_missions(urls, "out")]

    assert names("s3://sea/bags/bag/*.mcap") == [["bag_0.mcap", "bag_1.mcap", "bag_10.mcap"]]
    assert names("s3://sea/bags/bag/bag_1.mcap", "s3://sea/bags/bag/bag_0.mcap") == [["bag_0.mcap", "bag_1.mcap"]]
    assert names("s3://sea/bags/bag/bag_1.mcap") == [["bag_1.mcap"]]
    write_file(bag / "bag_0.mcap", "s3://sea/bags/bag/other.mcap")
    assert names("s3://sea/bags") == [["bag_0.mcap", "bag_1.mcap", "bag_10.mcap"], ["other.mcap"]]
    s3.fail("GET", "metadata.yaml", status="403 Forbidden", count=9)
    assert names("s3://sea/bags/bag/*.mcap") == [["bag_0.mcap"], ["bag_1.mcap"], ["bag_10.mcap"], ["other.mcap"]]
    with pytest.raises(DeviceError, match=r"bag/metadata\.yaml: access denied"):
        names("s3://sea/bags")


def test_a_part_that_is_not_in_the_bucket_is_missed(s3, logs, bag):
    remove("s3://sea/bags/bag/bag_1.mcap")
    (outcome,) = remote_run("s3://sea/bags")
    assert (outcome.exit_code, outcome.message) == (3, "s3://sea/bags/bag/bag_1.mcap: not found; check the URL")


def test_where_nothing_was_detected_is_kept_as_the_others(s3, logs, tmp_path, monkeypatch):
    write_file(write_log(tmp_path / "quiet.mcap", straight_line(8, topic="/truth/A")), "s3://sea/logs/quiet.mcap")
    (first,) = remote_run("s3://sea/logs/quiet.mcap")
    assert first.status == "nothing detected" and "s3://sea/logs/quiet.mcap: nothing looks like" in first.message
    monkeypatch.setattr(module, "run_task", lambda task, progress: pytest.fail("computed again"))
    (again,) = remote_run("s3://sea/logs/quiet.mcap")
    assert (again.status, again.message) == (first.status, first.message)


def test_a_changed_log_is_run_again(s3, logs):
    remote_run("s3://sea/logs/near.mcap")
    write_file(logs[1], "s3://sea/logs/near.mcap")
    (outcome,) = remote_run("s3://sea/logs/near.mcap")
    assert {stage.status for stage in outcome.stages} == {"done"}


def test_manifests_come_last_and_the_receipt_last_of_all(s3, logs):
    remote_run("s3://sea/logs/near.mcap")
    written = [path.rpartition("/")[2] for method, path in s3.requests if method == "PUT" and "/near/" in path]
    is_manifest = [name.endswith(".manifest.json") for name in written]
    assert is_manifest == sorted(is_manifest) and written[-1] == RECEIPT_NAME and sum(is_manifest) == 7


def test_a_broken_connection_while_publishing_leaves_nothing_that_looks_done(s3, logs, monkeypatch):
    s3.fail("PUT", "near/windows.parquet", count=100)
    (failed,) = remote_run("s3://sea/logs/near.mcap")
    assert failed.exit_code == 5 and "windows.parquet: the store does not answer" in failed.message
    assert not [name for name in list_folder("s3://sea/out/near") if name.endswith(".manifest.json")]
    s3.faults.clear()
    (resumed,) = remote_run("s3://sea/logs/near.mcap")
    assert {stage.status for stage in resumed.stages} == {"skipped"}  # computed before: only published now
    assert RECEIPT_NAME in list_folder("s3://sea/out/near")


def test_a_bad_log_does_not_stop_the_others(s3, logs, tmp_path):
    (tmp_path / "bad.mcap").write_bytes(b"\x89MCAP0\r\n" + b"\xff" * 500)
    write_file(tmp_path / "bad.mcap", "s3://sea/logs/bad.mcap")
    damaged = logs[0].read_bytes()
    (tmp_path / "cut.mcap").write_bytes(damaged[: len(damaged) // 3])
    write_file(tmp_path / "cut.mcap", "s3://sea/logs/cut.mcap")
    outcomes = {o.task.name: o for o in remote_run("s3://sea/logs", "s3://sea/logs/none.mcap")}
    assert {name: outcome.status for name, outcome in outcomes.items()} == {
        "bad": "failed", "cut": "partial", "far": "done", "near": "done", "none": "failed",
    }  # fmt: skip
    assert outcomes["none"].message == "s3://sea/logs/none.mcap: not found; check the URL"
    assert outcomes["bad"].message.startswith("s3://sea/logs/bad.mcap: ") and str(tmp_path) not in outcomes["bad"].message
    assert exit_code(tuple(outcomes.values())) == 3
    assert list_folder("s3://sea/out/none") == {}


def test_a_bucket_that_is_not_there(s3, logs):
    (outcome,) = (run_anywhere(task, QUIET) for task in plan("s3://sea/logs/near.mcap", "s3://lake/out"))
    assert outcome.exit_code and "s3://lake/out/near" in outcome.message and "there is no such bucket" in outcome.message


def plan(log, out):
    from pipeline.batch.tasks import plan_tasks

    return plan_tasks([log], out, config())


def test_from_bucket_to_disk(s3, logs, tmp_path, monkeypatch):
    (outcome,) = remote_run("s3://sea/logs/near.mcap", out=str(tmp_path / "out"))
    mission = tmp_path / "out" / "near"
    assert outcome.status == "done" and outcome.stages[-1].outputs == (mission / "report.html",)
    assert not [path for path in mission.iterdir() if path.name.startswith(".")]  # the log is not kept
    with monkeypatch.context() as patch:
        patch.setattr(module, "run_task", lambda task, progress: pytest.fail("computed again"))
        assert remote_run("s3://sea/logs/near.mcap", out=str(tmp_path / "out"))[0].status == "skipped"
    (mission / "report.html").unlink()
    (outcome,) = remote_run("s3://sea/logs/near.mcap", out=str(tmp_path / "out"))
    assert [stage.status for stage in outcome.stages] == ["skipped"] * 5 + ["done"]


def test_from_disk_to_bucket(s3, logs):
    (outcome,) = remote_run(str(logs[0]))
    assert outcome.status == "done" and "near.cadence.mcap" in list_folder("s3://sea/out/near")
    assert remote_run(str(logs[0]))[0].status == "skipped"
    assert logs[0].is_file()


def test_an_interrupted_run_keeps_what_it_fetched(s3, logs, tmp_path, monkeypatch):
    def interrupt(task, progress):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(module, "run_task", interrupt)
        with pytest.raises(KeyboardInterrupt):
            remote_run("s3://sea/logs/near.mcap")
    assert list_folder("s3://sea/out/near") == {} and len(list((tmp_path / "tmp").rglob("near.mcap"))) == 1
    s3.requests.clear()
    assert remote_run("s3://sea/logs/near.mcap")[0].status == "done"
    assert s3.count("GET", "logs/near.mcap") == 0 and list((tmp_path / "tmp").rglob("near.mcap")) == []
