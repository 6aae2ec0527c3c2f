"""Rivals that answer with a mixture of Gaussians at a few horizons: their inputs, their answer, and the estimator around them.

Ye et al., "Learning Models of Adversarial Agent Behavior under Partial Observability" (GrAMMI, IROS 2023); the networks are in
`cadence.baselines.grammi` and `cadence.baselines.vrnn`. Letters beside the usual ones: R rows of a batch (one a window), H
horizons, G Gaussians of a mixture, M trackers, L steps of a tracker's track.
"""

import dataclasses
import math
from dataclasses import dataclass
from typing import Protocol, Self

import torch
from torch import Tensor

from cadence.bank.rows import scatter_hypotheses
from cadence.diffusion.absolute import detection_rows
from cadence.diffusion.noise import mirrored
from cadence.errors import ConfigError
from cadence.network.encoder import DetectionEncoder
from cadence.seeds import torch_stream
from cadence.types import Context, Detections, HypothesisSet, WindowBatch

HORIZONS = (0, 29, 59, 89, 119)
"""Steps after the origin at which the paper's table reads its scores; step 0 is now."""

_ROWS_AT_ONCE = 64
"""Sequences of similar length that one LSTM call takes: enough to keep it busy, few enough to waste little on padding."""
_SHORT = 32
"""Sequences of no more rows than this waste little in any case."""


@dataclass(frozen=True, eq=False)
class GaussianMixture:
    """Mixtures of G axis-parallel Gaussians at H horizons of B windows, metres relative to the windows' datum.

    weight  [B, H, G] not negative, summing to one over G
    mean_m  [B, H, G, 2]
    sigma_m [B, H, G, 2] standard deviations, positive
    """

    weight: Tensor
    mean_m: Tensor
    sigma_m: Tensor

    def __post_init__(self) -> None:
        shape = (*self.weight.shape, 2)
        if self.weight.ndim != 3 or tuple(self.mean_m.shape) != shape or tuple(self.sigma_m.shape) != shape:
            got = [tuple(value.shape) for value in (self.weight, self.mean_m, self.sigma_m)]
            raise ValueError(f"GaussianMixture: shapes {got}, expected [B, H, G], [B, H, G, 2] and [B, H, G, 2]")

    def log_density(self, position_m: Tensor) -> Tensor:
        """Logarithm of the density [B, H] (per square metre) at position_m [B, H, 2]."""
        return log_density(self.weight.log(), self.mean_m, self.sigma_m.log(), position_m)

    def expected_distance(self, truth_m: Tensor) -> Tensor:
        """The paper's measure sum_k pi_k |mu_k - y|, metres [B, H], for truth_m [B, H, 2]; it leaves the sigmas out."""
        distance = torch.linalg.vector_norm(self.mean_m - truth_m[:, :, None], dim=-1)
        expected: Tensor = (self.weight * distance).sum(dim=-1)
        return expected

    def mean(self) -> Tensor:
        """Mean position [B, H, 2], metres."""
        return (self.weight[..., None] * self.mean_m).sum(dim=-2)

    def sample(self, num_hypotheses: int, seeds: Tensor) -> Tensor:
        """Draws [B, K, H, 2], metres, independent between horizons; a window's depend on its seed (seeds [B]) alone.

        They are spread as evenly as those of the place model, so that no score tells the way of drawing: in pairs of one
        component with mirrored noise, the components drawn systematically.
        """
        k, h = num_hypotheses, self.weight.shape[1]
        num_pairs = (k + 1) // 2
        streams = [torch.Generator().manual_seed(seed) for seed in seeds.tolist()]
        choice = torch.zeros(len(seeds), num_pairs, h, dtype=torch.float64)
        noise = torch.zeros(len(seeds), num_pairs, h, 2, dtype=torch.float64)
        for row, stream in enumerate(streams):
            order = torch.rand(num_pairs, h, generator=stream, dtype=torch.float64).argsort(dim=0)
            choice[row] = (order + torch.rand(h, generator=stream, dtype=torch.float64)) / max(num_pairs, 1)
            noise[row] = torch.randn(num_pairs, h, 2, generator=stream, dtype=torch.float64)
        choice = choice.repeat_interleave(2, dim=1)[:, :k]
        noise = mirrored(noise, k)
        cumulated = self.weight.double().cumsum(dim=-1)
        cumulated = cumulated / cumulated[..., -1:]
        component = (choice[..., None] >= cumulated[:, None, :, :-1]).sum(dim=-1)
        index = component[..., None, None].expand(-1, -1, -1, 1, 2)
        mean, sigma = (
            value.double()[:, None].expand(-1, k, -1, -1, -1).gather(3, index)[..., 0, :]
            for value in (self.mean_m, self.sigma_m)
        )
        return mean + sigma * noise


