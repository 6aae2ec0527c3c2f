"""Events: from tables and stories, as files, as messages in the side file, on the page; and SQL that finds them again."""

import csv
import json
import sqlite3
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from fixtures.asked import asked_mission
from fixtures.mission import START_NS, build_mission
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory

from cadence.errors import ConfigError, InputError
from pipeline.ask.events import ask_line, table_events
from pipeline.ask.question import Question
from pipeline.ask.told import read_told, tell
from pipeline.config import read_config
from pipeline.export.config import ExportConfig
from pipeline.export.stage import export
from pipeline.progress import Progress
from pipeline.report.config import ReportConfig
from pipeline.report.stage import report
from pipeline.tables import read_table, write_table

QUIET = Progress(quiet=True)
SQUARE = json.dumps({"type": "Polygon", "coordinates": [[[-100, -50], [100, -50], [100, 50], [-100, 50], [-100, -50]]]})
QUESTIONS = (Question("inside", name="the harbour", agent="T0", area=SQUARE), Question("where", agent="T1", at=50.0))


def asked_sql(directory, sql):
    """The rows that a line of SQL gives on the Parquet files of a mission directory; DuckDB reads them by the same names."""
    connection = sqlite3.connect(":memory:")
    for path in directory.glob("*.parquet"):
        table = pq.read_table(path)
        plain = [name for name in table.column_names if "list" not in str(table.schema.field(name).type)]
        rows = table.select(plain).to_pylist()
        connection.execute(f'CREATE TABLE "{path.name}" ({", ".join(plain)})')
        connection.executemany(
            f'INSERT INTO "{path.name}" VALUES ({", ".join("?" * len(plain))})', [tuple(row.values()) for row in rows]
        )
        sql = sql.replace(f"'{path.name}'", f'"{path.name}"')
    return connection.execute(sql).fetchall()


@pytest.fixture(scope="module")
def directory(tmp_path_factory):
    return asked_mission(tmp_path_factory.mktemp("events"))


def of_kind(events, kind):
    return [event for event in events if event.kind == kind]


def test_who_entered_left_and_met(directory):
    told = tell(directory, QUESTIONS, 100.0)
    (entered,) = of_kind(told.events, "entered")
    assert entered.agents == "T0" and entered.start_ns == START_NS + 90 * 10**9
    assert entered.probability == pytest.approx(0.75) and entered.low < 0.75 < entered.high
    (left,) = of_kind(told.events, "left")
    assert left.end_ns == START_NS + 110 * 10**9 and "went out of the harbour: 75 %" in left.sentence
    (met,) = of_kind(told.events, "may have met")
    assert met.agents == "T0 and T1" and met.probability == pytest.approx(0.75)
    assert met.recompute == "cadence ask patrol meet T0 T1 --within 100.0"
    answers = of_kind(told.events, "answer")
    assert len(answers) == 2 and [event.start_ns for event in told.events] == sorted(event.start_ns for event in told.events)


def test_the_longest_gap_and_its_sql(tmp_path):
    directory = build_mission(tmp_path)
    table, frame = read_table(directory / "detections.parquet", "detections")
    rows = [row for row in table.to_pylist() if not (row["agent_id"] == "T0" and 60 < (row["time_ns"] - START_NS) / 1e9 < 150)]
    write_table(
        table.from_pylist(rows, schema=table.schema.remove_metadata()), directory / "detections.parquet", "detections", frame
    )
    (gap,) = [event for event in of_kind(table_events(directory), "gap") if event.agents == "T0"]
    assert (gap.end_ns - gap.start_ns) / 1e9 > 85 and gap.probability is None
    assert asked_sql(directory, gap.recompute) == [("T0", gap.start_ns, gap.end_ns)]


def test_windows_that_contradict_themselves(tmp_path):
    directory = build_mission(tmp_path)
    table, frame = read_table(directory / "windows.parquet", "windows")
    rows = table.to_pylist()
    for row in rows:
        if row["agent_id"] == "T1" and row["window"] in (1, 2, 4):
            row |= {"status": "infeasible", "advice": "Look at it."}
    write_table(table.from_pylist(rows, schema=table.schema.remove_metadata()), directory / "windows.parquet", "windows", frame)
    found = of_kind(table_events(directory), "contradictory evidence")
    assert [len(asked_sql(directory, event.recompute)) for event in found] == [2, 1]
    assert "T1 is infeasible in 2 windows from" in found[0].sentence and found[1].sentence.endswith(": Look at it.")


