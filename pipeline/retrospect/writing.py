"""Mission hypotheses into their table: tracks drawn, joined and written, and what is said of them."""

from pathlib import Path
from typing import Any

import numpy as np
import torch

from cadence.arrays import Float64s
from cadence.bank.plausible import plausible_speed
from cadence.bank.pool import BankPool
from cadence.constraints.obstacles import Obstacles
from cadence.retrospect.limits import MissionLimits
from cadence.stories import Stories
from pipeline.checkpoints import read_info
from pipeline.estimators.fitting import FittingData
from pipeline.estimators.presets import find_weights
from pipeline.obstacle_file import OBSTACLES_NAME, read_obstacles
from pipeline.progress import Progress
from pipeline.retrospect.config import RetrospectConfig
from pipeline.retrospect.draws import MissionDraw
from pipeline.retrospect.heights import heights_beside
from pipeline.retrospect.sources import MissionSources
from pipeline.retrospect.timing import Timing, plan_times
from pipeline.stories import MissionStories, write_stories
from pipeline.threads import num_cores, one_thread


def write_mission(
    directory: Path, folder: Path, config: RetrospectConfig, num_threads: int | None, progress: Progress
) -> dict[str, Any]:
    """Draw the stories of the mission in `directory` and write them into `folder`; the stage's summary."""
    sources = MissionSources.read(directory, config.num_hypotheses, config.seed)
    obstacles = read_obstacles(directory / OBSTACLES_NAME)
    with one_thread():
        data = sources.fitting(config.seed)
        mission, summary = drawn_stories(sources, data, config, obstacles, progress, num_threads or num_cores())
    write_stories(mission, folder)
    return summary


def drawn_stories(
    sources: MissionSources,
    data: FittingData,
    config: RetrospectConfig,
    obstacles: Obstacles,
    progress: Progress,
    num_threads: int,
) -> tuple[MissionStories, dict[str, Any]]:
    """The stories of a mission, and what the stage's summary says of them; `data` as `sources` have it."""
    timing = _timing(sources, config)
    draw = _mission_draw(sources, data, timing, config, obstacles)
    shape = (config.num_hypotheses, len(sources.agent_ids), len(timing.time_ns), 2)
    position, num_tracks, num_replaced = np.full(shape, np.nan), 0, 0
    with progress.bar(len(sources.shares), "retrospect", unit="track") as bar:
        for share, drawn, replaced in draw.tracks(sources.shares, num_threads, bar.update):
            position[share.stories, share.agent] = drawn
            num_tracks, num_replaced = num_tracks + len(drawn), num_replaced + replaced
    weight = np.full(config.num_hypotheses, 1.0 / config.num_hypotheses)
    time_s, start_ns, height = draw.timeline.time_s.numpy(), int(timing.time_ns[0]), None
    if data.tracks.height_m is not None:
        height = heights_beside(
            data.fitted_heights(sources.told_of("height")), sources.shares, position, time_s, start_ns, config.seed
        )
    stories = Stories(time_s, position, weight, sources.agent_ids, height)
    mission = MissionStories(sources.frame, sources.log_id, start_ns, stories, timing.blocks)
    return mission, {
        "num_hypotheses": config.num_hypotheses,
        "num_agents": len(sources.agent_ids),
        "num_steps": len(timing.time_ns),
        "num_blocks": len(timing.blocks),
        "step_s": timing.step_ns * 1e-9,
        "duration_s": float(stories.time_s[-1]),
        "replaced_share": num_replaced / max(num_tracks, 1),
        "plausible_speed_mps": draw.limits.plausible_speed_mps,
        "bank": {name: value for name, value in draw.pool.about().items() if name != "future"},
        "remarks": [*timing.remarks, *_remarks(sources)],
    }


def _timing(sources: MissionSources, config: RetrospectConfig) -> Timing:
    seen_ns: dict[int, list[Any]] = {}
    for share in sources.shares:
        seen_ns.setdefault(share.agent, []).append(share.track.time_ns)
    grid = sources.grid
    return plan_times([np.concatenate(times) for times in seen_ns.values()], config, grid.step_ns, grid.history_steps)


def _mission_draw(
    sources: MissionSources, data: FittingData, timing: Timing, config: RetrospectConfig, obstacles: Obstacles
) -> MissionDraw:
    guidance, step_s = sources.told.guidance, sources.grid.step_s
    pool: BankPool = data.bank_for_gaps(sources.told_of("bank"))
    datum_m: Float64s = np.round(np.concatenate([share.track.position_m for share in sources.shares]).mean(axis=0))
    is_free = guidance.mode == "none"
    limits = MissionLimits(
        Obstacles.none() if is_free else obstacles,
        guidance.margin_m,
        torch.from_numpy(datum_m),
        None if is_free else guidance.max_speed_mps,
        None if is_free else plausible_speed(data.tracks, step_s),
        pool.length_m(step_s),
    )
    timeline = timing.timeline(step_s)
    return MissionDraw(pool, timing, timeline, datum_m, limits, config.before_s, config.after_s, config.seed)


def _remarks(sources: MissionSources) -> list[str]:
    """What mission hypotheses leave out of what the windows' checkpoint knows and the limits say."""
    found = []
    checkpoint = str(sources.summary.get("checkpoint", sources.told.checkpoint))
    weights = find_weights(checkpoint)
    if weights is not None and read_info(weights).preset != "general":
        found.append(
            f"mission hypotheses know motion and obstacles, not the place: checkpoint {checkpoint!r} draws the windows alone"
        )
    guidance = sources.told.guidance
    if guidance.max_acceleration_mps2 is not None or guidance.max_turn_rate_dps is not None:
        found.append(
            "mission hypotheses keep obstacles and speed; infer.guidance.max_acceleration_mps2 and max_turn_rate_dps hold in "
            "the windows alone"
        )
    return found
