"""Heights in the side file: lines and marks at their height, numbers, fixes, GeoJSON; nothing of it without heights."""

import json
from pathlib import Path

import numpy as np
import pytest
from fixtures.heights import add_heights, true_height_m
from fixtures.mission import NUM_HYPOTHESES, NUM_STEPS, build_mission
from fixtures.side_files import read_hypotheses
from foxglove_schemas_protobuf.GeoJSON_pb2 import GeoJSON
from foxglove_schemas_protobuf.LocationFix_pb2 import LocationFix
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate
from test_export import CONFIG, GEOREFERENCED, QUIET, messages

from pipeline.export.stage import export
from schemas.channels import message_class


@pytest.fixture(scope="module")
def high(tmp_path_factory: pytest.TempPathFactory) -> Path:
    directory = build_mission(tmp_path_factory.mktemp("high"), frame=GEOREFERENCED)
    add_heights(directory)
    export(directory, CONFIG, QUIET)
    return directory


def test_lines_lie_at_their_height(high: Path) -> None:
    """Each point of a line has the height of its place in some hypothesis, to the rounding of the scene."""
    (_, scene), *_ = messages(high, "/cadence/scene", SceneUpdate)
    heights = {
        entity.id: np.array([[p.z for p in line.points][i] for line in entity.lines for i in (0, -1)])
        for entity in scene.entities
        if entity.lines
    }
    origin_ns = scene.entities[0].timestamp.ToNanoseconds()
    low, high_m = true_height_m(np.array([origin_ns - 63 * 10**9, origin_ns + 32 * 10**9]))
    assert heights["agent/T0"].min() == pytest.approx(low, abs=2.0)
    assert heights["agent/T0"].max() == pytest.approx(high_m + NUM_HYPOTHESES - 1, abs=2.0)
    assert len(set(heights["agent/T1"])) == 1, "without a height of its own it lies on the floor of the scene"
    marks = {entity.id: [sphere.pose.position.z for sphere in entity.spheres] for entity in scene.entities if entity.spheres}
    assert len(set(marks["detections/T0"])) > 1


def test_numbers_and_hypotheses_have_heights(high: Path) -> None:
    agents = [message for _, message in messages(high, "/cadence/agents", message_class("cadence.Agents"))]
    states = {state.id: state for state in agents[0].agents}
    assert states["T0"].HasField("height_m") and states["T0"].height_spread_m == pytest.approx(3.45, abs=0.5)
    assert not states["T1"].HasField("height_m")
    (_, first), *_ = messages(high, "/cadence/hypotheses", message_class("cadence.Hypotheses"))
    assert first.vertical_datum == "sea level"
    found = {agent.agent_id: agent.height_m for agent in read_hypotheses(high / "patrol.cadence.mcap").windows[0].agents}
    assert found["T0"].shape == (NUM_HYPOTHESES, NUM_STEPS) and found["T1"] is None
    np.testing.assert_allclose(found["T0"][:, 0] - found["T0"][0, 0], np.arange(NUM_HYPOTHESES), atol=0.1)


def test_fixes_and_geojson_have_altitudes(high: Path) -> None:
    for _, fix in messages(high, "/cadence/fix/T0", LocationFix):
        time_ns = fix.timestamp.ToNanoseconds()
        assert fix.altitude == pytest.approx(float(true_height_m(np.array(time_ns))) + 5.5, abs=1.0)
        assert 5.0 < fix.position_covariance[8] < 15.0
    (_, seen), *_ = messages(high, "/cadence/detection_fix/T0", LocationFix)
    assert seen.position_covariance[8] == 4.0
    (_, told), *_ = messages(high, "/cadence/map", GeoJSON)
    features = {feature["properties"]["name"]: feature for feature in json.loads(told.geojson)["features"]}
    line = np.array(features["T0 mean"]["geometry"]["coordinates"])
    assert line.shape[1] == 3 and (np.diff(line[:, 2]) > 0).all()
    low, top = features["T0 90%"]["properties"]["height_m"]
    assert low < line[0, 2] and top > line[-1, 2]
    assert "height_m" not in features["T1 90%"]["properties"]


def test_a_plot_of_heights_is_laid_out(high: Path) -> None:
    layout = (high / "patrol.layout.json").read_text()
    assert "Height (m)" in layout and ".height_m" in layout


def test_without_heights_nothing_speaks_of_them(tmp_path: Path) -> None:
    directory = build_mission(tmp_path, frame=GEOREFERENCED)
    export(directory, CONFIG, QUIET)
    assert "Height" not in (directory / "patrol.layout.json").read_text()
    (_, told), *_ = messages(directory, "/cadence/map", GeoJSON)
    assert "height_m" not in told.geojson
