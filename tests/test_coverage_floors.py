"""The gate on coverage: what it lets through and what it does not."""

import json

import coverage_floors
import pytest
from coverage_floors import TABLE, complaints, main, measured_percent, raised


def report(**counts: tuple[int, int]) -> dict:
    """A report as coverage writes it, of files with covered lines and statements each."""
    summaries = {name: {"covered_lines": covered, "num_statements": count} for name, (covered, count) in counts.items()}
    return {"files": {name: {"summary": summary} for name, summary in summaries.items()}}


LINES = {"cli.py": (9, 10), "cadence/a.py": (1, 2), "cadence/b.py": (8, 8), "cadence/bank/c.py": (3, 4), "schemas/d.py": (0, 0)}


def test_lines_are_counted_a_folder():
    assert measured_percent(report(**LINES)) == {"cadence": 90.0, "cadence/bank": 75.0, "cli.py": 90.0}


def test_each_wrong_is_told_in_one_line():
    assert complaints({"cadence": 90.0, "cli.py": 89.96}, {"cadence": 90, "cli.py": 89}) == []
    (low,) = complaints({"cadence": 89.9}, {"cadence": 90})
    assert low == "cadence: 89.9 % of its lines are tested, the floor is 90 %; add tests"
    (new,) = complaints({"cadence": 90.0, "cadence/new": 76.9}, {"cadence": 90})
    assert 'add "cadence/new" = 76 to' in new
    (old,) = complaints({"cadence": 90.0}, {"cadence": 90, "cadence/old": 80})
    assert "no such package" in old


@pytest.mark.parametrize(("floor", "status"), [(75, 0), (76, 1)])
def test_the_exit_status_is_the_gate(tmp_path, monkeypatch, capsys, floor, status):
    project = tmp_path / "pyproject.toml"
    project.write_text(f'[tool.cadence.coverage_floors]\n"cadence/bank" = {floor}\n')
    (tmp_path / "coverage.json").write_text(json.dumps(report(**{"cadence/bank/c.py": (3, 4)})))
    monkeypatch.setattr(coverage_floors, "PROJECT", project)
    assert main(tmp_path / "coverage.json") == status
    shown = capsys.readouterr()
    assert "75.00 %" in shown.out and ("add tests" in shown.err) == bool(status)


def test_floors_rise_and_never_sink():
    project = f'[project]\nname = "x"\n\n[{TABLE}]\n# Why.\n"cli.py" = 80\n"gone" = 7\n"low" = 60\n'
    text = raised(project, {"cli.py": 79.9, "low": 61.8, "new": 5.0})
    assert text == f'[project]\nname = "x"\n\n[{TABLE}]\n# Why.\n"cli.py" = 80\n"low" = 61\n"new" = 5\n'
    assert raised(text, {"cli.py": 80.0, "low": 61.0, "new": 5.0}) == text
