"""Foxglove layouts for a side file and its log: what to show, described once and written in two forms.

`build_layout` gives the form of the Foxglove SDK (`foxglove.layouts`, version 1); `build_legacy_layout` the older one
(`configById` and a tree of panel ids) that the open viewers of the Foxglove Studio family read.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from pipeline.catalogue import CatalogueChannel
from pipeline.export.display import Style
from pipeline.tables import Frame
from schemas import channels

Json = dict[str, Any]

MAX_PLOTTED = 12
"""Agents whose series are switched on: more lines cannot be told apart."""

_SCENE_TYPES = frozenset(
    {"Marker", "MarkerArray", "OccupancyGrid", "Odometry", "Path", "PointCloud", "PoseArray", "PoseInFrame", "PosesInFrame"}
    | {"PoseStamped", "PoseWithCovarianceStamped", "SceneUpdate"}
)
_MAP_TYPES = frozenset({"GeoJSON", "LocationFix", "LocationFixes", "NavSatFix"})


@dataclass(frozen=True)
class _Panel:
    """One panel: its name in either form, what it is called, its settings, and its share of the column it stands in."""

    type: str
    legacy_type: str
    title: str
    config: Mapping[str, Any]
    share: float


def build_layout(frame: Frame, style: Style, source: Sequence[CatalogueChannel], topics: Sequence[str]) -> Json:
    """The layout in the form of the Foxglove SDK. `topics` are those of the side file, `source` those of the log."""
    columns = []
    for share, panels in _columns(frame, style, source, topics):
        items = [
            {
                "proportion": panel.share,
                "content": {
                    "type": "panel",
                    "panelType": panel.type,
                    "config": panel.config,
                    "title": panel.title,
                    "version": 1,
                },
            }
            for panel in panels
        ]
        columns.append({"proportion": share, "content": {"type": "split", "direction": "column", "items": items}})
    return {"version": 1, "content": {"type": "split", "direction": "row", "items": columns}}


def build_legacy_layout(frame: Frame, style: Style, source: Sequence[CatalogueChannel], topics: Sequence[str]) -> Json:
    """The layout in the older form; arguments as for `build_layout`."""
    (left_share, left), (right_share, right) = _columns(frame, style, source, topics)
    configs = {_legacy_id(panel): _legacy_config(panel, frame) for panel in (*left, *right)}
    return {
        "configById": configs,
        "globalVariables": {},
        "userNodes": {},
        "playbackConfig": {"speed": 1},
        "layout": {
            "direction": "row",
            "first": _legacy_column(left),
            "second": _legacy_column(right),
            "splitPercentage": 100.0 * left_share / (left_share + right_share),
        },
    }


def _legacy_config(panel: _Panel, frame: Frame) -> Json:
    # The viewers of the family differ in the name of the title's key, and only the older form has a centre of the map.
    titles = {"foxglovePanelTitle": panel.title, "lichtblickPanelTitle": panel.title}
    is_map = panel.legacy_type == "map" and frame.is_georeferenced
    center = {"center": {"lat": frame.latitude_deg, "lon": frame.longitude_deg}} if is_map else {}
    return {**panel.config, **titles, **center}


def _legacy_id(panel: _Panel) -> str:
    return f"{panel.legacy_type}!{''.join(letter for letter in panel.title.lower() if letter.isalnum())}"


def _legacy_column(panels: Sequence[_Panel]) -> Json | str:
    """A binary tree: the first panel, and below it the rest."""
    if len(panels) == 1:
        return _legacy_id(panels[0])
    below = sum(panel.share for panel in panels[1:])
    return {
        "direction": "column",
        "first": _legacy_id(panels[0]),
        "second": _legacy_column(panels[1:]),
        "splitPercentage": 100.0 * panels[0].share / (panels[0].share + below),
    }


def _columns(
    frame: Frame, style: Style, source: Sequence[CatalogueChannel], topics: Sequence[str]
) -> tuple[tuple[float, tuple[_Panel, ...]], tuple[float, tuple[_Panel, ...]]]:
    """Left the scene (and the map), right the numbers."""
    scene = _Panel("ThreeDee", "3D", "Hypotheses", _scene_config(frame, style, source, topics), 2.0)
    left: tuple[_Panel, ...] = (scene,)
    if frame.is_georeferenced:
        left += (_Panel("Map", "map", "Map", _map_config(style, source, topics), 1.0),)
    plots = [("Spread (m)", _spread_series), ("Detections", _detection_series)]
    plots += [("Height (m)", _height_series)] if style.high_ids else []
    plots += [("Association", _association_series)] if style.uncertain_ids else []
    few = f", {MAX_PLOTTED} of {len(style.plotted_ids)} agents" if len(style.plotted_ids) > MAX_PLOTTED else ""
    right: tuple[_Panel, ...] = tuple(
        _Panel("Plot", "Plot", title + few, _plot_config(series(style)), 1.0) for title, series in plots
    )
    right += (_Panel("RawMessages", "RawMessages", "Agents", {"topicPath": channels.AGENTS.topic, "diffEnabled": False}, 1.0),)
    return (2.0, left), (1.0, right)


def _scene_config(frame: Frame, style: Style, source: Sequence[CatalogueChannel], topics: Sequence[str]) -> Json:
    shown: Json = {topic: {"visible": True} for topic in _of_types(source, _SCENE_TYPES)}
    for channel in (channels.SCENE, channels.PRESENT, channels.OBSTACLES, channels.OCCUPANCY):
        if channel.topic in topics:
            shown[channel.topic] = {"visible": True}
    # Whole lines, given everything: over the windows' they would hide what was known when.
    if channels.MISSION_SCENE.topic in topics:
        shown[channels.MISSION_SCENE.topic] = {"visible": False}
    if channels.OCCUPANCY.topic in topics:
        shown[channels.OCCUPANCY.topic] |= {"colorMode": "rgba-fields", "colorField": "probability", "frameLocked": True}
    camera = {
        "perspective": False,
        "distance": 1.5 * style.extent_m,
        "phi": 0.0,
        "thetaOffset": 0.0,
        "target": [0.0, 0.0, 0.0],
        "targetOffset": [*style.center_m, 0.0],
        "targetOrientation": [0.0, 0.0, 0.0, 1.0],
        "fovy": 45.0,
        "near": 0.01 * style.extent_m,
        "far": 100.0 * style.extent_m,
    }
    return {
        "cameraState": camera,
        "followMode": "follow-pose",
        "followTf": frame.frame_id,
        "scene": {"backgroundColor": "#10151c"},
        "topics": shown,
        "layers": {},
        "transforms": {},
    }


def _map_config(style: Style, source: Sequence[CatalogueChannel], topics: Sequence[str]) -> Json:
    colors = {}
    for agent_id in style.agent_ids:
        for channel in (channels.fix_channel(agent_id), channels.detection_fix_channel(agent_id)):
            if channel.topic in topics:
                colors[channel.topic] = style.hue(agent_id)
    colors |= {topic: "#cccccc" for topic in _of_types(source, _MAP_TYPES)}
    return {
        "layer": "map",
        "customTileUrl": "",
        "disabledTopics": [channels.FIXES.topic] * (channels.FIXES.topic in topics),  # the map draws all of a topic at once
        "followTopic": "",
        "topicColors": colors,
        "zoomLevel": _zoom_level(style.extent_m),
        "maxNativeZoom": 18,
    }


def _zoom_level(extent_m: float) -> int:
    """The web map's zoom at which about 500 pixels hold the extent: a pixel is 156 km wide at level 0, half at each next."""
    level = 0
    while level < 18 and 156_543.0 / 2 ** (level + 1) * 500.0 > extent_m:
        level += 1
    return level


