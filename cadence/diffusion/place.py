"""The place model as an estimator: where a target goes in a place whose ways the network has learned.

Like the paper's model (Ye et al., CADENCE, MRS 2023) it predicts from now on; unlike it, tracks are displacements that begin at
the last detection, so that detections need no inpainting, and the stretch since then is part of every hypothesis.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Literal, Self

import torch
from torch import Tensor

from cadence.bank.rows import scatter_hypotheses
from cadence.constraints.limits import KeepOut, within_limits
from cadence.constraints.obstacles import ObstacleConstraint
from cadence.constraints.speed import exceeds
from cadence.diffusion.feasible import redrawn
from cadence.diffusion.guidance import PaperCost, adam_guidance, clean_estimate_guidance
from cadence.diffusion.noise import RowNoise
from cadence.diffusion.place_frame import PlaceConfig, future_of, past_of, place_inputs, to_pieces, to_track
from cadence.diffusion.place_team import agent_rows, shared_detections
from cadence.diffusion.sampler import even_angles, even_log_snr, sample_ddim, sample_ddpm, sample_dpmpp_2m
from cadence.diffusion.settings import PlaceSampling
from cadence.errors import ConfigError
from cadence.network.attention import MAX_AGENTS, Team
from cadence.network.frozen import FrozenPlace
from cadence.network.place import Pieces, PlaceNetwork
from cadence.recordings import NUM_STEPS
from cadence.schedule import MAX_ANGLE, clean_from, cosine_schedule
from cadence.types import Context, Detections, HypothesisSet, WindowBatch

_START, _END = MAX_ANGLE - 0.04, 0.08
"""Noise levels that DPM-Solver++ starts from and takes its last step at; evenly spaced in log SNR between them, six steps agree
with 25 in every score and in the lengths of steps, where eight evenly spaced angles made hypotheses too narrow."""

_SLACK = {"clean": 0.25, "final": 0.05}
"""What guidance keeps from obstacles beside the margin, in pieces of the future, by the stage at which it moves a track: a
straight line between two knots on an edge cuts through the obstacle, and what is moved while sampling is moved again."""


@dataclass(frozen=True, eq=False)
class PlaceModel:
    """A trained network as an `Estimator` for windows that begin now and say where they are (`WindowBatch.context`).

    Networks with attention draw all agents of a window together, others each agent for itself; agents without detections are
    NaN.
    """

    network: PlaceNetwork
    config: PlaceConfig
    sampling: PlaceSampling = field(default_factory=PlaceSampling)
    name: str = "cadence"

    @property
    def draws_together(self) -> bool:
        """Whether all agents of a window are drawn together."""
        return self.config.network.attention_heads > 0

    def fit(self, tracks: Detections) -> Self:
        """The model itself: it adapts to nothing."""
        return self

    @torch.no_grad()
    def sample(self, windows: WindowBatch, num_hypotheses: int) -> HypothesisSet:
        """Hypotheses [B, K, A, T, 2]; a window's depend on its seed, not on its neighbours. `ConfigError` for other grids.

        Grids may begin before now: from the last detection on tracks are drawn there, too (as they were before any obstacle was
        led around), and before it they are NaN.
        """
        self._check(windows)
        if self.config.shared_gap_steps:
            windows = shared_detections(windows)
        rows = agent_rows(windows, self.config)
        network = FrozenPlace(self.network, getattr(torch, self.sampling.precision))
        size = rows.team.num_agents if rows.team is not None else 1  # rows that belong together
        per_chunk = size * max(1, self.sampling.chunk // (num_hypotheses * size))
        parts = [torch.zeros(0, num_hypotheses, windows.num_steps, 2, dtype=torch.float64)]
        for begin in range(0, rows.windows.num_windows, per_chunk):
            part = slice(begin, begin + per_chunk)
            team = rows.team and rows.team[slice(begin // size, (begin + per_chunk) // size)]
            parts.append(self._sample_rows(network, rows.windows[part], team, num_hypotheses))
        return scatter_hypotheses(torch.cat(parts)[rows.is_real], windows)

    def _check(self, windows: WindowBatch) -> None:
        step_s = self.config.step_s
        if windows.num_steps - windows.origin_index != NUM_STEPS or abs(windows.step_s / step_s - 1.0) > 1e-6:
            raise ConfigError(
                f"infer.grid: this checkpoint predicts {NUM_STEPS} steps of {step_s:g} s from now on; set step_s = {step_s:g}, "
                f"history_steps = 1, horizon_steps = {NUM_STEPS - 1}"
            )
        sampler, tuned = self.sampling.sampler, self.config.few_steps
        if sampler == "few" and not tuned:
            raise ConfigError("place.sampler: 'few', but these weights were not tuned for few steps; use dpmpp, ddim or ddpm")
        if tuned and sampler not in ("auto", "few"):
            raise ConfigError(f"place.sampler: {sampler!r}, but these weights were tuned for {tuned} steps; use auto")
        if self.config.network.attention_heads and windows.num_agents > MAX_AGENTS:
            raise ConfigError(
                f"infer.checkpoint: this checkpoint draws at most {MAX_AGENTS} agents together, here are {windows.num_agents}; "
                "choose one without attention between agents, such as 'general'"
            )

    def _sample_rows(self, network: FrozenPlace, windows: WindowBatch, team: Team | None, num_hypotheses: int) -> Tensor:
        """Hypotheses [R, K, T, 2] in metres relative to the datum."""
        context = windows.required_context("PlaceModel")
        inputs = place_inputs(windows, self.config)
        stream = RowNoise(windows.seeds)
        last_m = _last_detection(windows.detections)
        tracks = _Tracks(self, inputs.pieces, last_m, context)
        pieces = inputs.pieces.repeated(num_hypotheses)
        known = network.known(inputs)
        mates = None if team is None else team.repeated(num_hypotheses)

        def denoise(noisy: Tensor, angle: float) -> Tensor:
            flat = noisy.flatten(0, 1)
            told = network.known(inputs.repeated(num_hypotheses)) if self.sampling.encode_each_step else known
            clean = clean_from("v", network(flat, angle, pieces, told, mates), flat, torch.tensor(angle)).reshape(noisy.shape)
            return tracks.guided(tracks.limited(clean), "clean")

        is_paired = self.sampling.is_antithetic and self.sampling.sampler != "ddpm"
        shape = (self.config.num_pieces, 2)
        start = stream.draw_pairs(num_hypotheses, shape) if is_paired else stream.draw((num_hypotheses, *shape))
        sampled = self._solved(denoise, start, stream, tracks)
        sampled = tracks.guided(tracks.limited(sampled), "final")
        track = to_track(sampled.double(), inputs.pieces, self.config)
        positions = future_of(track, self.config) + last_m[:, None, None]
        keep_out = self._keep_out(context, last_m)
        if (context.obstacles.count or keep_out.edge_m) and self.sampling.is_repaired:
            positions = self._repaired(positions, keep_out, inputs.pieces, None if team is not None else windows.seeds)
        if windows.origin_index:
            before = past_of(track, inputs.pieces, self.config, windows.origin_index) + last_m[:, None, None]
            positions = torch.cat([before, positions], dim=2)
        return positions

    def _keep_out(self, context: Context, last_m: Tensor) -> KeepOut:
        """Where tracks of rows that were last seen at last_m [R, 2] may not be; the map reaches at least as far as that."""
        offset_m = context.datum_m[:, None, None]
        if self.config.edge_m is None:
            return KeepOut(context.obstacles, self.sampling.margin_m, offset_m)
        low, high = (torch.tensor(self.config.edge_m, dtype=torch.float64).view(2, 2) - context.datum_m[:, None]).unbind(1)
        edge_m = torch.minimum(low, last_m)[:, None, None], torch.maximum(high, last_m)[:, None, None]
        return KeepOut(context.obstacles, self.sampling.margin_m, offset_m, edge_m)

    def _repaired(self, positions: Tensor, keep_out: KeepOut, pieces: Pieces, seeds: Tensor | None) -> Tensor:
        """Tracks within all limits, at a speed that the target has; those that cannot be are drawn again from the others.

        Where agents see each other a hypothesis is one of all of them, and none is drawn again for itself: without seeds.
        """
        is_first = torch.arange(positions.shape[2]) == 0
        is_pinned = ((pieces.start[:, :1] >= 0) & is_first)[:, None].expand(positions.shape[:-1])
        longest_m = self.config.max_step_m
        moved, is_clear = within_limits(positions, keep_out, is_pinned, longest_m, is_first.expand(positions.shape[:-1]))
        is_kept = is_clear & ~exceeds(moved, longest_m)
        if seeds is not None:
            moved, _ = redrawn(moved, torch.ones_like(is_kept, dtype=torch.float64), is_kept, seeds)
        return moved

    def _solved(self, denoise: Callable[[Tensor, float], Tensor], start: Tensor, stream: RowNoise, tracks: "_Tracks") -> Tensor:
        sampler, steps = self.sampling.sampler, self.sampling.num_steps
        if self.config.few_steps:
            return sample_ddim(denoise, start, even_angles(self.config.few_steps))
        if sampler == "ddpm":
            on_mean = tracks.paper_guided if self.sampling.guidance == "paper" else _keep
            return sample_ddpm(denoise, start, cosine_schedule(steps), lambda like: stream.draw(like.shape[1:]), on_mean)
        if sampler == "ddim":
            return sample_ddim(denoise, start, even_angles(steps))
        return sample_dpmpp_2m(denoise, start, even_log_snr(steps, _START, _END))


class _Tracks:
    """What moves the pieces [R, K, P, 2] of one chunk of windows: the speed limit, and obstacles."""

    def __init__(self, model: PlaceModel, pieces: Pieces, last_m: Tensor, context: Context) -> None:
        self.config, self.sampling, self.obstacles = model.config, model.sampling, context.obstacles
        self.pieces, self.last_m = pieces, last_m[:, None, None].float()
        self.offset_m = context.datum_m[:, None, None].float()
        # how far a target may have come since the detection: what guidance may move a track by
        self.reach_m = torch.nn.functional.pad((pieces.span * self.config.scale_m).cumsum(dim=1), (1, 0))[:, None, :, None]

    def limited(self, displacement: Tensor) -> Tensor:
        """No piece is faster than the target can be."""
        longest = self.config.max_step_m / self.config.unit_step_m
        length = displacement.norm(dim=-1, keepdim=True)
        limited: Tensor = displacement * (longest / length.clamp_min(1e-6)).clamp(max=1.0)
        return limited

    def guided(self, displacement: Tensor, stage: Literal["clean", "final"]) -> Tensor:
        """Clean estimates moved out of obstacles, at the stage at which that is asked for."""
        if self.sampling.guidance != stage or not self.obstacles.count:
            return displacement
        slack_m = _SLACK[stage] * self.config.stride * self.config.unit_step_m
        constraint = ObstacleConstraint(self.obstacles, self.sampling.margin_m + slack_m, self.offset_m)
        track = to_track(displacement, self.pieces, self.config) + self.last_m
        moved = clean_estimate_guidance(track, [constraint], self.reach_m)
        return to_pieces(moved, self.pieces, self.config)

    def paper_guided(self, mean: Tensor, angle: float) -> Tensor:
        """Algorithm 1 on the mean of a DDPM step."""
        weight = self.sampling.step_weight
        cost = PaperCost(self.obstacles, unit_m=self.config.scale_m, step_weight=weight, offset_m=self.offset_m)

        def cost_of(displacement: Tensor) -> Tensor:
            return cost.cost(to_track(displacement, self.pieces, self.config) + self.last_m)

        return adam_guidance(mean, cost_of, self.sampling.learning_rate, self.sampling.iterations)


def _last_detection(detections: Detections) -> Tensor:
    """Position [R, 2] of the last detection relative to the datum."""
    index = (detections.count[:, 0] - 1)[:, None, None].expand(-1, 1, 2)
    return detections.position_m[:, 0].gather(1, index)[:, 0].double()


def _keep(state: Tensor, angle: float) -> Tensor:
    return state
