"""The command line: help, exit codes, what goes to which stream; and that it starts fast."""

import json
import re
import subprocess
import sys
from pathlib import Path

import pytest
from fixtures.line_logs import straight_line, write_log

import cli
from cadence.errors import InputError
from pipeline.manifest import StageResult
from pipeline.progress import Progress

ROOT = Path(__file__).resolve().parents[1]
COMMANDS = (
    "info", "doctor", "import", "run", "ingest", "extract", "infer", "retrospect", "export", "report", "evaluate",
    "view", "simulate", "train", "ask",
)  # fmt: skip


NO_STAGES = ("info", "doctor", "import", "view", "ask")  # these have no settings in files


def test_help_names_every_command(capsys):
    assert cli.main(["--help"]) == 0
    text = capsys.readouterr().out
    assert re.findall(r"^  ([a-z]+) ", text.split("Commands:")[1], flags=re.MULTILINE) == list(COMMANDS)
    assert "..." not in text.split("Commands:")[1]


@pytest.mark.parametrize("command", COMMANDS)
def test_help_of_each_command_is_complete(command, capsys):
    assert cli.main([command, "--help"]) == 0
    text = capsys.readouterr().out
    assert f"Usage: cadence {command}" in text
    assert re.search(rf"Examples?:\n +cadence {command} ", text)
    described = text
    if command == "ask":  # its examples are questions, which have options of their own
        for question in ("where", "inside", "meet"):
            assert cli.main(["ask", "MISSION", question, "--help"]) == 0
            described += capsys.readouterr().out
    options = re.findall(r"^ +(?:-q, )?(--[a-z-]+)", described, flags=re.MULTILINE)
    for option in re.findall(r"--[a-z][a-z-]+", text.split("Options:")[0]):
        assert option in options, f"an example uses {option}, which {command} does not have"


@pytest.mark.parametrize("command", [command for command in COMMANDS if command not in NO_STAGES])
def test_common_options_are_everywhere(command, capsys):
    cli.main([command, "--help"])
    text = capsys.readouterr().out
    assert all(f"{option} " in text for option in ("--config", "--set", "--force", "--quiet", "--json"))


def test_version(capsys):
    assert cli.main(["--version"]) == 0
    assert re.match(r"cadence \S+, torch \S+, ", capsys.readouterr().out)


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["rnu"], "No such command 'rnu'"),
        (["run"], "Missing argument 'LOG'"),
        (["run", "x.mcap"], "Missing option '--out'"),
        (["run", "x.mcap", "--out", "o", "--nope"], "No such option: --nope"),
        (["run", "x.mcap", "--out", "o", "--seed", "x"], "'--seed': Input should be a valid integer"),
    ],
)
def test_wrong_call_is_one_line_and_exit_code_2(arguments, says, capsys):
    assert cli.main(arguments) == 2
    captured = capsys.readouterr()
    assert captured.out == "" and captured.err.count("\n") == 1
    assert captured.err.startswith("cadence: error: ") and says in captured.err


@pytest.fixture
def fake_infer(monkeypatch):
    """`cadence infer` with a stage that does what `behaviour` says; returns the list of its calls."""
    import pipeline.infer.stage

    calls = []

    def install(behaviour=lambda: StageResult("infer", "done", (Path("m/hypotheses.parquet"),), {"num_windows": 3})):
        def stage(directory, config, progress, force=False):
            calls.append((directory, config, progress, force))
            return behaviour()

        monkeypatch.setattr(pipeline.infer.stage, "infer", stage)
        return calls

    return install


def raiser(error):
    def behaviour():
        raise error

    return behaviour


def test_flags_reach_the_stage(fake_infer, tmp_path):
    calls = fake_infer()
    (tmp_path / "c.toml").write_text("[infer]\nnum_hypotheses = 5\nseed = 1\n[export]\n")
    arguments = [
        "infer",
        "m",
        "--config",
        str(tmp_path / "c.toml"),
        "--set",
        "infer.num_hypotheses=7",
        "--seed",
        "9",
        "--force",
        "-q",
    ]
    assert cli.main(arguments) == 0
    ((directory, config, progress, force),) = calls
    assert (directory, progress, force) == (Path("m"), Progress(quiet=True), True)
    assert (config.num_hypotheses, config.seed) == (7, 9)


