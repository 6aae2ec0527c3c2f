"""The report stage: one file, safe against what logs name themselves, the same bytes every time."""

import base64
import hashlib
import json
import re
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pytest
from fixtures.mission import GEOREFERENCED, build_mission, make_uncertain, rename_agents

from cadence.errors import InputError
from pipeline.progress import Progress
from pipeline.report import modes
from pipeline.report.config import ReportConfig
from pipeline.report.shapes import shape_of
from pipeline.report.stage import report
from pipeline.tables import read_table, write_table
from pipeline.tracks import UNKNOWN_AGENT
from schemas.tables import hypotheses_schema

QUIET = Progress(quiet=True)
HOSTILE = ("</script><img src=x onerror=alert(1)>", "<b onclick='x'>&amp;\"T1\"</b><!--")
VOID = {"meta", "input", "br", "img", "link"}


class Page(HTMLParser):
    """Elements, attributes and script texts of a page; balance of its tags."""

    def __init__(self, content: str) -> None:
        super().__init__()
        self.tags: list[str] = []
        self.attributes: list[tuple[str, str]] = []
        self.scripts: list[str] = []
        self.words: list[str] = []
        self.open: list[str] = []
        self.feed(content)
        self.close()

    def handle_starttag(self, tag, attrs):
        self.tags.append(tag)
        self.attributes += [(name, value or "") for name, value in attrs]
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag, attrs):
        self.tags.append(tag)
        self.attributes += [(name, value or "") for name, value in attrs]

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        if self.open and self.open[-1] == "script":
            self.scripts.append(data)
        else:
            self.words.append(data)

    @property
    def text(self) -> str:
        return " ".join(" ".join(self.words).split())

    @property
    def data(self) -> dict:
        return json.loads(self.scripts[0])


def make(directory: Path, config: ReportConfig | None = None) -> str:
    result = report(directory, config or ReportConfig(), QUIET)
    assert [path.name for path in result.outputs] == ["report.html"]
    return (directory / "report.html").read_text(encoding="utf-8")


def rewrite(mission: Path, name: str, content: str) -> None:
    """Put another content into a file, for which no manifest vouches any more."""
    (mission / name).write_text(content)
    (mission / "ingest.manifest.json").unlink()


def built(folder: Path, **options) -> Path:
    folder.mkdir()
    return build_mission(folder, **options)


@pytest.fixture
def mission(tmp_path: Path) -> Path:
    return build_mission(tmp_path)


def test_the_page_tells_the_key_figures(mission: Path) -> None:
    page = Page(make(mission))
    assert not page.open
    for words in ("patrol.mcap", "Agents 2", "Detections 48", "Windows 6", "Hypotheses a window 12", "132 tracks in all"):
        assert words in page.text
    assert 3 <= page.tags.count("figure") <= 6
    assert "No detections widen the history" in page.text
    assert "2023-11-14 22:13:20 to 22:16:40 UTC · 3 min 20 s" in page.text


def test_nothing_is_fetched_and_only_our_script_may_run(mission: Path) -> None:
    content = make(mission)
    page = Page(content)
    assert not re.search(r"(?:https?:|file:|url\(|@import|//cdn)", content.replace("http-equiv", ""))
    assert not [name for name, _ in page.attributes if name in ("src", "href") or name.startswith("on")]
    assert len(page.scripts) == 2
    digest = base64.b64encode(hashlib.sha256(page.scripts[1].encode()).digest()).decode()
    policy = next(value for name, value in page.attributes if name == "content" and "default-src" in value)
    assert policy.startswith("default-src 'none';") and f"script-src 'sha256-{digest}';" in policy


def test_same_input_same_bytes_and_skipped_until_something_changes(mission: Path) -> None:
    first = make(mission)
    assert report(mission, ReportConfig(), QUIET).status == "skipped"
    assert report(mission, ReportConfig(), QUIET, force=True).status == "done"
    assert (mission / "report.html").read_text(encoding="utf-8") == first
    manifest = json.loads((mission / "infer.manifest.json").read_text())
    (mission / "infer.manifest.json").write_text(json.dumps(manifest | {"config": {"seed": 12}}))
    assert report(mission, ReportConfig(), QUIET).status == "done"