def log_density(log_weight: Tensor, mean: Tensor, log_sigma: Tensor, position: Tensor) -> Tensor:
    """Logarithm of a mixture's density [..., H] at position [..., H, 2]; log_weight [..., H, G], the rest [..., H, G, 2]."""
    scaled = (position.unsqueeze(-2) - mean) * torch.exp(-log_sigma)
    exponent = -0.5 * scaled.square().sum(dim=-1) - log_sigma.sum(dim=-1) - math.log(2.0 * math.pi)
    return torch.logsumexp(log_weight + exponent, dim=-1)


def straight_tracks(points_m: Tensor, horizons: tuple[int, ...], num_steps: int) -> Tensor:
    """Tracks [..., T, 2] through points_m [..., H, 2] at the rising steps `horizons`: straight lines between, ends held."""
    steps = torch.arange(num_steps).clamp(horizons[0], horizons[-1])
    knots = torch.tensor(horizons)
    after = torch.searchsorted(knots, steps).clamp(min(1, len(horizons) - 1), len(horizons) - 1)
    before = (after - 1).clamp_min(0)
    length = (knots[after] - knots[before]).clamp_min(1)
    share = ((steps - knots[before]) / length).to(points_m.dtype)[:, None]
    return torch.lerp(points_m[..., before, :], points_m[..., after, :], share)


@dataclass(frozen=True)
class MixtureFrame:
    """What a mixture network's numbers mean; belongs to its checkpoint.

    step_s           seconds between steps
    centre_m, scale_m  of the map, in the mission frame: (position - centre) / scale
    age_scale_steps  ages of detections are counted in this many steps (the authors: the longest mission)
    elapsed_scale_steps  so is the time since the mission's start, in these
    """

    step_s: float = 60.0
    centre_m: tuple[float, float] = (0.0, 0.0)
    scale_m: float = 1.0
    age_scale_steps: float = 4320.0
    elapsed_scale_steps: float = 4320.0

    def __post_init__(self) -> None:
        if not min(self.step_s, self.scale_m, self.age_scale_steps, self.elapsed_scale_steps) > 0:
            raise ValueError("step_s, scale_m, age_scale_steps and elapsed_scale_steps must be positive")


@dataclass(frozen=True)
class HistoryConfig:
    """What the networks read; the defaults are the published ones, except for the two further inputs.

    max_detections  the last so many detections
    tracker_steps   the last so many steps of every tracker's track (0: trackers are not read)
    tracker_stride  only every so many of those steps
    elapsed         the time since the mission's start is an input
    known_goal      the goal known to the searching side is an input that may be absent (the authors' mixtures do not get it)
    """

    max_detections: int = 512
    tracker_steps: int = 64
    tracker_stride: int = 1
    elapsed: bool = True
    known_goal: bool = True

    def __post_init__(self) -> None:
        if min(self.max_detections, self.tracker_stride) < 1 or self.tracker_steps < 0:
            raise ValueError("max_detections and tracker_stride must be at least 1, tracker_steps not negative")

    @property
    def num_extra(self) -> int:
        """Further inputs: elapsed time; goal x, goal y, and whether it is known."""
        return self.elapsed + 3 * self.known_goal


@dataclass(frozen=True, eq=False)
class MixtureInputs:
    """What a network reads of R windows, normalised, float32.

    rows         [R, N, 3] age, x, y of detections, oldest first, left-packed
    is_observed  [R, N] bool, False on padding
    tracker_rows [R, M, L, 3] age, x, y of trackers, oldest first, left-packed
    is_tracked   [R, M, L] bool, False on padding
    elapsed      [R] share of the longest mission
    goal         [R, 2] known goal; zero where none is
    has_goal     [R] bool
    """

    rows: Tensor
    is_observed: Tensor
    tracker_rows: Tensor
    is_tracked: Tensor
    elapsed: Tensor
    goal: Tensor
    has_goal: Tensor

    def __len__(self) -> int:
        return len(self.rows)

    def __getitem__(self, pick: slice | Tensor) -> "MixtureInputs":
        """A selection of rows, its padding trimmed to its longest sequence of detections."""
        is_observed = self.is_observed[pick]
        longest = max(1, int(is_observed.sum(dim=1).max())) if len(is_observed) else 1
        rest = (self.tracker_rows, self.is_tracked, self.elapsed, self.goal, self.has_goal)
        return MixtureInputs(self.rows[pick][:, :longest], is_observed[:, :longest], *(value[pick] for value in rest))

    def extra(self, config: HistoryConfig) -> Tensor:
        """The further inputs [R, num_extra] that a network of this configuration has."""
        known = self.has_goal.to(self.goal.dtype)[:, None]
        columns = [self.elapsed[:, None]] if config.elapsed else []
        columns += [self.goal * known, known] if config.known_goal else []
        return torch.cat(columns, dim=-1) if columns else self.elapsed.new_zeros(len(self), 0)

    def without_goal(self, is_hidden: Tensor) -> "MixtureInputs":
        """The same with the goal unknown where is_hidden [R]."""
        return dataclasses.replace(self, has_goal=self.has_goal & ~is_hidden)


