"""The stage: mission directory in, report.html out."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from cadence.arrays import Float64s
from pipeline.manifest import JsonObject, StageResult, run_stage
from pipeline.progress import Progress
from pipeline.report.analysis import Analyser, Analysis, Moment, choose_moments, shape_of, shown_share
from pipeline.report.charts import MAX_TICKS
from pipeline.report.fans import Detail, FanCode, choose_detail, encode_fan
from pipeline.report.geodesy import fit_geodesy
from pipeline.report.mission import Mission, load_mission, mission_inputs
from pipeline.report.page import write_page
from pipeline.report.payload import Payload, build_payload

FIXED_BYTES, BYTES_A_POINT, BYTES_A_CELL, BYTES_A_TICK = 300_000, 25, 60, 14
"""Room for what is not a fan of the interactive map: text and small maps, points, window rows, ticks in the charts."""


@dataclass(frozen=True)
class ReportConfig:
    """How much the page shows.

    max_megabytes   the interactive map is thinned until the page fits; what was left out is stated
    num_moments     small maps of chosen moments
    max_hypotheses, max_vertices  of one agent in one window on the interactive map
    max_points      detections, truth and sensor positions on the interactive map, each
    """

    max_megabytes: float = 5.0
    num_moments: int = 6
    max_hypotheses: int = 30
    max_vertices: int = 96
    max_points: int = 20_000

    def __post_init__(self) -> None:
        if (
            self.max_megabytes <= 0
            or self.num_moments < 0
            or self.max_hypotheses < 1
            or self.max_vertices < 3
            or self.max_points < 2
        ):
            raise ValueError(
                "max_megabytes must be > 0, num_moments >= 0, max_hypotheses >= 1, max_vertices >= 3, max_points >= 2"
            )


def report(directory: Path, config: ReportConfig, progress: Progress, force: bool = False) -> StageResult:
    """Write `directory`/report.html from what the other stages left there.

    Raises `InputError` where the catalogue, the detections, the windows or the hypotheses are absent or damaged.
    """

    def body(work: Path) -> JsonObject:
        mission = load_mission(directory)
        with progress.bar(2 * len(mission.fans), "report", unit="fan") as bar:
            analysis = _analyse(mission, bar)
            moments = choose_moments(mission, analysis, config.num_moments)
            payload = _payload(mission, config, moments, bar)
        page = write_page(mission, analysis, payload, moments)
        # Names come from logs: a lone surrogate in one must cost that letter, not the page.
        content = page.encode("utf-8", "replace")
        (work / "report.html").write_bytes(content)
        return {
            "num_bytes": len(content),
            "num_agents": len(mission.agents),
            "num_detections": len(mission.detections),
            "num_windows": len(mission.origins_ns),
            "left_out": list(payload.notes),
        }

    return run_stage(
        "report", directory, config=config, inputs=[*mission_inputs(directory), *_assets()], body=body, force=force
    )


def _assets() -> list[Path]:
    # The look of the page is an input too: a newer style must not be skipped.
    folder = Path(str(resources.files("pipeline.report")))
    return [folder / "page.css", folder / "page.js", folder / "explorer.html"]


def _analyse(mission: Mission, bar: "tqdm[Any]") -> Analysis:
    analyser = Analyser(mission)
    for fan in mission.fans:
        analyser.add(fan, shape_of(fan))
        bar.update(1)
    return analyser.result()


def _payload(mission: Mission, config: ReportConfig, moments: Sequence[Moment], bar: "tqdm[Any]") -> Payload:
    wanted = Detail(len(mission.drawn_windows), len(mission.agents), config.max_hypotheses, config.max_vertices)
    detail = choose_detail(mission, _budget_bytes(mission, config), wanted)
    windows = _shown_windows(mission, detail.num_windows, [mission.fans[moment.fan].window for moment in moments])
    agents = _shown_agents(mission, detail.num_agents)
    shown_windows, shown_agents, codes = set(windows), set(agents), list[FanCode]()
    for fan in mission.fans:
        # Shapes are computed again rather than kept: those of a long mission do not fit into memory beside its hypotheses.
        if fan.window in shown_windows and fan.agent in shown_agents:
            codes.append(encode_fan(fan, shape_of(fan), detail))
        bar.update(1)
    geodesy = fit_geodesy(mission.frame, *_extent(mission, codes))
    return build_payload(mission, codes, windows, agents, geodesy, config.max_points, shown_share(mission))


def _budget_bytes(mission: Mission, config: ReportConfig) -> float:
    points = [found for found in (mission.detections, mission.truth, mission.poses) if found is not None]
    num_points = sum(min(len(found), config.max_points) for found in points)
    num_ticks = min(len(mission.detections), MAX_TICKS * len(mission.agents))
    others = FIXED_BYTES + num_points * BYTES_A_POINT + len(mission.rows) * BYTES_A_CELL + num_ticks * BYTES_A_TICK
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


def _shown_agents(mission: Mission, count: int) -> list[int]:
    frequency = Counter(mission.detections.owner.tolist())
    ranked = sorted(range(len(mission.agents)), key=lambda agent: (-frequency[agent], agent))
    return sorted(ranked[:count])


def _extent(mission: Mission, codes: list[FanCode]) -> tuple[Float64s, Float64s]:
    corners = [
        points.position_m for points in (mission.detections, mission.truth, mission.poses) if points is not None and len(points)
    ]
    corners += [code.centre_m[None] for code in codes]
    joined = np.concatenate(corners) if corners else np.zeros((1, 2))
    return joined.min(axis=0), joined.max(axis=0)
