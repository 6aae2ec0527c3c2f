"""Questions to a mission directory through the command line: sentences, numbers, files, and one clear line for bad input."""

import json
import os
import shutil

import numpy as np
import pyarrow as pa
import pytest
import shapely
from fixtures.asked import asked_mission
from fixtures.mission import FRAME, GEOREFERENCED, START_NS
from PIL import Image

import cli
from cadence.errors import UsageError
from pipeline import Question, open_mission
from pipeline.ask.words import area_words, place_words
from pipeline.frames import to_geodetic
from pipeline.looks import Footprint, LookRows, write_looks
from pipeline.tables import read_table, write_table

SQUARE = json.dumps({"type": "Polygon", "coordinates": [[[-100, -50], [100, -50], [100, 50], [-100, 50], [-100, -50]]]})


@pytest.fixture(scope="module")
def directory(tmp_path_factory):
    return asked_mission(tmp_path_factory.mktemp("asked"))


@pytest.fixture(scope="module")
def placed(tmp_path_factory):
    """The same about 50.8 north, 1.2 west."""
    return asked_mission(tmp_path_factory.mktemp("placed"), GEOREFERENCED)


def ask(capsys, directory, *words):
    code = cli.main(["ask", str(directory), *map(str, words)])
    captured = capsys.readouterr()
    return code, captured.out, captured.err


def told(capsys, directory, *words):
    code, out, err = ask(capsys, directory, *words, "--json")
    assert code == 0, err
    return json.loads(out)["answers"]


def test_inside_in_words_and_numbers(directory, capsys):
    code, out, _ = ask(capsys, directory, "inside", SQUARE, "--agent", "T0")
    assert code == 0
    assert out.startswith(
        "T0 was in the area at some time: 75 % (69 to 80 %); it came in first at 22:14:50; was gone at 22:15:10;"
    )
    assert out.splitlines()[-2].startswith(
        "From 200 hypotheses. In brackets: of shares and areas what drawing more could change"
    )
    assert out.splitlines()[-1].startswith("On measured logs 90 % regions of mission hypotheses held 71 to 98 %")
    (answer,) = told(capsys, directory, "inside", SQUARE, "--agent", "T0")
    assert answer["probability"]["value"] == pytest.approx(0.75)
    assert answer["first_entry"]["median_ns"] == START_NS + 90 * 10**9
    assert answer["left"]["median_ns"] == START_NS + 110 * 10**9
    assert answer["start_ns"] == answer["end_ns"] == START_NS + 90 * 10**9


def test_a_dwell_that_no_story_has_is_less_than_two_per_cent(directory, capsys):
    code, out, _ = ask(capsys, directory, "inside", SQUARE, "--agent", "T0", "--dwell", "21")
    assert code == 0 and out.startswith("T0 was in the area for 21 s or longer at some time: less than 2 %;")
    (answer,) = told(capsys, directory, "inside", SQUARE, "--agent", "T0", "--dwell", "21")
    assert answer["probability"]["value"] == 0 and 0.01 < answer["probability"]["high"] < 0.02


def test_times_are_seconds_iso_or_times_of_day(directory, capsys):
    for start, end in (("0", "89"), ("2023-11-14T22:13:20Z", "2023-11-14T22:14:49"), ("22:13:20", "22:14:49")):
        (answer,) = told(capsys, directory, "inside", SQUARE, "--agent", "T0", "--from", start, "--to", end)
        assert answer["probability"]["value"] == 0


def test_every_agent_is_asked_unless_one_is_named(directory, capsys):
    found = told(capsys, directory, "arrive", "0,0,50")
    assert [answer["agents"] for answer in found] == [["T1"], ["T0"]]  # who is likelier comes first
    assert found[0]["arrival"]["median_ns"] == START_NS + 95 * 10**9
    assert found[1]["place_m"] == [pytest.approx(-50), pytest.approx(0, abs=1e-6)]


def test_an_obstacle_by_its_name(directory, capsys):
    (answer,) = told(capsys, directory, "inside", "mast", "--agent", "T0")
    assert answer["probability"]["value"] == 0 and "in mast" in answer["sentence"]


def test_passed(directory, capsys):
    (answer,) = told(capsys, directory, "passed", "-500,-10 -500,10", "--agent", "T0")
    assert answer["passage"]["median_ns"] == START_NS + 50 * 10**9
    assert answer["to_right"]["value"] == 1 and answer["along_m"]["median"] == pytest.approx(10)


def test_meet(directory, capsys):
    (answer,) = told(capsys, directory, "meet", "T0", "T1", "--within", "100", "--for", "10")
    assert answer["probability"]["value"] == pytest.approx(0.75)
    assert answer["lasted_s"]["median"] == pytest.approx(200 / np.hypot(10, 10))
    assert told(capsys, directory, "meet", "--within", "100")[0]["agents"] == ["T0", "T1"]
    (nobody,) = told(capsys, directory, "meet", "--within", "0.001", "--to", "50")
    assert nobody["agents"] == [] and nobody["sentence"].startswith("No two of 2 agents were within")


