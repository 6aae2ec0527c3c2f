"""How large marks and cells are: by what is seen of an agent, not by how far the mission reaches."""

from collections.abc import Mapping, Sequence

import numpy as np

from cadence.arrays import Float64s
from pipeline.export.playback import LiveAgent, Scene

_SHARE_OF_REACH = 0.01
_SHARE_OF_SPACING = 0.25
_LEAST_SHARE = 1e-5
"""Of the mission: below it a mark is a point at any zoom, and numbers lose their meaning."""


def reach_m(live: LiveAgent) -> float:
    """The longer side of the box around all hypotheses of an agent in a window; at least a millimetre."""
    return max(float(np.ptp(live.position_m, axis=(0, 1)).max()), 1e-3)


def mark_sizes_m(scenes: Sequence[Scene], sigma_m: Mapping[str, float], extent_m: float) -> dict[str, float]:
    """Diameter of the marks of each agent that has hypotheses.

    A hundredth of what its hypotheses reach in a window (the median over windows), or the accuracy of its detections where
    that is more, but no more than a quarter of the distance to the nearest other agent.
    """
    reaches: dict[str, list[float]] = {}
    spacings: dict[str, list[float]] = {}
    for scene in scenes:
        for live, spacing_m in zip(scene.live, _spacing_m(scene), strict=True):
            reaches.setdefault(live.agent.agent_id, []).append(reach_m(live))
            spacings.setdefault(live.agent.agent_id, []).append(spacing_m)
    found = {}
    for agent_id, reached_m in reaches.items():
        wanted_m = max(_SHARE_OF_REACH * float(np.median(reached_m)), sigma_m.get(agent_id, 0.0))
        most_m = _SHARE_OF_SPACING * float(np.median(spacings[agent_id]))
        found[agent_id] = max(min(wanted_m, most_m), _LEAST_SHARE * extent_m)
    return found


def _spacing_m(scene: Scene) -> Float64s:
    """Distance of each live agent to the nearest other one at the origin; infinite where it is alone."""
    now_m = np.array([live.mean_m[live.window.origin_index] for live in scene.live]).reshape(-1, 2)
    apart = np.linalg.norm(now_m[:, None] - now_m, axis=-1)
    np.fill_diagonal(apart, np.inf)
    return np.asarray(apart.min(axis=1, initial=np.inf))