def test_what_a_log_names_itself_stays_text(mission: Path) -> None:
    rename_agents(mission, dict(zip(("T0", "T1"), HOSTILE, strict=True)))
    catalogue = json.loads((mission / "catalogue.json").read_text())
    catalogue["path"] = f"/logs/{HOSTILE[0].replace('/', '')}.mcap"
    catalogue["channels"][0]["topic"] = HOSTILE[1]
    catalogue["health"] |= {"is_complete": False, "problems": [HOSTILE[0]], "lost_spans_ns": [[0, 10**9]]}
    rewrite(mission, "catalogue.json", json.dumps(catalogue))
    (mission / "obstacles.json").write_text(
        json.dumps({"version": 1, "obstacles": [{"kind": "circle", "x_m": 1, "y_m": 2, "radius_m": 3, "name": HOSTILE[0]}]})
    )
    (mission / "extract.manifest.json").write_text(
        json.dumps(
            {"config": {HOSTILE[0]: HOSTILE[1]}, "summary": {HOSTILE[1]: HOSTILE[0] + "\ud800"}, "inputs": {HOSTILE[0]: "0"}}
        )
    )
    plain = built(mission.parent / "plain")
    page, clean = Page(make(mission)), Page(make(plain))
    assert not page.open
    assert set(page.tags) <= set(clean.tags) | {"ul", "li"}
    assert not [name for name, _ in page.attributes if name.startswith("on") or name == "src"]
    assert sorted(page.data["all_agents"]) == sorted(HOSTILE)
    assert page.data["obstacles"][0]["name"] == HOSTILE[0]
    for words in HOSTILE:
        assert " ".join(words.split()) in page.text


def test_the_map_holds_the_positions_that_were_drawn(mission: Path) -> None:
    data = Page(make(mission, ReportConfig(max_vertices=12))).data
    table, _ = read_table(mission / "hypotheses.parquet", "hypotheses")
    code = data["fans"]

    def numbers(key: str, kind: str) -> np.ndarray:
        return np.frombuffer(base64.b64decode(code[key]), kind)

    assert numbers("num_hypotheses", "<i2").tolist() == [12] * 11
    assert numbers("num_vertices", "<i2").tolist() == [12] * 11
    step = numbers("step", "<i2").reshape(11, 12)
    assert (step[:, 0] == 0).all() and (step[:, -1] == 95).all() and (step == 63).any(axis=1).all()
    shown = numbers("hypothesis", "<i2").reshape(11, 12, 12, 2) * numbers("scale_m", "<f4")[:, None, None, None]
    shown = shown + numbers("centre_m", "<f4").reshape(11, 1, 1, 2) + np.array(data["origin_m"])
    for fan in range(11):
        window, agent = numbers("window", "<i2")[fan], data["agents"][numbers("agent", "<i2")[fan]]
        rows = [row for row in table.to_pylist() if row["window"] == window and row["agent_id"] == agent]
        real = np.array([row["position_m"] for row in rows])[:, step[fan]] + [rows[0]["datum_x_m"], rows[0]["datum_y_m"]]
        assert np.abs(shown[fan] - real).max() < 0.05
    times = np.frombuffer(base64.b64decode(data["detections"]["time_s"]), "<f8")
    assert len(times) == 48 and (np.diff(times) >= 0).all()


def test_latitude_and_longitude_only_with_a_datum(tmp_path: Path) -> None:
    with_datum = Page(make(built(tmp_path / "a", frame=GEOREFERENCED)))
    assert "zero of its metres at 50.8000° N, 1.2000° W" in with_datum.text and with_datum.data["geodesy"] is not None
    without = Page(make(built(tmp_path / "b")))
    assert "zero of its metres" not in without.text and without.data["geodesy"] is None