def test_same(directory, capsys):
    (answer,) = told(capsys, directory, "same", "T0", "T1")
    assert answer["probability"]["value"] == 0 and "then they are two" in answer["sentence"]
    names = read_table(directory / "detections.parquet", "detections")[0]["agent_id"].to_pylist()
    other = names.index("T1")
    (answer,) = told(capsys, directory, "same", "#0", f"#{other}")
    assert "the log itself says" in answer["sentence"] and "of two agents" in answer["sentence"]


def test_same_of_detections_that_nobody_named(tmp_path, capsys):
    directory = asked_mission(tmp_path)
    table, frame = read_table(directory / "detections.parquet", "detections")
    rows = table.slice(0, 2).to_pylist()
    for row, at_s in zip(rows, (20.0, 60.0), strict=True):  # both on the way of T0
        row |= {"agent_id": None, "time_ns": START_NS + round(at_s * 1e9), "x_m": -1000 + 10 * at_s, "y_m": 0.0}
        row |= {"cov_xx_m2": 100.0, "cov_xy_m2": 0.0, "cov_yy_m2": 100.0}
    changed = pa.Table.from_pylist(rows, schema=table.schema.remove_metadata())
    write_table(changed, directory / "detections.parquet", "detections", frame)
    (answer,) = told(capsys, directory, "same", "#0", "#1")
    assert answer["probability"]["value"] == pytest.approx(0.75, abs=0.01)


def test_where_with_files(placed, tmp_path, capsys):
    code, out, _ = ask(capsys, placed, "where", "--at", "50", "--agent", "T1", "--out", str(tmp_path / "places"))
    assert code == 0 and out.startswith("At 22:14:10 T1 was, with 90 %, within ")
    (answer,) = told(capsys, placed, "where", "--at", "50", "--agent", "T1")
    assert set(answer["areas"]) == {"50", "90", "95"} and answer["centre_m"] == [
        pytest.approx(0, abs=1e-3),
        pytest.approx(-500),
    ]
    content = json.loads((tmp_path / "places" / "where_T1.geojson").read_text())
    areas = [shapely.geometry.shape(feature["geometry"]) for feature in content["features"]]
    latitude, longitude = to_geodetic(GEOREFERENCED, np.array([0.0]), np.array([-500.0]))
    assert all(area.contains(shapely.Point(longitude[0], latitude[0])) for area in areas)
    assert areas[0].area >= areas[1].area >= areas[2].area
    with Image.open(tmp_path / "places" / "where_T1.tif") as image:
        grid = np.asarray(image)
        scale, tie, keys = (image.tag_v2[tag] for tag in (33550, 33922, 34735))
    assert grid.dtype == np.float32 and grid.sum() == pytest.approx(1.0, abs=1e-4)
    row, column = np.unravel_index(grid.argmax(), grid.shape)
    assert tie[3] + (column + 0.5) * scale[0] == pytest.approx(0, abs=scale[0])
    assert tie[4] - (row + 0.5) * scale[1] == pytest.approx(-500, abs=scale[1])
    assert keys[:4] == (1, 1, 0, 9) and (3075, 0, 1, 12) == keys[4 + 4 * 5 : 8 + 4 * 5]
    with Image.open(tmp_path / "places" / "where.png") as image:
        assert image.size[0] > 500


def test_a_place_in_two_parts_says_their_shares(directory, capsys):
    code, out, _ = ask(capsys, directory, "where", "--at", "100", "--agent", "T0")
    assert code == 0 and "in 2 parts: 75 % east, 25 % west" in out


def test_as_of_knows_no_more_than_its_window(directory, capsys):
    (answer,) = told(capsys, directory, "where", "--at", "50", "--agent", "T0", "--as-of", "61")
    assert answer["at_ns"] == START_NS + 50 * 10**9
    assert abs(answer["centre_m"][0] - 1650) < 200  # the windows' T0 is elsewhere than the stories'
    code, _, err = ask(capsys, directory, "where", "--at", "190", "--as-of", "61")
    assert code == 2 and "outside of what is known by the window of as-of" in err
    code, _, err = ask(capsys, directory, "where", "--at", "30", "--as-of", "1")
    assert code == 2 and "nothing was known yet" in err


def test_from_python(directory):
    mission = open_mission(directory)
    (answer,) = mission.ask(Question("inside", agent="T0", area=SQUARE))
    assert answer.probability.value == pytest.approx(0.75)
    (place,) = mission.ask(Question("where", agent="T1", at=50.0))
    assert place.place.grid.probability.sum() == pytest.approx(1.0)
    assert mission.ask(Question("where", agent="T1", at=50.0, as_of=100.0))
    with pytest.raises(ValueError, match="needs area"):
        Question("inside")
    with pytest.raises(UsageError, match="needs area"):
        Question.asked(ask="inside")


