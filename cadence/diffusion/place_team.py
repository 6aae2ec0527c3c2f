"""Windows of several agents as rows of one agent each, for networks that draw an agent alone or all of a window together."""

import dataclasses

import torch
from torch import Tensor

from cadence.diffusion.place_frame import PlaceConfig
from cadence.network.attention import Team
from cadence.seeds import part_seeds
from cadence.types import Detections, WindowBatch


@dataclasses.dataclass(frozen=True, eq=False)
class AgentRows:
    """R rows, one agent each.

    windows           of one agent, with their context; every row has a detection
    window, agent     [R] what a row stands for
    is_real           [R] bool; the other rows stand for absent agents, with the detections of somebody else
    team              which rows see each other; None: none do
    """

    windows: WindowBatch
    window: Tensor
    agent: Tensor
    is_real: Tensor
    team: Team | None


def agent_rows(windows: WindowBatch, config: PlaceConfig) -> AgentRows:
    """Every agent of every window of which anything is known.

    Without attention these are the agents with detections, each for itself. With it, all agents of windows with any detection,
    window after window. Where nobody knows whose a detection is, give the windows of `shared_detections`.
    """
    active = windows.is_active
    if not config.network.attention_heads:
        window, agent = active.nonzero(as_tuple=True)
        return _rows(windows, window, agent, agent, torch.ones_like(agent, dtype=torch.bool), None)
    kept = active.any(dim=1).nonzero()[:, 0]
    is_present = active[kept]
    window = kept.repeat_interleave(windows.num_agents)
    agent = torch.arange(windows.num_agents).repeat(len(kept))
    # somebody else's detections in place of none: such rows are computed, seen by nobody, and thrown away
    somebody = is_present.to(torch.int64).argmax(dim=1).repeat_interleave(windows.num_agents)
    is_real = is_present.flatten()
    return _rows(windows, window, agent, torch.where(is_real, agent, somebody), is_real, Team(is_present))


def _rows(windows: WindowBatch, window: Tensor, agent: Tensor, source: Tensor, is_real: Tensor, team: Team | None) -> AgentRows:
    d = windows.detections
    columns = (d.time_s, d.position_m, d.covariance_m2, d.is_observed)
    seeds = part_seeds(windows.seeds[window], "agent", agent)
    context = windows.required_context("agent_rows")
    goal = context.known_goal_m
    mine = dataclasses.replace(context[window], known_goal_m=None if goal is None else goal[window, source][:, None])
    detections = Detections(*(value[window, source][:, None] for value in columns))
    rows = WindowBatch(windows.time_s, detections, seeds, windows.origin_index, mine)
    return AgentRows(rows, window, agent, is_real, team)


def shared_detections(windows: WindowBatch) -> WindowBatch:
    """The same windows, with the detections of all agents told of each of them, oldest first (the paper's unknown origin)."""
    d = windows.detections
    b, a, n = d.time_s.shape
    is_observed = d.is_observed.reshape(b, 1, a * n)
    time_s = d.time_s.reshape(b, 1, a * n)
    order = torch.where(is_observed, time_s, torch.inf).argsort(dim=-1, stable=True)
    merged = Detections(
        time_s.gather(2, order),
        d.position_m.reshape(b, 1, a * n, 2).gather(2, order[..., None].expand(-1, -1, -1, 2)),
        d.covariance_m2.reshape(b, 1, a * n, 2, 2).gather(2, order[..., None, None].expand(-1, -1, -1, 2, 2)),
        is_observed.gather(2, order),
    )
    plane = (value for value in vars(merged).values() if value is not None)  # no model of a place knows heights
    everybody = Detections(*(value.expand(b, a, *value.shape[2:]) for value in plane))
    return dataclasses.replace(windows, detections=everybody)
