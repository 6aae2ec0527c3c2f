"""Published numbers: files come back as they were, sections replace only themselves, pages say what the files hold."""

import importlib
import json
import re
from pathlib import Path

import pytest

from benchmarks import publishing
from benchmarks.publishing import DOCS, PAGES, Measurement
from cadence.metrics import Interval

PUBLISHED = DOCS / "benchmarks"
NAMES = [(page, name) for page, names in PAGES.items() for name in names]


def measured(**tables: list[publishing.Row]) -> Measurement:
    return Measurement("memory", {"command": "python -m benchmarks.memory", "seed": 3}, tables)


def test_a_measurement_comes_back_as_it_was_written(tmp_path: Path) -> None:
    rows = [
        {"log": "a, b", "size_mb": 12, "peak_gb": 0.125, "aim_gb": None},
        {"log": "c", "size_mb": 0, "peak_gb": 1e-9, "aim_gb": 2.5},
    ]
    found = measured(memory=rows, memory_more=[{"x": 1}])
    publishing.write(found, tmp_path)
    assert publishing.read("memory", tmp_path) == found


def test_numbers_that_are_not_there_are_empty_and_others_have_six_digits() -> None:
    assert publishing.as_csv([{"a": float("nan"), "b": None, "c": 1 / 3, "d": 5017600}]) == "a,b,c,d\n,,0.333333,5017600\n"


def test_tables_of_an_earlier_measurement_go(tmp_path: Path) -> None:
    (tmp_path / "memory_of_others.csv").write_text("x\n1\n")
    publishing.write(measured(memory=[{"x": 1}], memory_old=[{"x": 2}]), tmp_path)
    publishing.write(measured(memory=[{"x": 3}]), tmp_path)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["memory.csv", "memory.json", "memory_of_others.csv"]


def test_rows_are_found_by_their_columns() -> None:
    found = measured(memory=[{"x": 1, "y": "a"}, {"x": 2, "y": "a"}], memory_more=[{"x": 2, "y": "b"}])
    assert found.rows(y="a", x=2) == [{"x": 2, "y": "a"}]
    assert found.rows("more") == [{"x": 2, "y": "b"}]


def test_intervals_as_columns_and_as_text() -> None:
    row = publishing.columns("lead", Interval(0.25, 0.2, 0.3, 10, 5), 100)
    assert row == {"lead": 25.0, "lead_low": 20.0, "lead_high": 30.0}
    assert publishing.interval(row, "lead", ".0f") == "25 [20, 30]"
    assert publishing.columns("cost", Interval(0.25, 0.2, 0.3, 10, 5), -100) == {"cost": -25, "cost_low": -30, "cost_high": -20}
    assert publishing.interval(publishing.columns("lead", None), "lead") == "–"
    assert publishing.interval({"x": 1.0, "x_low": None, "x_high": None}, "x", ".1f") == "1.0"


def test_a_section_replaces_itself_alone(tmp_path: Path) -> None:
    page = tmp_path / "page.md"
    page.write_text("# Title\n\n<!-- a begin -->\nold\n<!-- a end -->\n\nby hand\n\n<!-- b begin -->\nkept\n<!-- b end -->\n")
    publishing.rewrite(page, "a", "new")
    assert page.read_text() == (
        "# Title\n\n<!-- a begin -->\nnew\n<!-- a end -->\n\nby hand\n\n<!-- b begin -->\nkept\n<!-- b end -->\n"
    )
    with pytest.raises(SystemExit, match="no lines `<!-- c begin -->`"):
        publishing.rewrite(page, "c", "new")


def test_the_command_does_not_say_where_it_published() -> None:
    facts = publishing.facts_of("memory", ["--seed", "1", "--publish", "docs", "--sets", "prison low"])
    assert facts["command"] == "python -m benchmarks.memory --seed 1 --sets 'prison low'"


def test_a_remark_stands_before_the_source() -> None:
    found = Measurement("memory", {"command": "x", "remark": "Taken on a Sunday."}, {"memory": []})
    assert "short\n\n**Remark.** Taken on a Sunday.\n\nNumbers: " in publishing.text_of(found, lambda _: "short")


def test_publishing_writes_files_and_section(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "benchmarks").mkdir()
    page = tmp_path / "benchmarks" / "runs.md"
    page.write_text("<!-- memory begin -->\n\n<!-- memory end -->\n")
    publishing.publish(measured(memory=[{"peak_gb": 0.5}]), lambda found: f"{found.rows()[0]['peak_gb']} GB", tmp_path)
    wanted = "0.5 GB\n\nNumbers: [memory](data/memory.csv); [made with](data/memory.json) `python -m benchmarks.memory`."
    assert page.read_text() == f"<!-- memory begin -->\n{wanted}\n<!-- memory end -->\n"
    assert capsys.readouterr().out == f"{wanted}\n"


def test_a_page_is_made_of_what_the_files_keep(tmp_path: Path) -> None:
    (tmp_path / "benchmarks").mkdir()
    page = tmp_path / "benchmarks" / "runs.md"
    page.write_text("<!-- memory begin -->\n\n<!-- memory end -->\n")
    found = measured(memory=[{"peak_gb": 2 / 3, "aim_gb": float("nan")}])
    publishing.publish(found, lambda kept: str(kept.rows()), tmp_path)
    kept = publishing.read("memory", tmp_path / "benchmarks" / "data")
    assert kept.rows() == [{"peak_gb": 0.666667, "aim_gb": None}] and str(kept.rows()) in page.read_text()


@pytest.mark.parametrize(("page", "name"), NAMES)
def test_a_page_says_what_its_files_hold(page: str, name: str) -> None:
    module = importlib.import_module(f"benchmarks.{name}")
    text = publishing.text_of(publishing.read(name, PUBLISHED / "data"), module.section)
    stated = f"<!-- {name} begin -->\n{text}\n<!-- {name} end -->\n"
    assert stated in (PUBLISHED / f"{page}.md").read_text(encoding="utf-8"), "call: python -m benchmarks.publishing"


def test_every_file_belongs_to_a_measurement_and_every_measurement_to_its_script() -> None:
    stems = {name for _, name in NAMES}
    wanted = {f"{name}.json" for name in stems}
    for name in stems:
        facts = json.loads((PUBLISHED / "data" / f"{name}.json").read_text(encoding="utf-8"))
        assert facts["command"].startswith(f"python -m benchmarks.{name}")
        wanted |= {f"{table}.csv" for table in facts["tables"]}
    assert {path.name for path in (PUBLISHED / "data").iterdir()} == wanted


def test_the_index_names_every_page_and_every_script() -> None:
    index = (PUBLISHED / "README.md").read_text(encoding="utf-8")
    assert {path.stem for path in PUBLISHED.glob("*.md")} == {*PAGES, "README"}
    assert set(re.findall(r"`python -m benchmarks\.(\w+)`", index)) == {name for _, name in NAMES} | {"publishing"}


@pytest.mark.parametrize("page", PAGES)
def test_a_page_has_no_more_than_two_screens(page: str) -> None:
    words = (PUBLISHED / f"{page}.md").read_text(encoding="utf-8").replace("|", " ").split()
    assert len(words) <= 700