def test_detections_that_could_be_of_either(tmp_path):
    directory = build_mission(tmp_path)
    names = ("log_id", "detection", "time_ns", "topic", "log_time_ns", "sequence", "agent_id", "first_window")
    rows = []
    for detection, shares in enumerate(((0.7, 0.3), (0.6, 0.4), (0.99, 0.01))):
        for name, share in zip(("a0", "a'1"), shares, strict=True):
            values = ("patrol", detection, START_NS + detection * 10**9, "/t", 0, 0, name, 0)
            rows.append(dict(zip(names, values, strict=True)) | {"first_probability": share, "probability": share})
    from schemas.tables import ASSOCIATIONS

    frame = read_table(directory / "detections.parquet", "detections")[1]
    write_table(pa.Table.from_pylist(rows, schema=ASSOCIATIONS), directory / "associations.parquet", "associations", frame)
    (exchange,) = of_kind(table_events(directory), "identity exchange")
    assert exchange.agents == "a'1 and a0" and exchange.probability == pytest.approx(0.35)
    assert exchange.end_ns - exchange.start_ns == 10**9
    assert len(asked_sql(directory, exchange.recompute)) == 4


def test_files_messages_and_the_page(directory):
    result = export(directory, ExportConfig(questions=QUESTIONS, meeting_m=100.0), QUIET)
    with (directory / "events.csv").open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == result.summary["num_events"] > 3
    content = json.loads((directory / "answers.json").read_text(encoding="utf-8"))
    assert [box["name"] for box in content["questions"]] == ["the harbour", "where T1 50.0"]
    assert content["questions"][0]["answers"][0]["probability"]["value"] == pytest.approx(0.75)
    with (directory / "patrol.cadence.mcap").open("rb") as file:
        found = list(make_reader(file, decoder_factories=[DecoderFactory()]).iter_decoded_messages(topics=["/cadence/events"]))
    assert len(found) == len(rows)
    for (schema, _, raw, message), row in zip(found, rows, strict=True):
        assert schema.name == "foxglove.Event" and message.start_time.ToNanoseconds() == int(row["start_ns"]) == raw.log_time
        assert message.end_time.ToNanoseconds() == int(row["end_ns"])
        metadata = {pair.key: pair.value for pair in message.metadata}
        assert metadata["kind"] == row["kind"] and metadata["sentence"] == row["sentence"]
    report(directory, ReportConfig(), QUIET)
    page = (directory / "report.html").read_text(encoding="utf-8")
    assert "<h2>Answers</h2>" in page and "<h3>the harbour</h3>" in page and "T0 was in the harbour at some time: 75 %" in page
    assert page.count("may have met") >= 1 and 'data-seconds="' in page.split("<h3>Events</h3>")[1]


def test_questions_about_nothing_are_errors_of_the_configuration(directory):
    with pytest.raises(ConfigError, match=r"export\.questions\[1\]: no agent 'T9'"):
        tell(directory, (QUESTIONS[0], Question("where", agent="T9", at=50.0)), None)
    with pytest.raises(ConfigError, match=r"export\.questions\[0\]: a question `inside` needs area"):
        read_config(ExportConfig, {"questions": [{"ask": "inside"}]}, "export")
    with pytest.raises(ConfigError, match="meeting_m"):
        read_config(ExportConfig, {"meeting_m": -1.0}, "export")


def test_without_stories_a_question_is_not_answered_but_said(tmp_path):
    told = tell(build_mission(tmp_path), (*QUESTIONS[:1], Question("where", agent="T1", at=50.0, as_of=100.0)), None)
    boxes = json.loads(told.answers_json())["questions"]
    assert "there are no mission hypotheses" in boxes[0]["answers"][0]["sentence"]
    assert boxes[1]["answers"][0]["sentence"].startswith("At ")
    assert not of_kind(told.events, "answer")


def test_damaged_files_are_one_line(tmp_path):
    (tmp_path / "answers.json").write_text('{"version": 9}')
    with pytest.raises(InputError, match="run export with --force"):
        read_told(tmp_path)
    (tmp_path / "answers.json").unlink()
    (tmp_path / "events.csv").write_text("kind,agents\nx,y\n")
    with pytest.raises(InputError, match="run export with --force"):
        read_told(tmp_path)
    assert read_told(tmp_path / "none") == ([], [])


def test_a_question_as_a_call():
    question = Question("inside", agent="T0", area="50.8,-1.2,500", start=0.0, end="10:00", dwell_s=60.0)
    assert ask_line(Path("results/flight"), question) == (
        "cadence ask flight inside '50.8,-1.2,500' --from 0.0 --to 10:00 --dwell 60.0 --agent T0"
    )