def feature(*points):
    return json.dumps({"type": "Feature", "geometry": {"type": "Polygon", "coordinates": [list(points)]}})


CROSSED = feature([-1.2, 50.8], [-1.1, 50.9], [-1.1, 50.8], [-1.2, 50.9], [-1.2, 50.8])


@pytest.mark.parametrize(
    ("words", "says", "code"),
    [
        (["inside", CROSSED], "crosses or touches itself", 2),
        (["inside", feature([170, 50], [-170, 50], [-170, 51], [170, 51], [170, 50])], "crosses the antimeridian", 2),
        (["inside", feature([179, 50], [181, 50], [181, 51], [179, 50])], "crosses the antimeridian", 2),
        (["inside", feature([50.8, -1.2], [50.9, -1.2], [50.9, -1.1], [50.8, -1.2])], "look exchanged: it lies", 2),
        (["inside", "-1.2,50.8,500"], "look exchanged: it lies", 2),
        (["inside", "-1.2,150.8,500"], "", 0),
        (["inside", "150.8,-1.2,500"], "latitude and longitude look exchanged (a latitude of 150.8°)", 2),
        (["inside", "250.8,-1.2,500"], "250.8° is no latitude", 2),
        (["inside", "50.8,-1.2,0"], "must be above zero", 2),
        (["inside", feature([-1.2, 50.8], [-1.1, 50.9], [-1.2, 50.8])], "needs three different points", 2),
        (["inside", "masd"], "neither a file nor a place (did you mean 'mast'?)", 2),
        (["inside", "{not json"], "not GeoJSON", 3),
        (["inside", '{"type": "Point", "coordinates": [0, 50]}'], "holds no Polygon", 3),
        (["inside", feature(["a", 50.8], [-1.1, 50.9], [-1.2, 50.8])], "no positions", 3),
        (["passed", SQUARE], "holds no LineString", 3),
        (["passed", "50.8,-1.2 50.8,-1.2"], "two different points", 2),
        (["inside", "mast", "--from", "0", "--to", "999"], "outside of what is known, 2023-11-14 22:13:20 to 22:16:40 UTC", 2),
        (["inside", "mast", "--from", "yesterday"], "no time; give ISO 8601", 2),
        (["inside", "mast", "--from", "25:00"], "no time; give ISO 8601", 2),
        (["inside", "mast", "--from", "90", "--to", "80"], "is not before", 2),
        (["where", "--at", "50", "--agent", "T2"], "no agent 'T2'", 2),
        (["where", "--at", "50", "--agent", "T01"], "(did you mean 'T1'?)", 2),
        (["where"], "Missing option '--at'", 2),
        (["meet", "T0", "--within", "-5"], "must be above zero", 2),
        (["meet", "T0", "T0", "--within", "5"], "two different agents", 2),
        (["meet", "T0", "T1", "T2", "--within", "5"], "about two agents", 2),
        (["same", "T0", "#3"], "not one of each", 2),
        (["same", "#0", "#99999"], "no row of detections.parquet", 2),
        (["searched"], "states no footprints", 3),
        (["meet", "T0", "--all", "--within", "5"], "about two agents, or about all", 2),
        (["nonsense"], "No such command 'nonsense'", 2),
        (["/", "--at", "50"], "ask: no question behind /; name one of where, inside,", 2),
    ],
)  # fmt: skip
def test_bad_input_is_one_clear_line(placed, words, says, code, capsys):
    got, out, err = ask(capsys, placed, *words)
    assert got == code, err
    if code:
        assert out == "" and err.count("\n") == 1 and err.startswith("cadence: error: ") and says in err


def test_numbers_have_as_many_digits_as_mean_something():
    assert [area_words(area) for area in (5.63, 12_345.0, 2.43e9)] == ["5.63 m²", "12,300 m²", "2,430 km²"]
    assert place_words(FRAME, (-4.6, 1234.5)) == "x -5 m, y 1,234 m"
    assert place_words(FRAME, (-4.6, 1234.5), 0.7) == "x -4.60 m, y 1,234.50 m"
    assert place_words(GEOREFERENCED, (0.0, 0.0), 5.0).count(".") == 2 and len(place_words(GEOREFERENCED, (0.0, 0.0), 5.0)) > 24


