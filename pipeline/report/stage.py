"""The stage: mission directory in, report.html out."""

from collections import Counter
from dataclasses import dataclass
from importlib import resources
from pathlib import Path

import numpy as np

from pipeline.manifest import JsonObject, StageResult, run_stage
from pipeline.progress import Progress
from pipeline.report.analysis import Analyser, Analysis, choose_moments, shape_of
from pipeline.report.geodesy import fit_geodesy
from pipeline.report.mission import Mission, load_mission, mission_inputs
from pipeline.report.page import write_page
from pipeline.report.payload import Detail, FanCode, Payload, build_payload, choose_detail, encode_fan

OTHER_BYTES = 1_200_000
"""Room for everything in the page that is not a fan of the interactive map."""


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
    max_vertices: int = 48
    max_points: int = 15_000

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
        analysis, payload = _draw(mission, config, progress)
        page = write_page(mission, analysis, payload, choose_moments(mission, analysis, config.num_moments))
        (work / "report.html").write_text(page, encoding="utf-8", newline="\n")
        return {
            "num_bytes": len(page.encode("utf-8")),
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
    return [folder / "page.css", folder / "page.js"]


def _draw(mission: Mission, config: ReportConfig, progress: Progress) -> tuple[Analysis, Payload]:
    wanted = Detail(len(mission.origins_ns), len(mission.agents), config.max_hypotheses, config.max_vertices)
    detail = choose_detail(mission, max(config.max_megabytes * 1e6 - OTHER_BYTES, config.max_megabytes * 5e5), wanted)
    windows, agents = _shown_windows(mission, detail.num_windows), _shown_agents(mission, detail.num_agents)
    analyser, codes = Analyser(mission), list[FanCode]()
    is_shown = (set(windows), set(agents))
    with progress.bar(len(mission.fans), "report", unit="fan") as bar:
        for fan in mission.fans:
            shape = shape_of(fan)
            analyser.add(fan, shape)
            if fan.window in is_shown[0] and fan.agent in is_shown[1]:
                codes.append(encode_fan(fan, shape, detail))
            bar.update(1)
    geodesy = fit_geodesy(mission.frame, *_extent(mission, codes))
    return analyser.result(), build_payload(mission, codes, windows, agents, geodesy, config.max_points)


def _shown_windows(mission: Mission, count: int) -> list[int]:
    windows = list(mission.origins_ns)
    chosen = np.unique(np.linspace(0, len(windows) - 1, min(count, len(windows))).round().astype(int)) if windows else []
    return [windows[index] for index in chosen]


def _shown_agents(mission: Mission, count: int) -> list[int]:
    frequency = Counter(mission.detections.owner.tolist())
    ranked = sorted(range(len(mission.agents)), key=lambda agent: (-frequency[agent], agent))
    return sorted(ranked[:count])


def _extent(mission: Mission, codes: list[FanCode]) -> tuple[np.ndarray, np.ndarray]:
    corners = [
        points.position_m for points in (mission.detections, mission.truth, mission.poses) if points is not None and len(points)
    ]
    corners += [code.centre_m[None] for code in codes]
    joined = np.concatenate(corners) if corners else np.zeros((1, 2))
    return joined.min(axis=0), joined.max(axis=0)
