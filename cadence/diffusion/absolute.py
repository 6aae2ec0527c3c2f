"""The paper's model as an estimator: a network in absolute (normalised) coordinates, its sampling, inpainting and guidance.

Ye, Natarajan, Wu, Gombolay, "Diffusion Models for Multi-target Adversarial Tracking" (CADENCE, MRS 2023). What the paper leaves
open is a switch here; the defaults are the paper's, except that detections are put in by the smoother (`inpainting`).
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Self

import torch
from torch import Tensor

from cadence.bank.rows import active_rows, scatter_hypotheses
from cadence.bank.smoother import Nodes
from cadence.constraints import Constraint
from cadence.constraints.motion import SpeedConstraint
from cadence.constraints.obstacles import ObstacleConstraint, Obstacles
from cadence.diffusion.guidance import PaperCost, adam_guidance, clean_estimate_guidance
from cadence.diffusion.inpainting import (
    Correction,
    GridDetections,
    grid_detections,
    known_cells,
    overwritten,
    overwritten_at_level,
    smoother_correction,
)
from cadence.diffusion.noise import RowNoise
from cadence.diffusion.sampler import Hook, sample_ddim, sample_ddpm, sample_dpmpp_2m
from cadence.diffusion.settings import AbsoluteSampling
from cadence.errors import ConfigError
from cadence.network.trajectory import TrajectoryNetwork, TrajectoryNetworkConfig
from cadence.types import Context, Detections, HypothesisSet, WindowBatch


@dataclass(frozen=True)
class AbsoluteConfig:
    """What belongs to a checkpoint: the network, and what its numbers mean.

    step_s         seconds between steps
    history_steps  steps up to and including the origin; 1 as in the paper: the first step is now
    centre_m, scale_m  of the map, in the mission frame: (position - centre) / scale lies within the clip
    relative       positions about the last detection instead of the centre
    clip           clean estimates are clamped to [-clip, clip]
    age_scale_steps  ages of detections are counted in this many steps (the paper's longest mission)
    optional_goal  the network was trained with and without the known goal: an unknown one is told as zeros
    """

    network: TrajectoryNetworkConfig = field(default_factory=TrajectoryNetworkConfig)
    step_s: float = 60.0
    history_steps: int = 1
    centre_m: tuple[float, float] = (0.0, 0.0)
    scale_m: float = 1.0
    relative: bool = False
    clip: float = 1.0
    age_scale_steps: float = 4320.0
    optional_goal: bool = False

    def __post_init__(self) -> None:
        if not (self.step_s > 0 and self.scale_m > 0 and self.clip > 0 and self.age_scale_steps > 0):
            raise ValueError("step_s, scale_m, clip and age_scale_steps must be positive")
        if not 1 <= self.history_steps <= self.network.num_steps:
            raise ValueError(f"history_steps is {self.history_steps}, expected 1 ... {self.network.num_steps}")

    @property
    def horizon_steps(self) -> int:
        """Steps after the origin."""
        return self.network.num_steps - self.history_steps


@dataclass(frozen=True, eq=False)
class AbsoluteModel:
    """A trained network as an `Estimator`.

    It fills every step of its grid (`config.history_steps`, `config.horizon_steps`) and takes no other. Agents without
    detections are NaN. The windows must say where they are unless the model is relative and unguided.
    """

    network: TrajectoryNetwork
    config: AbsoluteConfig
    sampling: AbsoluteSampling = field(default_factory=AbsoluteSampling)
    name: str = "absolute"

    def fit(self, tracks: Detections) -> Self:
        """The model itself: it adapts to nothing."""
        return self

    @torch.no_grad()
    def sample(self, windows: WindowBatch, num_hypotheses: int) -> HypothesisSet:
        """Joint hypotheses; a window's depend on its seed, not on its neighbours. Raises `ConfigError` for another grid."""
        self._check(windows)
        nodes, seeds = active_rows(windows)
        window, agent = windows.is_active.nonzero(as_tuple=True)
        per_chunk = max(1, self.sampling.chunk // num_hypotheses)
        parts = [torch.zeros(0, num_hypotheses, windows.num_steps, 2, dtype=torch.float64)]
        for begin in range(0, len(seeds), per_chunk):
            pick = slice(begin, begin + per_chunk)
            rows = nodes[torch.arange(len(seeds))[pick]]
            frame = absolute_frame(rows, window[pick], agent[pick], windows.context, self.config)
            parts.append(self._sample_rows(frame, RowNoise(seeds[pick]), num_hypotheses))
        return scatter_hypotheses(torch.cat(parts), windows)

    def _check(self, windows: WindowBatch) -> None:
        config = self.config
        got = (windows.num_steps, windows.origin_index)
        if got != (config.network.num_steps, config.history_steps - 1) or abs(windows.step_s / config.step_s - 1.0) > 1e-6:
            raise ConfigError(
                f"infer.grid: this checkpoint predicts {config.network.num_steps} steps of {config.step_s:g} s only; set "
                f"step_s = {config.step_s:g}, history_steps = {config.history_steps}, horizon_steps = {config.horizon_steps}"
            )
        if not (self.config.relative and self.sampling.guidance == "none"):
            windows.required_context("AbsoluteModel")

    def _sample_rows(self, frame: "AbsoluteFrame", stream: "RowNoise", num_hypotheses: int) -> Tensor:
        """Hypotheses [R, K, T, 2] in metres relative to the datum."""
        detections = self._detections(frame)
        start = stream.draw((num_hypotheses, self.config.network.num_steps, 2))
        correction = noise = None
        if self.sampling.inpainting == "smoother" or self.sampling.guidance == "clean":
            correction = smoother_correction(detections, self.sampling.length_steps, self.sampling.amplitude)
            noise = stream.draw_each(num_hypotheses, detections.is_used)
        denoise = _Denoiser(self, frame, correction, noise, num_hypotheses)
        on_state = self._on_state(detections, start)
        schedule = self.config.network.schedule()
        if self.sampling.sampler == "ddpm":
            on_mean = self._paper_guidance(frame) if self.sampling.guidance == "paper" else _keep
            state = sample_ddpm(denoise, start, schedule, lambda like: stream.draw(like.shape[1:]), on_mean, on_state)
        else:
            angles = torch.linspace(float(schedule.angle[-1]), 0.0, self.sampling.num_steps + 1, dtype=torch.float64)
            solve = sample_ddim if self.sampling.sampler == "ddim" else sample_dpmpp_2m
            state = solve(denoise, start, angles, on_state=on_state)
        return state.double() * self.config.scale_m + frame.centre_m[:, None, None]

    def _detections(self, frame: "AbsoluteFrame") -> GridDetections:
        """What lies on the grid, in normalised units."""
        nodes, scale = frame.nodes, self.config.scale_m
        floor = self.sampling.floor**2 * torch.eye(2, dtype=torch.float64)
        at = nodes.time_s / self.config.step_s + (self.config.history_steps - 1)
        position = (nodes.position_m - frame.centre_m[:, None]) / scale
        covariance = nodes.covariance_m2 / scale**2 + floor
        return grid_detections(at, position, covariance, nodes.is_observed, self.config.network.num_steps)

    def _on_state(self, detections: GridDetections, start: Tensor) -> Hook:
        mode = self.sampling.inpainting
        if mode not in ("overwrite", "noise_matched"):
            return _keep
        cells = known_cells(detections)
        if mode == "overwrite":
            return lambda state, angle: overwritten(state, cells)
        # the start's own noise, at every level: a path of noise levels that one clean trajectory has
        return lambda state, angle: overwritten_at_level(state, cells, angle, start)

    def _paper_guidance(self, frame: "AbsoluteFrame") -> Hook:
        """Algorithm 1 on the normalised mean; the cost is in metres, its step length in map units."""
        cost = PaperCost(frame.obstacles, unit_m=self.config.scale_m, offset_m=frame.datum_m[:, None, None])

        def guided(mean: Tensor, angle: float) -> Tensor:
            return adam_guidance(
                mean, lambda x: cost.cost(self._metres(x, frame)), self.sampling.learning_rate, self.sampling.iterations
            )

        return guided

    def _metres(self, normalised: Tensor, frame: "AbsoluteFrame") -> Tensor:
        return normalised * self.config.scale_m + frame.centre_m[:, None, None].to(normalised)


@dataclass(frozen=True, eq=False)
class AbsoluteFrame:
    """R rows: their detections, the normaliser's centre and the datum [R, 2], further inputs [R, 1, E], what is in the way."""

    nodes: Nodes
    centre_m: Tensor
    datum_m: Tensor
    extra: Tensor | None
    obstacles: Obstacles

    def detection_rows(self, config: AbsoluteConfig) -> tuple[Tensor, Tensor]:
        """What the network reads of the detections: rows [R, N, 3] and which of them exist [R, N]."""
        position = (self.nodes.position_m - self.centre_m[:, None]) / config.scale_m
        age = -self.nodes.time_s / config.step_s / config.age_scale_steps
        return detection_rows(age, position, self.nodes.is_observed, config.network.max_detections)


def absolute_frame(
    nodes: Nodes, window: Tensor, agent: Tensor, context: Context | None, config: AbsoluteConfig
) -> AbsoluteFrame:
    """The rows `nodes` of the given windows and agents [R], in their place as far as a context is given."""
    rows = torch.arange(len(window))
    datum = torch.zeros(len(window), 2, dtype=torch.float64)
    if context is not None:
        datum = context.datum_m.double()[window]
    centre = torch.tensor(config.centre_m, dtype=torch.float64) - datum
    if config.relative:
        centre = nodes.position_m[rows, nodes.is_observed.sum(dim=1) - 1]
    obstacles = Obstacles.none() if context is None else context.obstacles
    return AbsoluteFrame(nodes, centre, datum, _extra(window, agent, datum + centre, context, config), obstacles)


def _extra(window: Tensor, agent: Tensor, centre_m: Tensor, context: Context | None, config: AbsoluteConfig) -> Tensor | None:
    """Further inputs [R, 1, E], as far as the network has them."""
    columns = []
    if config.network.known_goal:
        goal_m = None if context is None or context.known_goal_m is None else context.known_goal_m.double()[window, agent]
        if goal_m is None or not (config.optional_goal or bool(goal_m.isfinite().all())):
            raise ConfigError("this checkpoint wants to know the goal, and none is given; use one trained without known_goal")
        columns.append(((goal_m - centre_m) / config.scale_m).nan_to_num(nan=0.0))
    if config.network.elapsed:
        if context is None or context.elapsed_s is None:
            raise ConfigError("this checkpoint wants the elapsed share, and none is given; use one trained without elapsed")
        columns.append(context.elapsed_s.double()[window, None] / (config.step_s * config.age_scale_steps))
    return torch.cat(columns, dim=-1)[:, None].float() if columns else None


class _Denoiser:
    """(noisy [R, K, T, 2], angle) -> clean estimate: the network, clamped, moved onto the detections and out of obstacles."""

    def __init__(
        self,
        model: AbsoluteModel,
        frame: "AbsoluteFrame",
        correction: Correction | None,
        noise: Tensor | None,
        num_hypotheses: int,
    ) -> None:
        self.model, self.frame = model, frame
        self.correction = correction if model.sampling.inpainting == "smoother" else None
        self.noise, self.num_hypotheses = noise, num_hypotheses
        self.rows, self.is_observed = frame.detection_rows(model.config)
        self.code = self._encoded(1).repeat_interleave(num_hypotheses, dim=0)
        self.constraints: Sequence[Constraint] = ()
        self.scale_m: Tensor | None = None
        if model.sampling.guidance == "clean" and correction is not None:
            self.constraints = _constraints(model, frame)
            self.scale_m = correction.sigma[:, None, :, None] * model.config.scale_m

    def __call__(self, noisy: Tensor, angle: float) -> Tensor:
        model = self.model
        code = self._encoded(self.num_hypotheses) if model.sampling.encode_each_step else self.code
        flat = noisy.reshape(-1, 1, *noisy.shape[-2:])
        clean = model.network.clean(flat, angle, code).reshape(noisy.shape)
        clean = clean.clamp(-model.config.clip, model.config.clip)
        if self.correction is not None:
            clean = self.correction(clean, self.noise)
        if self.scale_m is not None and self.constraints:
            moved = clean_estimate_guidance(model._metres(clean, self.frame), self.constraints, self.scale_m)
            clean = (moved - self.frame.centre_m[:, None, None].to(moved)) / model.config.scale_m
        return clean

    def _encoded(self, times: int) -> Tensor:
        """Codes [R * times, 1, E] from every row read `times` times."""
        rows, observed, extra = self.rows[:, None], self.is_observed[:, None], self.frame.extra
        if times > 1:
            rows, observed = rows.repeat_interleave(times, dim=0), observed.repeat_interleave(times, dim=0)
            extra = None if extra is None else extra.repeat_interleave(times, dim=0)
        return self.model.network.encode(rows, observed, extra)


def detection_rows(age: Tensor, position: Tensor, is_observed: Tensor, keep: int) -> tuple[Tensor, Tensor]:
    """The encoder's rows [R, keep, 3] (age, x, y) and their mask [R, keep]: the last detections, oldest first, left-packed.

    Args:
        age: [R, N] in the network's unit, oldest first.
        position: [R, N, 2] normalised.
        is_observed: [R, N] bool, padding last.
        keep: how many.
    """
    count = is_observed.sum(dim=1, keepdim=True)
    place = (count - keep).clamp_min(0) + torch.arange(keep)
    is_kept = place < count
    place = place.clamp(max=age.shape[1] - 1)
    rows = torch.cat([age.gather(1, place)[..., None], position.gather(1, place[..., None].expand(-1, -1, 2))], dim=-1)
    return torch.where(is_kept[..., None], rows, 0.0).float(), is_kept


def _constraints(model: AbsoluteModel, frame: "AbsoluteFrame") -> tuple[Constraint, ...]:
    found: list[Constraint] = []
    if frame.obstacles.count:
        found.append(ObstacleConstraint(frame.obstacles, model.sampling.margin_m, frame.datum_m[:, None, None]))
    if model.sampling.max_speed_mps is not None:
        found.append(SpeedConstraint(model.sampling.max_speed_mps, model.config.step_s))
    return tuple(found)


def _keep(state: Tensor, angle: float) -> Tensor:
    return state
