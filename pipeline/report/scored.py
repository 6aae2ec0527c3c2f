"""The hypotheses against the truth of the log, by the functions and so with the figures of `cadence evaluate`."""

from collections import Counter
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from cadence.arrays import Float64s
from cadence.errors import InputError
from cadence.types import HypothesisSet
from pipeline.report.mission import Mission, Points
from pipeline.scoring.case import Case, read_case
from pipeline.scoring.motion import MOTION_METRICS, MotionLaws, true_motion
from pipeline.scoring.scores import Cells, part_mean, score_in_chunks

MAX_PAIRS = 1e8
"""Distances between two hypotheses that are looked at: of more windows only every second, third, … is compared."""

PARTS = ("past", "future")


@dataclass(frozen=True, eq=False)
class Scored:
    """One cell for each window, agent and step with known truth, and what else needs the truth.

    every         every so many windows are compared
    windows       numbers of windows, by their index in the cells; agents: names in the truth, by theirs
    true_agent    by window number and agent, the name in the truth of the agent that it stands for
    laws, true_laws  how hypotheses move, and how the truth does
    fastest_mps   one in a thousand of the true steps is faster
    is_matched    names differ: who is who was found by the detections
    """

    cells: Cells
    every: int
    windows: tuple[int, ...]
    agents: tuple[str, ...]
    true_agent: dict[tuple[int, str], str]
    laws: MotionLaws
    true_laws: MotionLaws
    fastest_mps: float
    is_matched: bool

    def mean(self, part: str, metric: str) -> float:
        """A figure of `cadence evaluate`."""
        return part_mean(self.cells, part, metric)

    def errors_m(self, part: str) -> Float64s:
        """The mean distance of a hypothesis from the truth, at every step that is compared."""
        return self.cells.column("ade_m")[self.cells.is_in(part)]

    def distance(self, part: str, metric: str) -> float:
        """How far a law of motion is from that of the truth (see `MOTION_METRICS`)."""
        return self.laws[part].distance(self.true_laws[part], MOTION_METRICS[metric])


def score_mission(directory: Path, mission: Mission) -> Scored | str:
    """The scores; or why there are none: empty where the log holds no truth."""
    if mission.truth is None:
        return ""
    if not mission.fans:
        return "No window has hypotheses."
    try:
        case = read_case(directory, mission.stored)
    except InputError as error:
        return str(error).removeprefix(f"{directory}: ")
    if case.scored.num_steps < 2:
        return "Windows of one step are not compared."
    pairs = float(case.is_known.sum()) * case.num_hypotheses**2
    every = max(1, int(np.ceil(pairs / MAX_PAIRS)))
    index = torch.arange(0, len(case.truth_m), every)
    scored, truth_m, is_known = case.scored[index], case.truth_m[index], case.is_known[index]
    truth = true_motion(scored, truth_m, is_known)
    motion = truth.fresh()

    def draw(chosen: Tensor) -> HypothesisSet:
        return case.draw_scored(index[chosen])

    cells = score_in_chunks(
        motion.watch(draw), scored, truth_m, is_known, case.num_hypotheses, fastest_m=truth.fastest_m, is_brief=True
    )
    if not len(cells):
        return f"No step has both hypotheses and truth; positions of the truth are at most {case.max_truth_gap_s:g} s apart."
    windows = tuple(window.window for window in mission.stored.windows)
    return Scored(
        cells, every, windows[::every], case.names, _true_agents(case, windows), motion.laws(), truth.laws(),
        truth.fastest_m / case.grid.step_s, case.is_matched,
    )  # fmt: skip


def _true_agents(case: Case, windows: tuple[int, ...]) -> dict[tuple[int, str], str]:
    names = case.windows.agent_ids
    return {
        (windows[b], names[agent]): case.names[j]
        for b, agents in enumerate(case.match.tolist())
        for j, agent in enumerate(agents)
        if agent >= 0
    }


def errors_now(scored: Scored | str) -> dict[tuple[int, str], float]:
    """By window and the truth's name: the mean distance of a hypothesis from the truth at the window's own moment."""
    if isinstance(scored, str):
        return {}
    cells = scored.cells
    is_now = cells.step == 0
    columns = (column[is_now].tolist() for column in (cells.window, cells.agent, cells.column("ade_m")))
    return {(scored.windows[window], scored.agents[agent]): error_m for window, agent, error_m in zip(*columns, strict=True)}


def truth_of(mission: Mission, scored: Scored | str, window: int, agent: int) -> Points | None:
    """The truth of an agent in a window: of the same name, else of the one that it was matched to."""
    if mission.truth is None:
        return None
    name = mission.agents[agent]
    if not isinstance(scored, str):
        name = scored.true_agent.get((window, name), name)
    points = mission.truth.of(mission.agents.index(name))
    # One unnamed agent and one truth are the same, whatever it is called.
    owners = Counter(mission.truth.owner.tolist())
    return mission.truth if not len(points) and len(owners) == 1 and mission.num_tracked == 1 else points
