"""Stages are atomic, skipped only when nothing changed, and never leave a mixture."""

import json
from dataclasses import dataclass
from pathlib import Path

import pytest

from cadence.errors import DeviceError, InputError
from pipeline.files import hash_file
from pipeline.manifest import manifest_path, read_manifest, run_stage


@dataclass(frozen=True)
class Config:
    size: int = 1


class Body:
    """A stage body that counts its calls and writes what it was told to."""

    def __init__(self, files=None, error=None):
        self.files = {"a.txt": "A"} if files is None else files
        self.error = error
        self.calls = 0

    def __call__(self, work: Path):
        self.calls += 1
        for name, text in self.files.items():
            (work / name).write_text(text)
        if self.error is not None:
            raise self.error
        return {"num_files": len(self.files)}


@pytest.fixture
def source(tmp_path):
    path = tmp_path / "input.bin"
    path.write_bytes(b"input")
    return path


def run(tmp_path, source, body, config=Config(), force=False):
    return run_stage("demo", tmp_path / "mission", config=config, inputs=[source], body=body, force=force)


def files_of(directory: Path) -> list[str]:
    return sorted(path.name for path in directory.iterdir())


def test_outputs_and_manifest_appear_together(tmp_path, source):
    result = run(tmp_path, source, Body())
    mission = tmp_path / "mission"
    assert result.status == "done" and result.outputs == (mission / "a.txt",) and result.summary == {"num_files": 1}
    assert files_of(mission) == ["a.txt", "demo.manifest.json"]
    manifest = read_manifest("demo", mission)
    assert manifest["inputs"] == {"input.bin": hash_file(source)}
    assert manifest["outputs"] == {"a.txt": hash_file(mission / "a.txt")}
    assert manifest["config"] == {"size": 1} and "torch" in manifest["versions"]


def test_second_run_is_skipped_with_the_same_result(tmp_path, source):
    body = Body()
    first, second = run(tmp_path, source, body), run(tmp_path, source, body)
    assert body.calls == 1 and second.status == "skipped"
    assert (second.outputs, second.summary) == (first.outputs, first.summary)


def test_anything_that_changed_runs_the_stage_again(tmp_path, source):
    body = Body()
    run(tmp_path, source, body)
    assert run(tmp_path, source, body, force=True).status == "done"
    assert run(tmp_path, source, body, config=Config(2)).status == "done"
    source.write_bytes(b"other input")
    assert run(tmp_path, source, body, config=Config(2)).status == "done"
    (tmp_path / "mission" / "a.txt").write_text("changed by hand")
    assert run(tmp_path, source, body, config=Config(2)).status == "done"
    (tmp_path / "mission" / "a.txt").unlink()
    assert run(tmp_path, source, body, config=Config(2)).status == "done"
    manifest_path("demo", tmp_path / "mission").write_text("{ damaged")
    assert run(tmp_path, source, body, config=Config(2)).status == "done"
    manifest_path("demo", tmp_path / "mission").write_text("{}")
    assert run(tmp_path, source, body, config=Config(2)).status == "done"
    assert body.calls == 8


@pytest.mark.parametrize("error", [InputError("bad log"), RuntimeError("defect"), KeyboardInterrupt()])
def test_failure_leaves_nothing_behind(tmp_path, source, error):
    with pytest.raises(type(error)):
        run(tmp_path, source, Body(error=error))
    assert not (tmp_path / "mission").exists()


def test_failure_leaves_the_earlier_result_alone(tmp_path, source):
    run(tmp_path, source, Body({"a.txt": "old"}))
    with pytest.raises(InputError):
        run(tmp_path, source, Body({"a.txt": "new"}, InputError("bad")), force=True)
    assert (tmp_path / "mission" / "a.txt").read_text() == "old"
    assert run(tmp_path, source, Body()).status == "skipped"