def test_a_large_mission_is_thinned_to_the_cap_and_says_so(tmp_path: Path) -> None:
    directory = build_mission(tmp_path, num_hypotheses=120)
    result = report(directory, ReportConfig(max_megabytes=0.4, max_hypotheses=120, max_points=40), QUIET)
    content = (directory / "report.html").read_text(encoding="utf-8")
    assert result.summary["num_bytes"] == len(content.encode()) < 400_000
    page = Page(content)
    assert "heaviest of 120 hypotheses" in page.text and "40 of 48 detections, evenly thinned" in page.text
    assert result.summary["left_out"]


def test_a_mission_without_truth_poses_and_hypotheses_still_has_a_page(mission: Path) -> None:
    for name in ("truth.parquet", "poses.parquet", "obstacles.json", "infer.manifest.json"):
        (mission / name).unlink()
    table, frame = read_table(mission / "hypotheses.parquet", "hypotheses")
    write_table(table.slice(0, 0), mission / "hypotheses.parquet", "hypotheses", frame)
    windows, frame = read_table(mission / "windows.parquet", "windows")
    status = pa.array(["no_detections"] * len(windows), pa.string())
    column = windows.schema.get_field_index("status")
    write_table(windows.set_column(column, windows.schema.field(column), status), mission / "windows.parquet", "windows", frame)
    page = Page(make(mission))
    assert "No window has hypotheses" in page.text and "12 of the 12 pairs" in page.text
    assert "Against the truth" not in page.text and page.tags.count("figure") == 0


def test_one_hypothesis_of_one_step_is_enough_for_a_page(mission: Path) -> None:
    table, frame = read_table(mission / "hypotheses.parquet", "hypotheses")
    rows = [
        row | {"position_m": row["position_m"][:1], "origin_index": 0} for row in table.to_pylist() if row["hypothesis"] == 0
    ]
    short = pa.Table.from_pylist(rows, schema=hypotheses_schema(1))
    write_table(short, mission / "hypotheses.parquet", "hypotheses", frame)
    page = Page(make(mission))
    assert "Hypotheses a window 1" in page.text and "0 s back, 0 s ahead" in page.text
    assert page.data["num_steps"] == 1


def test_stamps_on_another_clock_than_the_log(mission: Path) -> None:
    catalogue = json.loads((mission / "catalogue.json").read_text())
    rewrite(mission, "catalogue.json", json.dumps(catalogue | {"start_ns": 5 * 10**9, "end_ns": 9 * 10**9}))
    assert "2023-11-14 22:13:2" in Page(make(mission)).text


def test_an_agent_that_is_only_in_the_truth_is_no_obstacle_to_a_page(mission: Path) -> None:
    table, frame = read_table(mission / "truth.parquet", "truth")
    column = table.schema.get_field_index("agent_id")
    ids = pa.array(["T10" if value == "T0" else "T2" for value in table["agent_id"].to_pylist()], pa.string())
    write_table(table.set_column(column, table.schema.field(column), ids), mission / "truth.parquet", "truth", frame)
    page = Page(make(mission))
    assert page.data["all_agents"] == ["T0", "T1", "T2", "T10"]
    assert "Agents 2 2 more only in the truth" in page.text
    assert "truth is of T10, T2, detections are of T0, T1; give both the same names" in page.text


def test_detections_without_an_agent_are_counted_and_drawn(mission: Path) -> None:
    table, frame = read_table(mission / "detections.parquet", "detections")
    column = table.schema.get_field_index("agent_id")
    ids = pa.array([None if index < 3 else value for index, value in enumerate(table["agent_id"].to_pylist())], pa.string())
    write_table(table.set_column(column, table.schema.field(column), ids), mission / "detections.parquet", "detections", frame)
    page = Page(make(mission))
    assert "3 without a known agent" in page.text
    assert (np.frombuffer(base64.b64decode(page.data["detections"]["owner"]), "<i2") == -1).sum() == 3


def test_detections_of_unknown_origin_belong_to_the_agent_that_infer_made_of_them(mission: Path) -> None:
    rename_agents(mission, {"T0": UNKNOWN_AGENT})
    table, frame = read_table(mission / "detections.parquet", "detections")
    column = table.schema.get_field_index("agent_id")
    ids = pa.array([None if value == UNKNOWN_AGENT else value for value in table["agent_id"].to_pylist()], pa.string())
    write_table(table.set_column(column, table.schema.field(column), ids), mission / "detections.parquet", "detections", frame)
    page = Page(make(mission))
    owners = np.frombuffer(base64.b64decode(page.data["detections"]["owner"]), "<i2")
    assert (owners >= 0).all() and "24 without a known agent" in page.text