def _plot_config(series: Iterable[Json]) -> Json:
    return {
        "paths": list(series),
        "xAxisVal": "timestamp",
        "isSynced": True,
        "showLegend": True,
        "legendDisplay": "floating",
        "showPlotValuesInLegend": False,
        "showXAxisLabels": True,
        "showYAxisLabels": True,
        "sidebarDimension": 240,
    }


def _spread_series(style: Style) -> Iterable[Json]:
    for agent_id, agent in _plotted(style):
        yield _series(style, agent_id, f"{agent}.spread_m", "now", line_size=2)
        yield _series(style, agent_id, f"{agent}.horizon_spread_m", "horizon", line_size=1)


def _detection_series(style: Style) -> Iterable[Json]:
    """The age of the last detection rises and falls to zero; the detections themselves are points."""
    for agent_id, agent in _plotted(style):
        yield _series(style, agent_id, f"{agent}.age_s", "age (s)", line_size=1)
        if agent_id in style.named_ids:
            detection = f"{channels.DETECTIONS.topic}{_filter('agent_id', agent_id)}.num_merged"
            yield _series(style, agent_id, detection, "detected", line_size=3) | {"showLine": False}


def _height_series(style: Style) -> Iterable[Json]:
    """The mean height of each agent, and the heights at which it was detected as points."""
    for agent_id, agent in _plotted(style):
        if agent_id in style.high_ids:
            yield _series(style, agent_id, f"{agent}.height_m", "height", line_size=2)
            if agent_id in style.named_ids:
                detection = f"{channels.DETECTIONS.topic}{_filter('agent_id', agent_id)}.z_m"
                yield _series(style, agent_id, detection, "detected", line_size=3) | {"showLine": False}


def _association_series(style: Style) -> Iterable[Json]:
    """How likely each agent is to be there, how open the origin of its detections is, and of each detection its share in it."""
    for agent_id, agent in _plotted(style):
        if agent_id in style.uncertain_ids:
            yield _series(style, agent_id, f"{agent}.probability", "is there", line_size=2)
            yield _series(style, agent_id, f"{agent}.association_entropy_bits", "entropy (bit)", line_size=1)
            source = f"{channels.DETECTIONS.topic}.association.agents[:]{_filter('id', agent_id)}"
            yield _series(style, agent_id, f"{source}.probability", "detected", line_size=3) | {"showLine": False}


def _plotted(style: Style) -> Iterable[tuple[str, str]]:
    """Agents that there is something to plot of, and the message path of each; series of others would stay empty."""
    for agent_id in style.plotted_ids:
        yield agent_id, f"{channels.AGENTS.topic}.agents[:]{_filter('id', agent_id)}"


def _series(style: Style, agent_id: str, path: str, label: str, line_size: int) -> Json:
    return {
        "value": path,
        "enabled": agent_id in style.plotted_ids[:MAX_PLOTTED],
        "timestampMethod": "receiveTime",
        "label": f"{agent_id} {label}",
        "color": style.hue(agent_id),
        "lineSize": line_size,
    }


def _filter(name: str, value: str) -> str:
    """A filter of the message path syntax; it knows no escapes, so the quotes must not occur in the value."""
    quote = "'" if '"' in value else '"'
    return f"{{{name}=={quote}{value}{quote}}}"


def _of_types(source: Sequence[CatalogueChannel], types: frozenset[str]) -> list[str]:
    """Topics whose message has one of these names in any package, ROS 1, ROS 2 or protobuf."""
    return [channel.topic for channel in source if channel.schema_name.replace(".", "/").rpartition("/")[2] in types]