def test_files_only_the_earlier_run_wrote_are_removed(tmp_path, source):
    run(tmp_path, source, Body({"a.txt": "A", "truth.txt": "T"}))
    (tmp_path / "mission" / "other.txt").write_text("of another stage")
    run(tmp_path, source, Body({"a.txt": "A2"}), config=Config(2))
    assert files_of(tmp_path / "mission") == ["a.txt", "demo.manifest.json", "other.txt"]


def test_absent_input_says_what_to_do(tmp_path):
    with pytest.raises(InputError, match=r"gone\.bin: not found; .*stage that writes it"):
        run(tmp_path, tmp_path / "gone.bin", Body())
    with pytest.raises(InputError, match="cannot be read"):
        run(tmp_path, tmp_path, Body())
    assert not (tmp_path / "mission").exists()


def test_unwritable_folder_is_one_line(tmp_path, source):
    (tmp_path / "mission").write_text("a file where a folder should be")
    with pytest.raises(DeviceError, match="cannot write there") as caught:
        run(tmp_path, source, Body())
    assert "\n" not in str(caught.value)


def test_full_disk_is_a_device_error(tmp_path, source):
    with pytest.raises(DeviceError, match="could not write its output"):
        run(tmp_path, source, Body(error=OSError(28, "No space left on device")))


def test_manifest_is_the_same_bytes_each_time(tmp_path, source):
    run(tmp_path, source, Body())
    first = manifest_path("demo", tmp_path / "mission").read_bytes()
    run(tmp_path, source, Body(), force=True)
    assert manifest_path("demo", tmp_path / "mission").read_bytes() == first
    json.loads(first)


def run_chain(mission: Path, log: Path, extract="A", until="export", config=Config()):
    """Ingest, extract, infer and export as far as `until`, each reading what the one before wrote."""
    catalogue, detections, hypotheses = (mission / name for name in ("catalogue.json", "d.parquet", "h.parquet"))
    stages = {
        "ingest": ([log], {"catalogue.json": log.read_text()}, Config()),
        "extract": ([catalogue], {"d.parquet": extract}, config),
        "infer": ([detections], {"h.parquet": "H"}, Config()),
        "export": ([catalogue, detections, hypotheses], {"side.mcap": "S"}, Config()),
    }
    for stage, (inputs, files, config) in stages.items():
        result = run_stage(stage, mission, config=config, inputs=inputs, body=Body(files))
        if stage == until:
            return result
    raise AssertionError(until)


def export_alone(mission: Path):
    inputs = [mission / name for name in ("catalogue.json", "d.parquet", "h.parquet")]
    return run_stage("export", mission, config=Config(), inputs=inputs, body=Body({"side.mcap": "S"}))


def test_results_of_other_detections_are_refused(tmp_path, source):
    mission = tmp_path / "mission"
    run_chain(mission, source)
    assert export_alone(mission).status == "skipped"
    run_chain(mission, source, extract="B", until="extract", config=Config(2))
    with pytest.raises(InputError, match=r"the hypotheses were made from another d\.parquet .*run `cadence infer` again"):
        export_alone(mission)
    assert run_chain(mission, source, extract="B", config=Config(2)).status == "done"


def test_detections_of_another_catalogue_are_refused_by_all_later_stages(tmp_path, source):
    mission = tmp_path / "mission"
    run_chain(mission, source)
    source.write_text("another log")
    run_chain(mission, source, until="ingest")
    says = r"the detections were made from another catalogue\.json .*run `cadence extract` again"
    with pytest.raises(InputError, match=says):
        run_stage("infer", mission, config=Config(), inputs=[mission / "d.parquet"], body=Body({"h.parquet": "H"}))
    with pytest.raises(InputError, match=says):
        export_alone(mission)


def test_what_was_changed_by_hand_is_refused_and_what_nobody_vouches_for_is_not(tmp_path, source):
    mission = tmp_path / "mission"
    run_chain(mission, source)
    (mission / "d.parquet").write_text("edited")
    with pytest.raises(InputError, match=r"d\.parquet: was changed after `cadence extract` had written it"):
        export_alone(mission)
    for stage in ("extract", "infer"):
        manifest_path(stage, mission).unlink()
    assert export_alone(mission).status == "done"