def test_several_missions_are_asked_and_what_is_none_is_left_out(directory, tmp_path, capsys):
    batch = tmp_path / "batch.json"
    batch.touch()
    other = tmp_path / "other"
    shutil.copytree(directory, other)
    code, out, err = ask(capsys, batch, directory, other, "where", "--at", "50", "--agent", "T0")
    assert code == 0 and err == f"ask: {batch} is no mission directory and is left out\n"
    named, each = [line for line in out.splitlines() if not line.startswith(" ")], ask(capsys, directory, "where", "--at", "50")
    assert named == [f"{directory.name}:", "other:"] and f"  {each[1].splitlines()[0]}" in out.splitlines()
    code, out, _ = ask(capsys, directory, other, "where", "--at", "50", "--json", "--out", tmp_path / "places")
    assert code == 0 and len(json.loads(out)) == 2
    assert sorted(path.name for path in (tmp_path / "places").iterdir()) == sorted([directory.name, "other"])
    (other / "mission.parquet").unlink()
    code, out, err = ask(capsys, other, directory, "where", "--at", "50")
    assert code == 3 and out.startswith(f"{directory.name}:") and err.startswith(f"cadence: error: {other}")
    code, out, err = ask(capsys, batch, batch, "where", "--at", "50")
    assert code == 3 and out == "" and err.endswith("is a file, not a mission directory\n")


def test_results_of_an_older_format_and_empty_ones(tmp_path, capsys):
    directory = asked_mission(tmp_path)
    table, frame = read_table(directory / "mission.parquet", "mission")
    write_table(table.slice(0, 0), directory / "mission.parquet", "mission", frame)
    code, _, err = ask(capsys, directory, "where", "--at", "50")
    assert code == 3 and err.count("\n") == 1 and "mission.parquet" in err
    os.replace(directory / "windows.parquet", directory / "mission.parquet")
    code, _, err = ask(capsys, directory, "where", "--at", "50")
    assert code == 3 and "holds windows version 1, expected mission version 1" in err
    (directory / "mission.parquet").unlink()
    code, _, err = ask(capsys, directory, "where", "--at", "50")
    assert code == 3 and "run cadence retrospect" in err
    code, _, err = ask(capsys, tmp_path / "nothing", "where", "--at", "50")
    assert code == 3 and "not found" in err
    nobody = asked_mission(tmp_path / "empty")
    for name in ("hypotheses",):
        table, frame = read_table(nobody / f"{name}.parquet", name)
        write_table(table.slice(0, 0), nobody / f"{name}.parquet", name, frame)
    code, _, err = ask(capsys, nobody, "where", "--at", "50", "--as-of", "60")
    assert code == 3 and "no window has hypotheses" in err


def test_files_are_for_where_only(directory, tmp_path):
    from pipeline.ask.spoken import ask as spoken

    with pytest.raises(UsageError, match="--out is for"):
        spoken(directory, Question("inside", area="mast"), tmp_path)


def test_what_was_searched_in_words_and_numbers(tmp_path, capsys):
    """A mast at 0, 0 sees 200 m far with 50 % where T0 passes in three of four stories; its looks miss, but for one of T1."""
    mission = asked_mission(tmp_path)
    rows = LookRows(
        START_NS + np.array([60, 100, 100], dtype=np.int64) * 10**9, ["mast"] * 3, np.zeros(3, dtype=np.int64),
        np.zeros(3, dtype=np.int64), np.zeros((3, 2)), np.zeros(3), [frozenset(), frozenset(), frozenset({"T1"})],
    )  # fmt: skip
    write_looks(mission, "patrol", rows, [Footprint("mast", (((0.0, 0.5), (200.0, 0.5)),), is_standing=True)], FRAME)
    first, second = sorted(told(capsys, mission, "searched"), key=lambda answer: answer["agents"])
    # two looks at T0 near the mast in 150 of 200 stories, of which .3 counts; the other look was too early
    assert first["num_looks"] == 3 and first["success"]["value"] == pytest.approx(0.75 * (1 - 0.5**0.6))
    assert second["num_looks"] == 2 and second["success"]["value"] == pytest.approx(1 - 0.5**0.3)
    assert first["success_by"][0] == 0.0 and first["success_by"] == sorted(first["success_by"])
    # at the end T0 is at 1000, 0 in the stories that were searched, and at -1000, 0 in those that were not
    left = 0.75 * 0.5**0.6
    assert first["next_look"]["sensor"] == "mast" and first["next_look"]["place_m"] == [1000.0, 0.0]
    assert first["next_look"]["success"] == pytest.approx(0.5 * left / (left + 0.25))
    code, out, _ = ask(capsys, mission, "searched", "--agent", "T0", "--from", "90", "--to", "110")
    assert code == 0 and out.startswith(
        "2 looks between 22:14:50 and 22:15:10 did not see T0, and would have with 26 % (20 to 32 %)"
    )
    code, out, err = ask(capsys, mission, "searched", "--from", "110")
    assert code == 3 and not out and "no sensor looked between 22:15:10" in err