def test_combined_is_a_setting_of_export(monkeypatch):
    import pipeline.batch.run
    import pipeline.export.stage

    found = []
    monkeypatch.setattr(pipeline.batch.run, "run", lambda logs, out, config, *_: found.append(config.export.combined) or ())
    monkeypatch.setattr(
        pipeline.export.stage,
        "export",
        lambda mission, config, *_: found.append(config.combined) or StageResult("export", "done", (), {}),
    )
    for words in (["run", "a.mcap", "--out", "o"], ["export", "m"]):
        for flags in ([], ["--combined"], ["--combined", "--set", "export.tick_s=2"]):
            assert cli.main([*words, *flags]) == 0
    assert found == [False, True, True] * 2


def test_results_are_on_stdout_for_people_or_as_json(fake_infer, capsys):
    fake_infer()
    assert cli.main(["infer", "m"]) == 0
    assert capsys.readouterr().out == "infer: done\n  windows 3\n  m/hypotheses.parquet\n"
    assert cli.main(["infer", "m", "--json"]) == 0
    assert json.loads(capsys.readouterr().out) == {
        "stage": "infer", "status": "done", "outputs": ["m/hypotheses.parquet"], "summary": {"num_windows": 3},
    }  # fmt: skip


def test_foreseen_failure_is_one_line_with_its_code(fake_infer, capsys):
    fake_infer(raiser(InputError("m: nothing\n  here; look elsewhere")))
    assert cli.main(["infer", "m"]) == 3
    assert capsys.readouterr() == ("", "cadence: error: m: nothing here; look elsewhere\n")


def test_training_on_a_folder_that_is_not_there(tmp_path, capsys):
    code = cli.main(["train", "--out", str(tmp_path / "run"), "--set", f"train.data={tmp_path / 'absent'}"])
    said = capsys.readouterr()
    assert (code, said.out) == (InputError.exit_code, "") and said.err.count("\n") == 1 and "absent" in said.err


def test_interruption_says_that_finished_stages_are_kept(fake_infer, capsys):
    fake_infer(raiser(KeyboardInterrupt()))
    assert cli.main(["infer", "m"]) == 130
    captured = capsys.readouterr()
    assert captured.out == "" and captured.err.count("\n") == 1 and "finished stages are kept" in captured.err


def test_defect_keeps_its_traceback(fake_infer):
    fake_infer(raiser(ZeroDivisionError("defect")))
    with pytest.raises(ZeroDivisionError):
        cli.main(["infer", "m"])


@pytest.mark.parametrize("library", ["torch", "numpy", "pyarrow"])
def test_memory_that_is_refused_is_one_line_and_code_5(library, fake_infer, capsys):
    import numpy
    import pyarrow
    import torch

    ask = {
        "torch": lambda: torch.empty(10**15),
        "numpy": lambda: numpy.empty(10**15),
        "pyarrow": lambda: pyarrow.allocate_buffer(2**60),
    }
    fake_infer(ask[library])
    assert cli.main(["infer", "m"]) == 5
    captured = capsys.readouterr()
    assert captured.out == "" and captured.err.startswith("cadence: error: out of memory; ") and captured.err.count("\n") == 1


def test_unknown_key_names_the_known_ones(capsys):
    assert cli.main(["infer", "m", "--set", "infer.nope=1"]) == 4
    error = capsys.readouterr().err
    assert "infer: unknown key 'nope'; known keys: " in error and "num_hypotheses" in error and error.count("\n") == 1


@pytest.mark.parametrize("command", ["infer", "simulate", "train", "evaluate", "extract"])
def test_seed_has_a_meaning_wherever_it_is_offered(command):
    import importlib

    from pipeline.config import with_seed

    config = getattr(importlib.import_module(f"pipeline.{command}.stage"), f"{command.capitalize()}Config")()
    assert with_seed(config, 123_456) != config


