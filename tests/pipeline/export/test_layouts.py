import json
from dataclasses import replace

import numpy as np
import pytest

from pipeline.catalogue import CatalogueChannel
from pipeline.export.display import Style, agent_hue
from pipeline.export.layouts import build_layout, build_legacy_layout
from pipeline.tables import Frame
from schemas import channels

IDS = ("T0", 'say "hi"')
STYLE = Style(IDS, (100.0, -50.0), 1000.0, 0.0, 30, 32, {}, plotted_ids=IDS, named_ids=frozenset(IDS))
MAP, EARTH = Frame("map"), Frame("mission", 50.8, -1.2)
TOPICS = [
    c.topic for c in (channels.SCENE, channels.AGENTS, channels.OCCUPANCY, channels.DETECTIONS, channels.fix_channel("T0"))
]


def channel(topic, schema_name):
    return CatalogueChannel(1, topic, "cdr", schema_name, "ros2msg", 1, None, None, True, None, None)


SOURCE = [
    channel("/boat/pose", "geometry_msgs/msg/PoseStamped"),
    channel("/drone", "foxglove.PoseInFrame"),
    channel("/gps", "sensor_msgs/msg/NavSatFix"),
    channel("/log", "rcl_interfaces/msg/Log"),
]


def panels(node):
    if node["type"] == "panel":
        return [node]
    return [panel for item in node["items"] for panel in panels(item["content"])]


def leaves(node):
    return [node] if isinstance(node, str) else [*leaves(node["first"]), *leaves(node["second"])]


@pytest.mark.parametrize("frame", [MAP, EARTH])
def test_both_forms_show_the_same_panels(frame):
    new, old = build_layout(frame, STYLE, SOURCE, TOPICS), build_legacy_layout(frame, STYLE, SOURCE, TOPICS)
    assert new["version"] == 1
    assert set(leaves(old["layout"])) == set(old["configById"])
    found = {panel["title"]: panel for panel in panels(new["content"])}
    assert len(found) == len(old["configById"]) == (5 if frame.is_georeferenced else 4)
    for config in old["configById"].values():
        assert found[config["foxglovePanelTitle"]]["config"].items() <= config.items()
    assert json.loads(json.dumps(new)) == new


def test_scene_panel_follows_the_mission_and_shows_what_is_there():
    scene = panels(build_layout(MAP, STYLE, SOURCE, TOPICS)["content"])[0]
    assert (scene["panelType"], scene["version"], scene["config"]["followTf"]) == ("ThreeDee", 1, "map")
    shown = set(scene["config"]["topics"])
    assert shown == {"/cadence/scene", "/cadence/occupancy", "/boat/pose", "/drone"}
    assert scene["config"]["cameraState"]["targetOffset"] == [100.0, -50.0, 0.0]


def test_map_panel_has_the_colours_of_the_agents():
    map_panel = panels(build_layout(EARTH, STYLE, SOURCE, TOPICS)["content"])[1]
    assert map_panel["config"]["topicColors"] == {"/cadence/fix/T0": STYLE.hue("T0"), "/gps": "#cccccc"}
    assert 13 <= map_panel["config"]["zoomLevel"] <= 17


def test_plot_paths():
    plots = [panel for panel in panels(build_layout(MAP, STYLE, SOURCE, TOPICS)["content"]) if panel["panelType"] == "Plot"]
    values = [series["value"] for plot in plots for series in plot["config"]["paths"]]
    assert '/cadence/agents.agents[:]{id=="T0"}.spread_m' in values
    assert "/cadence/agents.agents[:]{id=='say \"hi\"'}.spread_m" in values
    assert '/cadence/detections{agent_id=="T0"}.num_merged' in values


def series_of(style):
    plots = [panel for panel in panels(build_layout(MAP, style, SOURCE, TOPICS)["content"]) if panel["panelType"] == "Plot"]
    return [plot["title"] for plot in plots], [series for plot in plots for series in plot["config"]["paths"]]


def test_of_many_agents_all_have_series_and_the_title_says_which_are_on():
    ids = tuple(f"T{number}" for number in range(33))
    titles, series = series_of(replace(STYLE, agent_ids=ids, plotted_ids=ids[::-1], named_ids=frozenset(ids)))
    assert titles == ["Spread (m), 12 of 33 agents", "Detections, 12 of 33 agents"]
    assert {each["label"].partition(" ")[0] for each in series} == set(ids)
    assert {each["label"].partition(" ")[0] for each in series if each["enabled"]} == set(ids[21:])


def test_no_series_stays_empty():
    """Agents without hypotheses have none; those told apart by us have no detections under their names."""
    style = replace(STYLE, plotted_ids=("a0",), named_ids=frozenset({"T0"}), uncertain_ids=frozenset({"a0"}))
    titles, series = series_of(style)
    assert titles == ["Spread (m)", "Detections", "Association"]
    assert [each["label"] for each in series] == [
        *("a0 now", "a0 horizon", "a0 age (s)", "a0 is there", "a0 entropy (bit)", "a0 detected")
    ]
    assert not [each["value"] for each in series if "{agent_id==" in each["value"]]


def test_older_form_holds_what_importers_demand():
    """Lichtblick 1.27 refuses a layout without these fields, or with other types of them."""
    layout = build_legacy_layout(EARTH, STYLE, SOURCE, TOPICS)
    assert all(isinstance(layout[name], dict) for name in ("configById", "globalVariables", "userNodes", "layout"))
    assert isinstance(layout["playbackConfig"]["speed"], int)


def test_form_is_that_of_the_foxglove_sdk():
    """Rebuild the panels with the SDK's own classes: every key of ours must be one of theirs."""
    layouts = pytest.importorskip("foxglove.layouts", reason="foxglove-sdk is not installed (development only)")
    kinds = {
        "ThreeDee": layouts.ThreeDeeConfig,
        "Map": layouts.MapConfig,
        "Plot": layouts.PlotConfig,
        "RawMessages": layouts.RawMessagesConfig,
    }
    nested = {
        "cameraState": layouts.ThreeDeeCameraState,
        "scene": layouts.BaseRendererSceneSettings,
    }
    layout = build_layout(EARTH, STYLE, SOURCE, TOPICS)
    sdk = layouts.Layout(content=layouts.SplitContainer(items=[layouts.SplitItem(content=layouts.PlotPanel())]))
    reference = json.loads(sdk.to_json())
    assert layout.keys() <= reference.keys() | {"variables", "userScripts"}
    assert layout["content"].keys() == reference["content"].keys()
    assert layout["content"]["items"][0].keys() == reference["content"]["items"][0].keys()
    for panel in panels(layout["content"]):
        assert panel.keys() <= layouts.PlotPanel(title="x")._to_dict().keys()
        assert panel["config"].keys() <= kinds[panel["panelType"]]()._to_dict().keys()
        for name, kind in nested.items():
            assert panel["config"].get(name, {}).keys() <= kind()._to_dict().keys()
        for series in panel["config"].get("paths", []):
            assert series.keys() <= layouts.PlotSeries()._to_dict().keys()


def test_forty_agents_have_forty_colours_that_can_be_told_apart() -> None:
    hues = [agent_hue(index) for index in range(40)]
    rgb = np.array([[int(hue[i : i + 2], 16) for i in (1, 3, 5)] for hue in hues], float)
    apart = np.linalg.norm(rgb[:, None] - rgb, axis=-1) + 1000.0 * np.eye(40)
    assert apart.min() > 20.0
    assert all(len(hue) == 7 for hue in hues)
