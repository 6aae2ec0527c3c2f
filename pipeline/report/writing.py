"""A mission as a page that fits the size that was asked for: all that costs something when the stage runs."""

from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from cadence.arrays import Float64s
from pipeline.manifest import JsonObject
from pipeline.progress import Progress
from pipeline.report.analysis import Moment, analyse, choose_moments, shown_share
from pipeline.report.charts import MAX_TICKS
from pipeline.report.config import ReportConfig
from pipeline.report.fans import Detail, FanCode, choose_detail, encode_fan
from pipeline.report.geodesy import fit_geodesy
from pipeline.report.mission import Mission, load_mission
from pipeline.report.modes import strands_of_all
from pipeline.report.page import write_page
from pipeline.report.payload import Payload, build_payload
from pipeline.report.scored import score_mission
from pipeline.report.whole import whole_section
from pipeline.threads import one_thread

FIXED_BYTES, BYTES_A_POINT, BYTES_A_CELL, BYTES_A_TICK = 300_000, 25, 60, 14
"""Room for what is not a fan of the interactive map: text and small maps, points, window rows, ticks in the charts."""


def write_report(directory: Path, folder: Path, config: ReportConfig, progress: Progress) -> JsonObject:
    """Write `folder`/report.html from what the other stages left in `directory`; the summary."""
    mission = load_mission(directory)
    with one_thread(), progress.bar(2 * len(mission.fans), "report", unit="fan") as bar:
        analysis = analyse(mission, score_mission(directory, mission), bar.update)
        moments = choose_moments(mission, analysis, config.num_moments)
        whole = whole_section(mission, config.max_megabytes * 1e6)
        payload = _payload(mission, config, moments, len(whole), bar)
    page = write_page(mission, analysis, payload, moments, whole)
    # Names come from logs: a lone surrogate in one must cost that letter, not the page.
    content = page.encode("utf-8", "replace")
    (folder / "report.html").write_bytes(content)
    return {
        "num_bytes": len(content),
        "num_agents": len(mission.agents),
        "num_detections": len(mission.detections),
        "num_windows": len(mission.origins_ns),
        "left_out": list(payload.notes),
    }


def _payload(mission: Mission, config: ReportConfig, moments: Sequence[Moment], taken_bytes: int, bar: "tqdm[Any]") -> Payload:
    wanted = Detail(len(mission.drawn_windows), len(mission.told_agents), config.max_hypotheses, config.max_vertices)
    detail = choose_detail(mission, _budget_bytes(mission, config, taken_bytes), wanted)
    windows = _shown_windows(mission, detail.num_windows, [mission.fans[moment.fan].window for moment in moments])
    agents = _shown_agents(mission, detail.num_agents, [mission.fans[moment.fan].agent for moment in moments])
    shown_windows, shown_agents, codes = set(windows), set(agents), list[FanCode]()
    shown = [fan for fan in mission.fans if fan.window in shown_windows and fan.agent in shown_agents]
    bar.update(len(mission.fans) - len(shown))
    for fan, strands in strands_of_all(shown, mission.solid):
        codes.append(encode_fan(fan, strands, detail))
        bar.update(1)
    geodesy = fit_geodesy(mission.frame, *_extent(mission, codes))
    return build_payload(mission, codes, windows, agents, geodesy, config.max_points, shown_share(mission))


def _budget_bytes(mission: Mission, config: ReportConfig, taken_bytes: int) -> float:
    points = [found for found in (mission.detections, mission.truth, mission.poses) if found is not None]
    num_points = sum(min(len(found), config.max_points) for found in points)
    num_ticks = min(len(mission.detections), MAX_TICKS * len(mission.agents))
    others = (
        taken_bytes + FIXED_BYTES + num_points * BYTES_A_POINT + len(mission.rows) * BYTES_A_CELL + num_ticks * BYTES_A_TICK
    )
    return max(config.max_megabytes * 1e6 - others, config.max_megabytes * 2e5)


def _shown_windows(mission: Mission, count: int, always: Sequence[int]) -> list[int]:
    """`count` windows evenly over the mission, and those `always` shown in place of their neighbours."""
    windows = mission.drawn_windows
    if count >= len(windows):
        return windows
    chosen = np.unique(np.linspace(0, len(windows) - 1, count).round().astype(int))
    for place in sorted({windows.index(window) for window in always} - set(chosen.tolist())):
        chosen[np.abs(chosen - place).argmin()] = place
    return [windows[place] for place in np.unique(chosen)]


def _shown_agents(mission: Mission, count: int, always: Sequence[int]) -> list[int]:
    """`count` agents: those `always` shown, and those with the most detections."""
    frequency = Counter(mission.detections.owner.tolist())
    ranked = sorted(mission.told_agents, key=lambda agent: (agent not in always, -frequency[agent], agent))
    return sorted(ranked[:count])


def _extent(mission: Mission, codes: list[FanCode]) -> tuple[Float64s, Float64s]:
    corners = [
        points.position_m for points in (mission.detections, mission.truth, mission.poses) if points is not None and len(points)
    ]
    corners += [code.centre_m[None] for code in codes]
    joined = np.concatenate(corners) if corners else np.zeros((1, 2))
    return joined.min(axis=0), joined.max(axis=0)