def test_help_is_fast_because_heavy_imports_wait():
    heavy = {"torch", "pyarrow", "scipy", "matplotlib", "mcap"}
    code = f"import sys, cli; cli.main(['run', '--help']); sys.exit(bool({heavy} & set(sys.modules)))"
    assert subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, check=False).returncode == 0


def test_closed_pipe_is_quiet():
    command = f"'{sys.executable}' cli.py --help | true; exit ${{PIPESTATUS[0]}}"
    finished = subprocess.run(["bash", "-c", command], cwd=ROOT, capture_output=True, text=True, check=False)
    assert finished.stderr == "" and finished.returncode in (0, 1)


def test_no_command_prints_the_help(capsys):
    assert cli.main([]) == 0
    captured = capsys.readouterr()
    assert captured.err == "" and "Usage: cadence [OPTIONS] COMMAND" in captured.out and "\n  doctor " in captured.out


def test_damage_has_its_code_in_every_command_that_reads_the_log(tmp_path, capsys):
    whole = write_log(tmp_path / "whole.mcap", straight_line(200))
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(whole.read_bytes()[: whole.stat().st_size // 2])
    for log, code in ((whole, 0), (cut, 7)):
        assert cli.main(["info", str(log)]) == code
        assert cli.main(["ingest", str(log), "--out", str(tmp_path / "out"), "-q"]) == code
        assert cli.main(["extract", str(tmp_path / "out" / log.stem), "-q"]) == code
    assert "DAMAGED" in capsys.readouterr().out


@pytest.mark.parametrize(
    "arguments",
    [
        ["info", "{url}"], ["doctor", "{url}"], ["ingest", "{url}", "--out", "{out}"], ["extract", "{url}"],
        ["evaluate", "{url}"], ["run", "{url}", "--out", "{out}"], ["run", "{log}", "--out", "{url}"],
        ["simulate", "--out", "{url}", "--nope"],
        ["run", "{log}", "--out", "{out}", "--report", "{url}", "--set", "infer.checkpoint=none"],
    ],
)  # fmt: skip
@pytest.mark.parametrize("scheme", ["nope", "ftps"])
def test_secrets_of_urls_are_never_told(arguments, scheme, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    log = write_log(tmp_path / "a.mcap", straight_line(6))
    url = f"{scheme}://someuser:p-hidden@host/a.mcap?token=q-hidden"
    words = [word.format(url=url, out=tmp_path / "out", log=log) for word in arguments]
    assert cli.main(words) != 0
    told = "".join(capsys.readouterr())
    assert "hidden" not in told and "someuser" not in told and "cadence: error:" in told
    assert all("hidden" not in path.read_text() for path in tmp_path.rglob("*.json"))


def test_what_is_no_mission_directory_is_said_with_the_way_on(tmp_path, capsys):
    log = tmp_path / "flight.mcap"
    log.write_bytes(b"not read")
    (tmp_path / "results" / "flight").mkdir(parents=True)
    (tmp_path / "results" / "flight" / "catalogue.json").write_text("{}")
    said = {
        log: "is a file, not a mission directory; `cadence run",
        tmp_path / "results": f"holds 1 mission directory; name one, such as {tmp_path}/results/flight",
        tmp_path: "holds no catalogue.json, so it is no mission directory; `cadence run LOG --out results` makes one",
        tmp_path / "nowhere": "not found; `cadence run LOG --out results` makes one",
    }
    for command in ("extract", "infer", "retrospect", "export", "report"):
        for path, words in said.items():
            assert cli.main([command, str(path), "-q"]) == 3
            (line,) = capsys.readouterr().err.splitlines()
            assert f"{path}: {words}" in line


def test_a_wrong_call_names_the_help_of_its_command(capsys):
    for arguments, words in (
        (["run", "a.mcap"], "Missing option '--out'; see cadence run --help"),
        (["run", "a.mcap", "--out", "r", "--engine", "x"], "'x' is not one of 'local', 'ray'; see cadence run --help"),
        (["rum"], "Did you mean 'run'?; see cadence --help"),
    ):
        assert cli.main(arguments) == 2
        (line,) = capsys.readouterr().err.splitlines()
        assert line.endswith(words) and "Value error" not in line