@dataclass(frozen=True, eq=False)
class RawMixture:
    """A network's answer in normalised coordinates: logits [R, H, G], mean and log_sigma [R, H, G, 2]."""

    logits: Tensor
    mean: Tensor
    log_sigma: Tensor

    def negative_log_likelihood(self, target: Tensor) -> Tensor:
        """Of target [R, H, 2] in normalised coordinates, [R, H]."""
        return -log_density(torch.log_softmax(self.logits, dim=-1), self.mean, self.log_sigma, target)

    def in_metres(self, frame: MixtureFrame, datum_m: Tensor) -> GaussianMixture:
        """The mixture in metres relative to datum_m [R, 2], float64."""
        centre = torch.tensor(frame.centre_m, dtype=torch.float64) - datum_m.double()
        mean_m = self.mean.double() * frame.scale_m + centre[:, None, None]
        return GaussianMixture(torch.softmax(self.logits.double(), -1), mean_m, self.log_sigma.double().exp() * frame.scale_m)


class MixtureNetwork(Protocol):
    """What the estimator needs of a network (an `nn.Module`)."""

    horizons: tuple[int, ...]
    history: HistoryConfig

    @property
    def latent_size(self) -> int:
        """Numbers of noise that a detection takes; 0 for networks without latent variables."""
        ...

    def __call__(self, inputs: MixtureInputs, noise: Tensor | None = None) -> RawMixture:
        """The mixture; noise [R, N, latent_size] standard normal, None: latent variables at their mean."""
        ...


def mixture_inputs(windows: WindowBatch, frame: MixtureFrame, history: HistoryConfig) -> MixtureInputs:
    """Inputs of windows with one agent; `ConfigError` where the context lacks one."""
    context = windows.required_context("mixture_inputs")
    if context.elapsed_s is None and history.elapsed:
        raise ConfigError("this checkpoint wants the time since the mission's start, and none is given")
    detections = windows.detections
    time_s, position_m, is_known = detections.time_s[:, 0], detections.position_m[:, 0], detections.is_observed[:, 0]
    centre = torch.tensor(frame.centre_m, dtype=torch.float64)
    place = (position_m.double() + (context.datum_m.double() - centre)[:, None]) / frame.scale_m
    keep = min(history.max_detections, max(1, int(is_known.sum(dim=1).max()) if len(is_known) else 1))
    rows, is_observed = detection_rows(-time_s.double() / frame.step_s / frame.age_scale_steps, place, is_known, keep)
    tracker_rows, is_tracked = _tracker_rows(context, frame, history)
    elapsed = torch.zeros(len(rows))
    if context.elapsed_s is not None:
        elapsed = (context.elapsed_s.double() / frame.step_s / frame.elapsed_scale_steps).float()
    goal = torch.full((len(rows), 2), math.nan)
    if context.known_goal_m is not None:
        goal = ((context.known_goal_m[:, 0].double() - centre) / frame.scale_m).float()
    has_goal = torch.isfinite(goal).all(dim=-1)
    goal = torch.where(has_goal[:, None], goal, 0.0)
    return MixtureInputs(rows, is_observed, tracker_rows, is_tracked, elapsed, goal, has_goal)


def _tracker_rows(context: Context, frame: MixtureFrame, history: HistoryConfig) -> tuple[Tensor, Tensor]:
    """Rows [R, M, L, 3] and mask [R, M, L] of the trackers' tracks; states that are not there leave no gap."""
    num = len(context.datum_m)
    if context.tracker_m is None or history.tracker_steps == 0:
        return torch.zeros(num, 0, 1, 3), torch.zeros(num, 0, 1, dtype=torch.bool)
    # counted back from now, so that now is always among them
    track = context.tracker_m[:, -history.tracker_steps :].flip(1)[:, :: history.tracker_stride].flip(1).transpose(1, 2)
    age = torch.arange(track.shape[2] - 1, -1, -1) * history.tracker_stride / frame.age_scale_steps
    centre = torch.tensor(frame.centre_m, dtype=torch.float64)
    place = ((track.double() - centre) / frame.scale_m).float()
    is_tracked = torch.isfinite(place).all(dim=-1)
    rows = torch.cat([age.float()[:, None].expand(*place.shape[:3], 1), place], dim=-1)
    order = torch.argsort((~is_tracked).to(torch.int8), dim=-1, stable=True)
    is_tracked = is_tracked.gather(-1, order)
    rows = rows.gather(2, order[..., None].expand(rows.shape))
    return torch.where(is_tracked[..., None], rows, 0.0), is_tracked