def test_windows_without_any_hypotheses_are_skipped_on_the_map(mission: Path) -> None:
    table, frame = read_table(mission / "hypotheses.parquet", "hypotheses")
    kept = table.filter(pc.greater(table["window"], 3))
    write_table(kept, mission / "hypotheses.parquet", "hypotheses", frame)
    page = Page(make(mission))
    assert page.data["window"] == [4, 5] and page.data["first_window"] == 0
    assert "4 windows without any hypotheses are skipped." in page.text and "Windows 6" in page.text


@pytest.mark.parametrize(
    ("name", "content", "words"),
    [
        ("catalogue.json", None, "holds no catalogue.json"),
        ("catalogue.json", "{", "cannot be read"),
        ("catalogue.json", "[]", "has version None, expected 1"),
        ("scores.json", "{", "not readable JSON"),
        ("scores.json", "[]", "expected a JSON object"),
        ("obstacles.json", '{"obstacles": [{"kind": "circle"}]}', "not a list of obstacles"),
        ("obstacles.json", '{"obstacles": 3}', "not a list of obstacles"),
        ("detections.parquet", None, "not found"),
        ("windows.parquet", "no parquet", "not a readable cadence table"),
        ("hypotheses.parquet", None, "not found"),
    ],
)
def test_bad_input_is_one_line_and_leaves_no_page(mission: Path, name: str, content: str | None, words: str) -> None:
    (mission / name).unlink(missing_ok=True)
    if content is not None:
        rewrite(mission, name, content)
    before = sorted(path.name for path in mission.iterdir())
    with pytest.raises(InputError, match=words) as caught:
        report(mission, ReportConfig(), QUIET)
    assert name in str(caught.value) and "\n" not in str(caught.value)
    assert sorted(path.name for path in mission.iterdir()) == before


def test_scores_of_evaluate_are_shown_unless_they_are_of_other_hypotheses(mission: Path) -> None:
    row = {
        "estimator": "cadence",
        "part": "future",
        "by": "part",
        "metric": "energy_score_m",
        "value": 12.345,
        "low": 11,
        "high": None,
    }
    held = row | {"metric": "coverage_90", "value": 0.912, "low": 0.8, "high": 1.0}
    (mission / "scores.json").write_text(json.dumps({"rows": [row, row | {"metric": "fde_m"}, held]}))
    assert "future cadence 12.3 m (11 m to –) – – – 91 % (80 to 100)" in Page(make(mission)).text
    (mission / "evaluate.manifest.json").write_text(json.dumps({"inputs": {"hypotheses.parquet": "0" * 64}, "summary": {}}))
    assert "belongs to other hypotheses" in Page(make(mission)).text


def test_config_refuses_nonsense() -> None:
    with pytest.raises(ValueError, match="max_megabytes"):
        ReportConfig(max_megabytes=0)


def test_how_likely_an_agent_is_there_stands_beside_its_name(mission: Path) -> None:
    assert "(there:" not in Page(make(mission)).text
    make_uncertain(mission, {"T1": 0.62})
    page = Page(make(mission))
    assert {cell[4] for cells in page.data["cells"] for cell in cells} == {None, 0.62}
    drawn = [words for words in page.text.split("On the map") if " at " in words]
    assert any("T1 (there: 62 %) at" in words for words in drawn) and "T0 (there" not in page.text
    assert "there: 62 %" in make(mission).partition('class="chart"')[2]


def test_only_what_is_shown_is_summed_up(mission: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    seen = []
    monkeypatch.setattr(modes, "shape_of", lambda fan: seen.append(fan.agent) or shape_of(fan))
    assert "1 of 2 agents" in Page(make(mission, ReportConfig(max_megabytes=0.05, num_moments=0))).text
    assert len(seen) < 11 and len(set(seen)) == 1
