"""Hypotheses at a moment as points: foxglove.PointCloud, and foxglove.LocationFixes for maps, for viewers that draw no scenes.

A cloud at every tick would outgrow what it shows. So clouds come as often as their share of the side file allows, evenly;
each is self-contained, and stays until the next.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from cadence.arrays import Float64s, Indices
from pipeline.export.display import Style
from pipeline.export.playback import LiveAgent, Tick
from pipeline.export.scene import round_positions
from pipeline.export.sizes import reach_m
from pipeline.frames import to_geodetic
from pipeline.logs.writer import foxglove_class
from pipeline.results import WindowHypotheses
from pipeline.tables import Frame

_FLOAT32, _UINT8 = 7, 1  # foxglove.PackedElementField.NumericType
_POINT = np.dtype([("xyz", "<f4", (3,)), ("rgba", "u1", (4,))])
_FIELDS = (
    *((name, 4 * number, _FLOAT32) for number, name in enumerate("xyz")),
    *((name, 12 + number, _UINT8) for number, name in enumerate(("red", "green", "blue", "alpha"))),
)
_HEAD_BYTES = 150
_CLOUD_SHARE, _FIXES_SHARE = 0.18, 0.06
"""Of what all hypotheses take in the file."""
_PACKED_SHARE = 1.0 / 6.0
"""So many bytes hypotheses take there for each that their floats have."""
_POINT_BYTES, _FIX_BYTES = 8.0, 30.0
"""Of a point and of a fix in the file, about."""
_NUM_FIXES = 10
"""Hypotheses of an agent on the map: a message of fixes is five times as large as a cloud."""
_LEAST_ALPHA = 0.2


@dataclass(frozen=True)
class CloudPlan:
    """The ticks, by number, at which clouds and fixes are written."""

    clouds: frozenset[int]
    fixes: frozenset[int]


def plan_clouds(
    ticks: Sequence[Tick], windows: Sequence[WindowHypotheses], num_hypotheses: int, is_georeferenced: bool
) -> CloudPlan:
    """As many, evenly, as fit into their shares of what the hypotheses take; always those of the first and the last tick."""
    hypothesis_bytes = _PACKED_SHARE * sum(agent.position_m.nbytes for window in windows for agent in window.agents)
    num_points = [_num_points(tick, num_hypotheses) for tick in ticks]
    num_fixes = [_num_points(tick, _NUM_FIXES) for tick in ticks]
    clouds = _chosen([num * _POINT_BYTES + _HEAD_BYTES for num in num_points], _CLOUD_SHARE * hypothesis_bytes)
    fixes = (
        _chosen([num * _FIX_BYTES for num in num_fixes], _FIXES_SHARE * hypothesis_bytes) if is_georeferenced else frozenset()
    )
    # A message says where somebody is: where nobody is, there is none.
    return CloudPlan(clouds, frozenset(index for index in fixes if num_fixes[index]))


def encode_cloud(tick: Tick, frame: Frame, style: Style, time_ns: int) -> bytes:
    """foxglove.PointCloud of all agents' heaviest hypotheses now: colour by agent, opacity by weight; empty without any."""
    live = tick.scene.live if tick.scene else ()
    points = np.concatenate([_points(each, tick.time_ns, style) for each in live]) if live else np.zeros(0, _POINT)
    message = foxglove_class("foxglove.PointCloud")(
        frame_id=frame.frame_id, point_stride=_POINT.itemsize, data=points.tobytes()
    )
    message.timestamp.FromNanoseconds(time_ns)
    message.pose.position.x, message.pose.position.y = style.center_m
    message.pose.position.z = style.z_m
    message.pose.orientation.w = 1.0
    for name, offset, kind in _FIELDS:
        message.fields.add(name=name, offset=offset, type=kind)
    data: bytes = message.SerializeToString()
    return data


def encode_fixes(tick: Tick, frame: Frame, style: Style, time_ns: int) -> bytes:
    """foxglove.LocationFixes of each agent's heaviest hypotheses now, in latitude and longitude."""
    message = foxglove_class("foxglove.LocationFixes")()
    for live in tick.scene.live if tick.scene else ():
        chosen = _heaviest(live, _NUM_FIXES)
        place = live.at(tick.time_ns)[chosen]
        latitude, longitude = to_geodetic(frame, place[:, 0], place[:, 1])
        red, green, blue, _ = style.color(live.agent.agent_id).tolist()
        for lat, lon, alpha in zip(latitude.tolist(), longitude.tolist(), _alpha(live, chosen).tolist(), strict=True):
            fix = message.fixes.add(
                frame_id=frame.frame_id, latitude=round(lat, 7), longitude=round(lon, 7), altitude=style.z_m
            )
            fix.timestamp.FromNanoseconds(time_ns)
            fix.color.r, fix.color.g, fix.color.b, fix.color.a = red, green, blue, alpha
    data: bytes = message.SerializeToString()
    return data


def _points(live: LiveAgent, now_ns: int, style: Style) -> np.ndarray:
    chosen = _heaviest(live, style.num_hypotheses)
    found = np.zeros(len(chosen), _POINT)
    # Relative to the middle of the mission: as float32 positions far from zero would lose centimetres.
    found["xyz"][:, :2] = round_positions(live.at(now_ns)[chosen] - np.array(style.center_m), reach_m(live))
    found["rgba"][:, :3] = np.round(255 * style.color(live.agent.agent_id)[:3])
    found["rgba"][:, 3] = np.round(255 * _alpha(live, chosen))
    return found


def _heaviest(live: LiveAgent, number: int) -> Indices:
    return np.sort(np.argsort(-live.weight, kind="stable")[:number])


def _alpha(live: LiveAgent, chosen: Indices) -> Float64s:
    """Opacity by weight beside the heaviest."""
    share: Float64s = live.weight[chosen] / live.weight[chosen].max()
    return np.asarray(np.round(np.maximum(share, _LEAST_ALPHA) * 64.0) / 64.0)  # the zero bits compress


def _num_points(tick: Tick, most: int) -> int:
    return sum(min(len(live.weight), most) for live in tick.scene.live) if tick.scene else 0


def _chosen(sizes: Sequence[float], room: float) -> frozenset[int]:
    """Numbers of ticks, evenly, whose sizes fit into the room."""
    if not sizes:
        return frozenset()
    every = max(1, int(np.ceil(sum(sizes) / max(room, 1.0))))
    return frozenset([*range(0, len(sizes), every), len(sizes) - 1])