def encode_sequences(encoder: DetectionEncoder, rows: Tensor, is_observed: Tensor) -> Tensor:
    """The encoder's states [R, size] after rows [R, N, 3]; sequences of like length go together, which saves most padding."""
    count = is_observed.sum(dim=1)
    order = torch.argsort(count, stable=True)
    parts = []
    for pick in torch.split(order, _ROWS_AT_ONCE if rows.shape[1] > _SHORT else 16 * _ROWS_AT_ONCE):
        longest = int(count[pick[-1]])
        parts.append(encoder(rows[pick, :longest], is_observed[pick, :longest]))
    found = torch.cat(parts) if parts else rows.new_zeros(0, encoder.lstm.hidden_size)
    return found[torch.argsort(order)]


@dataclass(frozen=True, eq=False)
class MixtureModel:
    """A trained mixture network as an `Estimator`, for windows of one agent whose first step is now.

    It reads of the windows' context: datum, elapsed time, trackers, known goal. Windows without any detection are NaN.

    uses_goal      a known goal is read where the network and the context have one
    draws_latents  latent variables are drawn (one path a window, from its seed) instead of being at their mean
    """

    network: MixtureNetwork
    frame: MixtureFrame
    name: str
    uses_goal: bool = False
    draws_latents: bool = False
    rows_at_once: int = 1024

    def fit(self, tracks: Detections) -> Self:
        """The model itself: it adapts to nothing."""
        return self

    @property
    def horizons(self) -> tuple[int, ...]:
        """Steps after the origin that the mixtures stand for."""
        return self.network.horizons

    @torch.no_grad()
    def mixture(self, windows: WindowBatch) -> GaussianMixture:
        """The mixtures at the horizons, relative to the datum. `ConfigError` for another grid."""
        context = self._check(windows)
        active = windows.is_active[:, 0].nonzero()[:, 0]
        parts = []
        for pick in torch.split(active, self.rows_at_once):
            inputs = mixture_inputs(windows[pick], self.frame, self.network.history)
            if not self.uses_goal:
                inputs = inputs.without_goal(torch.ones(len(inputs), dtype=torch.bool))
            noise = self._latent_noise(inputs, windows.seeds[pick]) if self.draws_latents else None
            parts.append(self.network(inputs, noise).in_metres(self.frame, context.datum_m[pick]))
        return _scattered(parts, active, windows.num_windows, len(self.horizons))

    def sample(self, windows: WindowBatch, num_hypotheses: int) -> HypothesisSet:
        """Tracks through an independent draw at every horizon, straight between; deterministic in the windows' seeds."""
        active = windows.is_active[:, 0]
        mixture = self.mixture(windows)
        known = GaussianMixture(mixture.weight[active], mixture.mean_m[active], mixture.sigma_m[active])
        points_m = known.sample(num_hypotheses, windows.seeds[active])
        return scatter_hypotheses(straight_tracks(points_m, self.horizons, windows.num_steps), windows)

    def _check(self, windows: WindowBatch) -> Context:
        got = (windows.num_steps, windows.origin_index)
        if got != (self.horizons[-1] + 1, 0) or abs(windows.step_s / self.frame.step_s - 1.0) > 1e-6:
            raise ConfigError(
                f"infer.grid: this checkpoint predicts {self.horizons[-1] + 1} steps of {self.frame.step_s:g} s only; set "
                f"step_s = {self.frame.step_s:g}, history_steps = 1, horizon_steps = {self.horizons[-1]}"
            )
        if windows.num_agents != 1:
            raise ValueError(f"MixtureModel: windows of {windows.num_agents} agents, expected one")
        return windows.required_context("MixtureModel")

    def _latent_noise(self, inputs: MixtureInputs, seeds: Tensor) -> Tensor:
        r, n = inputs.is_observed.shape
        noise = torch.zeros(r, n, self.network.latent_size)
        for row, (seed, count) in enumerate(zip(seeds.tolist(), inputs.is_observed.sum(dim=1).tolist(), strict=True)):
            stream = torch_stream(seed, "latent")
            noise[row, :count] = torch.randn(count, self.network.latent_size, generator=stream)
        return noise


def _scattered(parts: list[GaussianMixture], active: Tensor, num_windows: int, num_horizons: int) -> GaussianMixture:
    """One mixture for all windows; NaN for those that are not active."""
    g = parts[0].weight.shape[-1] if parts else 1
    weight = torch.full((num_windows, num_horizons, g), math.nan, dtype=torch.float64)
    mean, sigma = (torch.full((*weight.shape, 2), math.nan, dtype=torch.float64) for _ in range(2))
    for target, name in ((weight, "weight"), (mean, "mean_m"), (sigma, "sigma_m")):
        if parts:
            target[active] = torch.cat([getattr(part, name) for part in parts])
    return GaussianMixture(weight, mean, sigma)
